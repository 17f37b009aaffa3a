"""The checkpoint folder: all of a bundle survives it, and a public folder gets a flagged fresh prefix."""

import functools
import json
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from dual_system.models.interface import CognitionConfig
from dual_system.models.normalisation import ROBOMME, Quantiles, RobotStatistics
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import in_space, pi05_base, tiny_cpu, tiny_groot
from dual_system.models.pounce.family import AnyPounceConfig
from dual_system.models.stored_tensors import CheckpointError


@pytest.fixture(scope="module")
def bundle() -> PounceBundle:
    return random_bundle(tiny_cpu(num_carriers=2), seed=0)


@pytest.fixture
def folder(bundle: PounceBundle, tmp_path: Path) -> Path:
    save_bundle(bundle, tmp_path)
    return tmp_path


def _make_public(folder: Path) -> None:
    """Strips a folder to what openpi publishes: pi0.5 tensors and a config in another dialect."""
    path = folder / "model.safetensors"
    save_file({n: tensor for n, tensor in load_file(path).items() if not n.startswith("pounce_prefix.")}, path)
    (folder / "config.json").write_text('{"action_dim": 32, "paligemma_variant": "gemma_2b"}')


def test_a_bundle_survives_its_folder(bundle: PounceBundle, folder: Path) -> None:
    loaded = load_bundle(folder)
    assert loaded.model.config == bundle.model.config
    assert loaded.statistics == bundle.statistics
    assert (loaded.is_random, loaded.has_fresh_prefix) == (True, True)
    assert loaded.digest() == bundle.digest()


def test_flags_of_trained_weights_survive(bundle: PounceBundle, tmp_path: Path) -> None:
    save_bundle(replace(bundle, is_random=False, has_fresh_prefix=False), tmp_path)
    loaded = load_bundle(tmp_path)
    assert (loaded.is_random, loaded.has_fresh_prefix) == (False, False)


def test_digest_tells_every_ingredient_apart(bundle: PounceBundle) -> None:
    longer = RobotStatistics(state=ROBOMME.state, action=Quantiles(q01=(-9.0,) * 8, q99=(9.0,) * 8))
    digests = [
        bundle.digest(),
        random_bundle(bundle.model.config, seed=1).digest(),
        random_bundle(replace(bundle.model.config, num_steps=5), seed=0).digest(),
        replace(bundle, statistics=longer).digest(),
    ]
    assert len(set(digests)) == len(digests)
    assert random_bundle(bundle.model.config, seed=0).digest() == digests[0]


def test_public_folder_loads_with_a_fresh_flagged_prefix(bundle: PounceBundle, folder: Path) -> None:
    _make_public(folder)
    loaded = load_bundle(folder, config=bundle.model.config)
    assert (loaded.is_random, loaded.has_fresh_prefix) == (False, True)
    assert torch.equal(loaded.model.pi05.action_in_proj.weight, bundle.model.pi05.action_in_proj.weight)
    assert loaded.digest() == load_bundle(folder, config=bundle.model.config).digest(), "seeded, not arbitrary"
    text_rms = bundle.model.pi05.language.embed_tokens.weight.square().mean().sqrt() * 64**0.5
    cognition = torch.randn(200, 2, 64, generator=torch.Generator().manual_seed(0))
    tokens = loaded.model.cognition_prefix(cognition, torch.zeros(200, dtype=torch.int64))[:, 1:]
    assert tokens.square().mean().sqrt().item() == pytest.approx(text_rms.item(), rel=0.1)


def test_public_folder_without_carriers_has_no_prefix_to_flag(bundle: PounceBundle, folder: Path) -> None:
    _make_public(folder)
    config = replace(bundle.model.config, cognition=CognitionConfig(num_carriers=0))
    assert load_bundle(folder, config=config).has_fresh_prefix is False


