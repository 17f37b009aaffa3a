"""Checkpoints: what is written is what is read, by transformers too; every fault names its tensor."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from dual_system.models.eyes import Eye
from dual_system.models.proprioception import Proprioception
from dual_system.models.second_look import SecondLook
from safetensors.torch import load_file, save_file
from transformers.models.qwen3_5 import Qwen3_5ForConditionalGeneration

from dual_system.models.ponder.checkpoint import (
    INDEX_NAME,
    SINGLE_NAME,
    CheckpointError,
    load_ponder,
    mtp_shapes,
    save_ponder,
    weights_hash,
)
from dual_system.models.ponder.configs import PonderConfig, qwen35_0p8b, qwen35_2b, qwen35_4b, qwen35_9b, tiny_cpu
from dual_system.models.ponder.demo_sampling import DemoSampling, declared
from dual_system.models.ponder.network import FLOAT32_PARAMETERS, Ponder, skeleton
from dual_system.models.ponder.vocabulary import Vocabulary

VOCABULARY = Vocabulary.tiny()
CONFIG = replace(tiny_cpu(), num_layers=4, vision_depth=1, image_px=(64, 64), num_carriers=2)
Tensors = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def ponder() -> Ponder:
    return Ponder.random(CONFIG, VOCABULARY, seed=1)


@pytest.fixture
def folder(ponder: Ponder, tmp_path: Path) -> Path:
    save_ponder(ponder, tmp_path)
    return tmp_path


def edit_tensors(folder: Path, edit: Callable[[Tensors], None]) -> None:
    tensors = load_file(folder / SINGLE_NAME)
    edit(tensors)
    save_file(tensors, folder / SINGLE_NAME)


@pytest.mark.parametrize("tied", [False, True])
@pytest.mark.parametrize("max_shard_bytes", [10**9, 200_000])
def test_saved_and_loaded_it_is_the_same_network(tmp_path: Path, tied: bool, max_shard_bytes: int) -> None:
    saved = Ponder.random(replace(CONFIG, tied_embeddings=tied), VOCABULARY, seed=2)
    save_ponder(saved, tmp_path, max_shard_bytes=max_shard_bytes)
    loaded = load_ponder(tmp_path)
    assert (tmp_path / INDEX_NAME).is_file() == (max_shard_bytes < 10**9)
    assert weights_hash(loaded) == weights_hash(saved)
    for ponder in (saved, loaded):
        table = ponder.qwen.model.language_model.embed_tokens.weight
        assert (ponder.qwen.lm_head.weight is table) == tied
    assert loaded.format.carrier_ids == saved.format.carrier_ids
    assert loaded.image_px == (64, 64)
    row = saved.format.row([*saved.format.opening("press"), *saved.format.query(1)])
    frames = torch.full((1, 64, 64, 3), 200, dtype=torch.uint8)
    with torch.no_grad():
        hidden = saved.encode_row(row, frames)
        assert torch.equal(loaded.encode_row(row, frames), hidden)
        assert torch.equal(loaded.logits(hidden), saved.logits(hidden))


def test_transformers_reads_what_we_write(ponder: Ponder, folder: Path) -> None:
    public = Qwen3_5ForConditionalGeneration.from_pretrained(folder, dtype=torch.float32)
    ours = ponder.qwen.state_dict()
    theirs = public.state_dict()
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


@pytest.mark.parametrize("is_random", [True, False])
def test_a_checkpoint_remembers_whether_it_was_trained(tmp_path: Path, is_random: bool) -> None:
    ponder = Ponder.random(CONFIG, VOCABULARY, seed=1)
    assert ponder.is_random
    ponder.is_random = is_random
    save_ponder(ponder, tmp_path)
    assert load_ponder(tmp_path).is_random == is_random


def test_a_public_checkpoint_without_our_file_gets_the_defaults(folder: Path) -> None:
    (folder / "ponder.json").unlink()
    loaded = load_ponder(folder)
    assert loaded.format.carrier_ids == (VOCABULARY.num_tokens,)
    assert loaded.image_px == (256, 256)
    assert loaded.is_random


def test_a_missing_tensor_is_named(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.pop("model.language_model.layers.3.self_attn.q_norm.weight"))
    with pytest.raises(CheckpointError, match=r"missing model\.language_model\.layers\.3\.self_attn\.q_norm"):
        load_ponder(folder)


def test_an_extra_tensor_is_named(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.update(surprise=torch.zeros(1)))
    with pytest.raises(CheckpointError, match="extra surprise"):
        load_ponder(folder)


def test_a_misshapen_tensor_is_named_with_both_shapes(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.update({"lm_head.weight": torch.zeros(512, 95)}))
    with pytest.raises(CheckpointError, match=r"misshapen lm_head\.weight: \(512, 95\), .* \(512, 96\)"):
        load_ponder(folder)


def test_many_faults_are_counted_not_listed(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.update({f"x{i}": torch.zeros(1) for i in range(9)}))
    with pytest.raises(CheckpointError, match=r"\(9 faults\).*and 4 more"):
        load_ponder(folder)


@pytest.mark.parametrize(
    ("config", "num_parameters"),
    [(qwen35_0p8b, 20_452_864), (qwen35_2b, 60_828_160), (qwen35_4b, 120_599_552), (qwen35_9b, 243_290_624)],
)
def test_the_multi_token_prediction_block_has_its_published_size(
    config: Callable[[], PonderConfig], num_parameters: int
) -> None:
    qwen = config().qwen()
    shapes = {name: tuple(tensor.shape) for name, tensor in skeleton(qwen).state_dict().items()}
    assert sum(math.prod(shape) for shape in mtp_shapes(qwen.text_config, shapes).values()) == num_parameters


@pytest.fixture
def public(tmp_path: Path) -> Path:
    """A folder as public Qwen3.5 checkpoints are: bfloat16, some float32, multi-token prediction, no ponder.json."""
    ponder = Ponder.random(CONFIG, VOCABULARY, seed=1, dtype=torch.bfloat16)
    text_config = ponder.qwen.config.text_config
    text_config.mtp_num_hidden_layers = 1
    shapes = {name: tuple(tensor.shape) for name, tensor in ponder.qwen.state_dict().items()}
    ponder.mtp = {
        name: torch.full(shape, number / 7, dtype=torch.bfloat16)
        for number, (name, shape) in enumerate(mtp_shapes(text_config, shapes).items())
    }
    assert len(ponder.mtp) == 15
    save_ponder(ponder, tmp_path / "public")
    (tmp_path / "public" / "ponder.json").unlink()
    return tmp_path / "public"


@pytest.mark.parametrize("max_shard_bytes", [10**9, 200_000])
def test_a_public_checkpoint_is_written_back_bit_for_bit(public: Path, tmp_path: Path, max_shard_bytes: int) -> None:
    save_ponder(load_ponder(public, dtype=torch.bfloat16), tmp_path / "again", max_shard_bytes=max_shard_bytes)
    before = load_file(public / SINGLE_NAME)
    after = {name: t for file in (tmp_path / "again").glob("*.safetensors") for name, t in load_file(file).items()}
    assert {t.dtype for name, t in before.items() if name.endswith(FLOAT32_PARAMETERS)} == {torch.float32}
    assert before.keys() == after.keys()
    assert {name: t.dtype for name, t in before.items()} == {name: t.dtype for name, t in after.items()}
    assert all(torch.equal(before[name], after[name]) for name in before)
    read = json.loads((tmp_path / "again" / "config.json").read_text())
    assert read["text_config"]["mtp_num_hidden_layers"] == 1
    Qwen3_5ForConditionalGeneration.from_pretrained(tmp_path / "again", dtype=torch.float32)


def test_multi_token_prediction_changes_nothing_that_is_served(public: Path) -> None:
    with_block = load_ponder(public, dtype=torch.bfloat16)
    edit_tensors(public, lambda tensors: [tensors.pop(name) for name in with_block.mtp])
    without = load_ponder(public, dtype=torch.bfloat16)
    assert not without.mtp
    assert weights_hash(without) == weights_hash(with_block)
    assert with_block.state_dict().keys() == without.state_dict().keys()


@pytest.mark.parametrize(
    ("edit", "fault"),
    [
        (lambda tensors: tensors.pop("mtp.norm.weight"), r"missing mtp\.norm\.weight \(96,\)"),
        (lambda tensors: tensors.update({"mtp.layers.1.norm": torch.zeros(1)}), r"extra mtp\.layers\.1\.norm"),
        (
            lambda tensors: tensors.update({"mtp.fc.weight": torch.zeros(2, 2)}),
            r"misshapen mtp\.fc\.weight: \(2, 2\), .* \(96, 192\)",
        ),
    ],
)
def test_a_fault_in_multi_token_prediction_is_named(public: Path, edit: Callable[[Tensors], None], fault: str) -> None:
    edit_tensors(public, edit)
    with pytest.raises(CheckpointError, match=fault):
        load_ponder(public)


def test_a_shard_that_is_not_there_is_named(ponder: Ponder, tmp_path: Path) -> None:
    save_ponder(ponder, tmp_path, max_shard_bytes=200_000)
    shard = min(tmp_path.glob("model-*.safetensors"))
    shard.unlink()
    with pytest.raises(FileNotFoundError, match=shard.name):
        load_ponder(tmp_path)


def test_an_index_that_lies_is_caught(ponder: Ponder, tmp_path: Path) -> None:
    save_ponder(ponder, tmp_path, max_shard_bytes=200_000)
    index = json.loads((tmp_path / INDEX_NAME).read_text())
    first, last = min(index["weight_map"].values()), max(index["weight_map"].values())
    name = next(n for n, file_name in index["weight_map"].items() if file_name == first)
    index["weight_map"][name] = last
    (tmp_path / INDEX_NAME).write_text(json.dumps(index))
    with pytest.raises(CheckpointError, match=f"missing {name}: .* places it in {last}"):
        load_ponder(tmp_path)


def test_a_tokenizer_of_another_checkpoint_is_noticed(folder: Path) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["image_token_id"] = 7
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="image_token_id is 7"):
        load_ponder(folder)


def test_another_architecture_is_refused(folder: Path) -> None:
    (folder / "config.json").write_text(json.dumps({"model_type": "llama"}))
    with pytest.raises(CheckpointError, match="'llama'"):
        load_ponder(folder)


def test_a_checkpoint_remembers_its_eyes(tmp_path: Path) -> None:
    eyes = (Eye(camera=1), Eye(camera=0, box=(0.25, 0, 0.75, 0.5)))
    saved = Ponder.random(replace(CONFIG, vision_patch_px=8, eyes=eyes), VOCABULARY, seed=1)
    save_ponder(saved, tmp_path)
    loaded = load_ponder(tmp_path)
    assert loaded.format.eyes == eyes
    assert (loaded.format.image_grid, loaded.format.token_px, loaded.image_px) == ((4, 4), 16, (64, 64))


def test_a_checkpoint_remembers_what_it_is_told_of_the_robot(tmp_path: Path) -> None:
    told = Proprioception(first_id=460, num_finger_bins=4)
    save_ponder(Ponder.random(replace(CONFIG, proprioception=told), VOCABULARY, seed=1), tmp_path)
    assert load_ponder(tmp_path).format.proprioception == told


def test_a_checkpoint_remembers_that_it_has_no_words(tmp_path: Path) -> None:
    silent = Ponder.random(CONFIG, VOCABULARY, seed=1)
    silent.format = replace(silent.format, speaks=False)
    save_ponder(silent, tmp_path)
    assert not load_ponder(tmp_path).format.speaks


def test_a_checkpoint_remembers_that_it_takes_notes(tmp_path: Path) -> None:
    noting = Ponder.random(CONFIG, VOCABULARY, seed=1)
    noting.format = replace(noting.format, takes_notes=True)
    save_ponder(noting, tmp_path)
    assert load_ponder(tmp_path).format.takes_notes


def test_a_checkpoint_remembers_when_it_looks_again(tmp_path: Path) -> None:
    looking = Ponder.random(CONFIG, VOCABULARY, seed=1)
    looking.format = replace(looking.format, second_look=SecondLook(after=6, least=8, unless="hides"))
    save_ponder(looking, tmp_path)
    assert load_ponder(tmp_path).format.second_look == SecondLook(after=6, least=8, unless="hides")


def test_a_fovea_is_read_back(ponder: Ponder, tmp_path: Path) -> None:
    staring = Ponder(ponder.qwen.config, replace(ponder.format, fovea=(0, 0, 1, 1)), image_px=ponder.image_px)
    staring.qwen = ponder.qwen
    save_ponder(staring, tmp_path)
    assert load_ponder(tmp_path).format.fovea == (0, 0, 1, 1)


def test_how_demonstrations_were_shown_is_read_back_and_told_to_who_asks_for_it_alone(
    ponder: Ponder, tmp_path: Path
) -> None:
    watching = Ponder(ponder.qwen.config, ponder.format, image_px=ponder.image_px)
    watching.qwen = ponder.qwen
    watching.format = replace(watching.format, demonstrations=DemoSampling(hz=2, to_its_end=True))
    save_ponder(watching, tmp_path)
    assert load_ponder(tmp_path).format.demonstrations == DemoSampling(hz=2, to_its_end=True) == declared(tmp_path)


@pytest.mark.parametrize("version", [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11])
def test_a_folder_from_before_there_were_eyes_proprioception_or_notes_has_none_and_speaks(
    ponder: Ponder, folder: Path, version: int
) -> None:
    stored = json.loads((folder / "ponder.json").read_text())
    since_1 = ("eyes", "proprioception", "speaks", "takes_notes", "second_look", "counsel", "fovea", "demonstrations")
    since_1 = (*since_1, "has_reader", "specialties")
    for name in since_1[version - 1 :]:
        del stored[name]
    (folder / "ponder.json").write_text(json.dumps({**stored, "format": f"ponderpounce.ponder/{version}"}))
    loaded = load_ponder(folder)
    assert (loaded.format.eyes, loaded.format.proprioception, loaded.format.speaks) == (None, None, True)
    assert not loaded.format.takes_notes
    assert loaded.format.second_look is None
    assert (loaded.format.counsel, loaded.format.fovea) == (None, None)
    assert loaded.format.demonstrations == DemoSampling()
    assert loaded.image_px == (64, 64)
    assert weights_hash(loaded) == weights_hash(ponder)


def test_who_took_counsel_before_one_could_choose_takes_it_on_all_episodes(folder: Path) -> None:
    stored = json.loads((folder / "ponder.json").read_text())
    del stored["has_reader"], stored["specialties"]
    eyes = [{"camera": 0, "box": [0.25, 0.25, 0.75, 0.75]}]
    counsel = {"others": [{"down_px": 2, "right_px": -3, "is_mirrored": False}], "near": 30}
    before = {**stored, "eyes": eyes, "counsel": counsel, "format": "ponderpounce.ponder/9"}
    (folder / "ponder.json").write_text(json.dumps(before))
    taken = load_ponder(folder).format.counsel
    assert taken is not None
    assert taken.on_demonstrations


@pytest.mark.parametrize("eyes", [[], [{"camera": 0}], [{"camera": 0, "box": [0, 0, 2, 1]}], 7])
def test_eyes_that_are_none_are_refused(folder: Path, eyes: object) -> None:
    stored = json.loads((folder / "ponder.json").read_text())
    (folder / "ponder.json").write_text(json.dumps({**stored, "eyes": eyes}))
    with pytest.raises(ValueError, match="eye"):
        load_ponder(folder)


def test_an_unknown_field_is_refused(folder: Path) -> None:
    stored = json.loads((folder / "ponder.json").read_text())
    (folder / "ponder.json").write_text(json.dumps({**stored, "num_carrier": 2}))
    with pytest.raises(ValueError, match=r"ponder\.json: .*unknown \['num_carrier'\]"):
        load_ponder(folder)


@pytest.mark.parametrize("name", ["config.json", "ponder.json", SINGLE_NAME])
def test_a_file_that_was_cut_short_is_named(folder: Path, name: str) -> None:
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match=name):
        load_ponder(folder)


def test_a_checkpoint_is_never_overwritten(ponder: Ponder, folder: Path) -> None:
    with pytest.raises(FileExistsError, match="already holds a checkpoint"):
        save_ponder(ponder, folder)


def test_an_empty_folder_says_what_it_needs(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        load_ponder(tmp_path)
