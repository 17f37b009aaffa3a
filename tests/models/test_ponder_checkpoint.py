"""Checkpoints: what is written is what is read, by transformers too; every fault names its tensor."""

import copy
import json
import math
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers.models.qwen3_5 import Qwen3_5ForConditionalGeneration

from dual_system.models.config_json import from_json
from dual_system.models.ponder.checkpoint import (
    INDEX_NAME,
    OWN_NAME,
    SINGLE_NAME,
    SMALL_PAIR,
    StoredPonder,
    _read_stored,
    load_ponder,
    mtp_shapes,
    save_ponder,
    weights_hash,
)
from dual_system.models.ponder.configs import PonderConfig, qwen35_0p8b, qwen35_2b, qwen35_4b, qwen35_9b, tiny_cpu
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.models.ponder.network import FLOAT32_PARAMETERS, Ponder, skeleton
from dual_system.models.ponder.observation import WHOLE_VIEWS
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.small_pair.reading import CropReader
from dual_system.models.stored_tensors import CheckpointError

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


# -- ponder.json: what PONDER adds

CROP = CropReader(camera=1, box=(0.25, 0, 0.75, 0.5), first_state_id=460, num_finger_bins=4, num_height_bins=8)
ADDED: dict[str, Any] = {
    "speaks": False,
    "remembers": False,
    "demonstrations": DemoSampling(hz=2, to_its_end=True),
    "reader": CROP,
}


def stored_in(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / OWN_NAME).read_text())
    return found


def declare(folder: Path, values: object) -> None:
    (folder / OWN_NAME).write_text(json.dumps(values))


@pytest.mark.parametrize("name", ADDED)
def test_what_was_declared_is_read_back(ponder: Ponder, tmp_path: Path, name: str) -> None:
    declaring = copy.copy(ponder)
    declaring.format = replace(ponder.format, **{name: ADDED[name]})
    assert declaring.format != ponder.format
    save_ponder(declaring, tmp_path)
    assert replace(load_ponder(tmp_path).format, vocabulary=VOCABULARY) == declaring.format


def test_only_a_ponder_that_does_not_read_whole_views_says_how_it_reads(ponder: Ponder, folder: Path) -> None:
    assert ponder.format.reader == WHOLE_VIEWS
    assert SMALL_PAIR not in stored_in(folder)


def test_a_public_checkpoint_without_our_file_is_one_with_an_empty_file(folder: Path) -> None:
    (folder / OWN_NAME).unlink()
    without = load_ponder(folder)
    declare(folder, {})
    empty = load_ponder(folder)
    for loaded in (without, empty):
        assert loaded.format.carrier_ids == (VOCABULARY.num_tokens,)
        assert (loaded.format.speaks, loaded.format.reader) == (True, WHOLE_VIEWS)
        assert loaded.format.demonstrations == DemoSampling()
        assert loaded.image_px == (256, 256)
        assert loaded.is_random


@pytest.mark.parametrize("name", [each.name for each in fields(StoredPonder)])
def test_an_absent_field_has_its_default(folder: Path, name: str) -> None:
    stored = stored_in(folder)
    del stored[name]
    declare(folder, stored)
    expected = replace(_declared(folder, stored_in(folder)), **{name: getattr(StoredPonder(), name)})
    assert _read_stored(folder)[0] == expected
    if name != "image_px":  # the weights do not depend on it, nothing else of the format does
        load_ponder(folder)


def _declared(folder: Path, values: dict[str, Any]) -> StoredPonder:
    return from_json(StoredPonder, values, str(folder))


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda stored: stored.update(num_carrier=2), r"ponder\.json: missing \[\], unknown \['num_carrier'\]"),
        (lambda stored: stored.update(eyes=[]), r"ponder\.json: missing \[\], unknown \['eyes'\]"),
        (lambda stored: stored.update(format="ponderpounce.ponder/9"), r"ponder\.json\.format: expected 'ponderpounce"),
        (lambda stored: stored.update(speaks=1), r"ponder\.json\.speaks: expected bool, came 1"),
        (lambda stored: stored["demonstrations"].update(hz=3), "hz must divide 20, came 3"),
        (lambda stored: stored["demonstrations"].update(fps=3), r"demonstrations: missing \[\], unknown \['fps'\]"),
        (lambda stored: stored.update(small_pair={}), r"ponder\.json: small_pair: missing \['box', 'camera', 'first"),
        (
            lambda stored: stored.update(small_pair=asdict(CROP) | {"box": [0, 0, 2, 1]}),
            r"expected a camera from 0 and 0 <= top",
        ),
        (lambda stored: stored.update(small_pair=asdict(CROP) | {"first_state_id": 505}), "row 516 .* 512 rows"),
    ],
)
def test_a_declaration_that_cannot_be_is_refused(
    folder: Path, edit: Callable[[dict[str, Any]], None], said: str
) -> None:
    stored = stored_in(folder)
    edit(stored)
    declare(folder, stored)
    with pytest.raises(ValueError, match=said):
        load_ponder(folder)