def test_sizes_of_a_public_folder_are_read_off_its_tensors(
    bundle: PounceBundle, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _make_public(folder)
    found, own = load_bundle(folder).model.config, bundle.model.config
    assert isinstance(found, PounceConfig)
    assert isinstance(own, PounceConfig)
    heads = pi05_base().pi05.vision.num_heads
    sizes = replace(own.pi05, vision=replace(own.pi05.vision, num_heads=heads), horizon=found.horizon)
    assert found == replace(pi05_base(), pi05=sizes, control_hz=0)
    assert "language.depth 3 (18)" in caplog.text
    assert f"SigLIP's {heads} heads, which no file says, are assumed" in caplog.text


def test_a_public_folder_without_a_stream_is_told(folder: Path) -> None:
    _make_public(folder)
    tensors = load_file(folder / "model.safetensors")
    kept = {name: tensor for name, tensor in tensors.items() if "gemma_expert" not in name}
    save_file(kept, folder / "model.safetensors")
    with pytest.raises(ValueError, match=r"no tensor .*gemma_expert.*sizes are read from it"):
        load_bundle(folder)


def test_missing_files_are_named(folder: Path) -> None:
    (folder / "tokenizer.model").unlink()
    with pytest.raises(FileNotFoundError, match="--tokenizer"):
        load_bundle(folder)
    (folder / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"no model\.safetensors"):
        load_bundle(folder)


def test_two_configs_for_one_folder_are_refused(bundle: PounceBundle, folder: Path) -> None:
    with pytest.raises(ValueError, match=r"has its own config\.json"):
        load_bundle(folder, config=bundle.model.config)


def field_paths(record: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Of all fields at their defaults, in records of records."""
    for each in fields(record):
        value = getattr(record, each.name)
        if value == each.default:
            yield (*path, each.name)
        elif is_dataclass(value):
            yield from field_paths(value, (*path, each.name))


@pytest.mark.parametrize("config", [tiny_cpu(), tiny_groot()], ids=["pi05", "groot"])
def test_a_field_at_its_default_may_be_left_out(config: AnyPounceConfig, tmp_path: Path) -> None:
    """So a field that is added later leaves older folders as they are, digest included."""
    bundle = random_bundle(config, seed=0)
    save_bundle(bundle, tmp_path)
    stored = json.loads((tmp_path / "config.json").read_text())
    paths = [path for path in field_paths(bundle.stored_config()) if path != ("format",)]
    assert {("config", "max_prompt_tokens"), ("config", "cognition", "gradient_scale")} <= set(paths)
    for *parents, name in paths:
        del functools.reduce(lambda inside, parent: inside[parent], parents, stored)[name]
    (tmp_path / "config.json").write_text(json.dumps(stored))
    loaded = load_bundle(tmp_path)
    assert loaded.model.config == bundle.model.config
    assert loaded.digest() == bundle.digest()


def test_an_unknown_field_is_refused(folder: Path) -> None:
    stored = json.loads((folder / "config.json").read_text())
    stored["config"]["cognition"]["colour"] = 1
    (folder / "config.json").write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"config\.json\.config\.cognition: missing \[\], unknown \['colour'\]"):
        load_bundle(folder)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (
            ("config", "pi05", "vision", "width"),
            r"config\.json\.config\.pi05\.vision: missing \['width'\], unknown \[\]",
        ),
        (("statistics",), r"config\.json: missing \['statistics'\]"),
    ],
)
def test_a_config_with_a_hole_names_it(folder: Path, path: tuple[str, ...], message: str) -> None:
    stored = json.loads((folder / "config.json").read_text())
    record = stored
    for name in path[:-1]:
        record = record[name]
    del record[path[-1]]
    (folder / "config.json").write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=message):
        load_bundle(folder)


def test_files_that_are_not_what_they_are_called_are_refused(folder: Path) -> None:
    (folder / "tokenizer.model").write_bytes(b"not a tokenizer")
    with pytest.raises(ValueError, match="no SentencePiece model"):
        load_bundle(folder)
    (folder / "model.safetensors").write_bytes(b"not weights")
    with pytest.raises(CheckpointError, match=r"model\.safetensors is no safetensors file"):
        load_bundle(folder)


def test_parts_that_do_not_fit_each_other_are_refused(bundle: PounceBundle) -> None:
    small = random_bundle(replace(tiny_cpu(), robot_action_dim=8), seed=0)
    vocabulary = replace(small.model.config.pi05, vocab_size=100)
    with pytest.raises(ValueError, match="tokenizer has 512 ids, the model embeds 100"):
        random_bundle(replace(small.model.config, pi05=vocabulary), seed=0)
    with pytest.raises(ValueError, match="statistics describe 8 action dims, the config 7"):
        random_bundle(replace(small.model.config, robot_action_dim=7), seed=0)


EE = RobotStatistics(
    state=Quantiles(q01=(-1.0,) * 7, q99=(1.0,) * 7),
    action=Quantiles(q01=(-0.1,) * 7, q99=(0.1,) * 7),
    space="ee_delta",
)


@pytest.mark.parametrize("config", [tiny_cpu(), tiny_groot()], ids=["pi05", "groot"])
def test_the_action_space_survives_its_folder(config: AnyPounceConfig, tmp_path: Path) -> None:
    save_bundle(random_bundle(in_space(config, "ee_delta"), 0, statistics=EE), tmp_path)
    assert load_bundle(tmp_path).statistics == EE


def test_an_unknown_action_space_is_refused_by_name(folder: Path) -> None:
    stored = json.loads((folder / "config.json").read_text())
    stored["statistics"]["space"] = "ee_pose"
    (folder / "config.json").write_text(json.dumps(stored))
    with pytest.raises(
        ValueError, match=r"statistics\.space: expected 'joint_delta' or 'ee_delta' or 'native', came 'ee_pose'"
    ):
        load_bundle(folder)


@pytest.mark.parametrize("config", [tiny_cpu(), tiny_groot()], ids=["pi05", "groot"])
def test_a_config_in_another_space_than_the_statistics_is_refused(config: AnyPounceConfig) -> None:
    with pytest.raises(ValueError, match=r"statistics describe 7 \w+ dims, the config 8; with their action space 'ee_"):
        random_bundle(config, 0, statistics=EE)
    with pytest.raises(ValueError, match=r"statistics describe 8 \w+ dims, the config 7; with .*'joint_delta'"):
        random_bundle(in_space(config, "ee_delta"), 0)