@pytest.mark.parametrize("values", [[], 7, "ponder"])
def test_a_declaration_that_is_no_object_is_refused(folder: Path, values: object) -> None:
    declare(folder, values)
    with pytest.raises(ValueError, match=r"ponder\.json is no JSON object"):
        load_ponder(folder)


# -- tensors


def test_a_missing_tensor_is_named(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.pop("model.language_model.layers.3.self_attn.q_norm.weight"))
    with pytest.raises(CheckpointError, match=r"1 missing: model\.language_model\.layers\.3\.self_attn\.q_norm"):
        load_ponder(folder)


def test_an_extra_tensor_is_named(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.update(surprise=torch.zeros(1)))
    with pytest.raises(CheckpointError, match="1 unknown: surprise"):
        load_ponder(folder)


def test_a_misshapen_tensor_is_named_with_both_shapes(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.update({"lm_head.weight": torch.zeros(512, 95)}))
    with pytest.raises(CheckpointError, match=r"misshapen: lm_head\.weight expected \(512, 96\) came \(512, 95\)"):
        load_ponder(folder)


def test_many_faults_are_counted_not_listed(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.update({f"x{i}": torch.zeros(1) for i in range(9)}))
    with pytest.raises(CheckpointError, match=r"9 unknown: x0, .* and 1 more"):
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
        (lambda tensors: tensors.pop("mtp.norm.weight"), r"1 missing: mtp\.norm\.weight"),
        (lambda tensors: tensors.update({"mtp.layers.1.norm": torch.zeros(1)}), r"1 unknown: mtp\.layers\.1\.norm"),
        (
            lambda tensors: tensors.update({"mtp.fc.weight": torch.zeros(2, 2)}),
            r"misshapen: mtp\.fc\.weight expected \(96, 192\) came \(2, 2\)",
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
    with pytest.raises(CheckpointError, match=rf"1 not in the file in which the index places them: {name} \({last}\)"):
        load_ponder(tmp_path)


def test_a_tokenizer_of_another_checkpoint_is_noticed(folder: Path) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["image_token_id"] = 7
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="image_token_id is 7"):
        load_ponder(folder)


@pytest.mark.parametrize("lacks", ["rope_theta", "mrope_section"])
def test_a_rotation_is_never_guessed(folder: Path, lacks: str) -> None:
    config = json.loads((folder / "config.json").read_text())
    text, whole = config["text_config"], config["text_config"].pop("rope_parameters")
    text |= {"rope_theta": whole.pop("rope_theta"), "partial_rotary_factor": whole.pop("partial_rotary_factor")}
    text["rope_scaling"] = whole
    (folder / "config.json").write_text(json.dumps(config))
    load_ponder(folder)  # as folders of transformers 4 spell it
    text.pop(lacks, None)
    whole.pop(lacks, None)
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=f"text_config.rope_parameters lacks {lacks}"):
        load_ponder(folder)


def test_another_architecture_is_refused(folder: Path) -> None:
    (folder / "config.json").write_text(json.dumps({"model_type": "llama"}))
    with pytest.raises(CheckpointError, match="'llama'"):
        load_ponder(folder)


@pytest.mark.parametrize("name", ["config.json", "ponder.json", SINGLE_NAME])
def test_a_file_that_was_cut_short_is_named(folder: Path, name: str) -> None:
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=name):
        load_ponder(folder)


def test_a_checkpoint_is_never_overwritten(ponder: Ponder, folder: Path) -> None:
    with pytest.raises(FileExistsError, match="already holds a checkpoint"):
        save_ponder(ponder, folder)


def test_an_empty_folder_says_what_it_needs(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        load_ponder(tmp_path)
