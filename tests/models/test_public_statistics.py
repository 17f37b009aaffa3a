"""A public folder's own normalisation statistics are used or refused, and never replaced without a word."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from safetensors.torch import load_file, save_file

from dual_system.models.normalisation import ROBOMME
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.models.public_statistics import read_statistics


def tables(num_dims: int = 8, **changes: Any) -> dict[str, Any]:
    of = {"mean": [0.0], "std": [1.0], "q01": [-9.0] * num_dims, "q99": [9.0] * num_dims}
    return {"norm_stats": {"state": of, "actions": of | {"q99": [5.0] * num_dims}} | changes}


def put(folder: Path, name: str, values: object) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(values))


@pytest.mark.parametrize("name", ["norm_stats.json", "assets/droid/norm_stats.json", "assets/lab/arm/norm_stats.json"])
def test_openpi_s_quantiles_are_read(tmp_path: Path, name: str) -> None:
    put(tmp_path, name, tables())
    found = read_statistics(tmp_path)
    assert found is not None
    assert (found.state.q01, found.action.q99, found.space) == ((-9.0,) * 8, (5.0,) * 8, "joint_delta")


def test_the_folder_s_own_file_overrules_the_others(tmp_path: Path) -> None:
    for name in ("norm_stats.json", "assets/a/norm_stats.json", "assets/b/norm_stats.json"):
        put(tmp_path, name, tables())
    assert read_statistics(tmp_path) is not None


PADDED = {"q01": [-1.0] * 8 + [0.0] * 24, "q99": [1.0] * 8 + [0.0] * 24}


def test_padding_is_cut_off(tmp_path: Path) -> None:
    put(tmp_path, "norm_stats.json", tables(state=PADDED, actions=PADDED))
    found = read_statistics(tmp_path)
    assert found is not None
    assert found.state.q99 == (1.0,) * 8


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (tables(14), r"state\.q01: expected 8 finite numbers, came \[-9"),
        (tables(7), r"state\.q01: expected 8 finite numbers"),
        (tables(state={"mean": [0], "std": [1]}), r"state\.q01: expected 8 finite numbers, came None"),
        (tables(actions={"q01": [float("nan")] * 8, "q99": [1] * 8}), r"actions\.q01: expected 8 finite numbers"),
        (tables(actions={"q01": [0] * 8, "q99": [10**400] * 8}), r"actions\.q99: expected 8 finite numbers, came"),
        (tables(actions={"q01": [2] * 8, "q99": [1] * 8}), "exceeds q99"),
        (tables(actions=None), r"actions\.q01: expected"),
        ({"norm_stats": 3}, "expected norm_stats to be an object"),
        ([], "is no JSON object"),
        (tables() | {"delta_mask": [True] * 8}, r"delta_mask is .*, expected .*False\]: joint deltas and a gripper"),
    ],
)
def test_statistics_of_another_robot_are_refused_with_the_file(tmp_path: Path, values: object, said: str) -> None:
    put(tmp_path, "norm_stats.json", values)
    with pytest.raises(ValueError, match=said) as error:
        read_statistics(tmp_path)
    assert "norm_stats.json" in str(error.value)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("assets/a/norm_stats.json", "assets/b/norm_stats.json"), "brings 2 files of normalisation statistics"),
        (("policy_preprocessor_step_5_normalizer_processor.safetensors",), "action space that it does not name"),
        (("experiment_cfg/metadata.json",), "action space that it does not name"),
    ],
)
def test_statistics_that_say_not_what_they_are_are_refused_with_the_way_out(
    tmp_path: Path, names: tuple[str, ...], said: str
) -> None:
    for name in names:
        put(tmp_path, name, tables())
    with pytest.raises(ValueError, match=rf"{said}.*into {tmp_path / 'norm_stats.json'}"):
        read_statistics(tmp_path)


@pytest.fixture(scope="module")
def public(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as openpi publishes one."""
    folder = tmp_path_factory.mktemp("public")
    save_bundle(random_bundle(tiny_cpu(), seed=0), folder)
    (folder / "config.json").unlink()
    path = folder / "model.safetensors"
    save_file({n: tensor for n, tensor in load_file(path).items() if not n.startswith("pounce_prefix.")}, path)
    put(folder, "assets/robomme/norm_stats.json", tables())
    return folder


def test_a_bundle_acts_with_the_folder_s_statistics(public: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert load_bundle(public, config=tiny_cpu()).statistics == read_statistics(public) != ROBOMME
    assert "robomme/norm_stats.json" in caplog.text


def test_given_statistics_replace_them_and_the_log_says_so(public: Path, caplog: pytest.LogCaptureFixture) -> None:
    given = replace(ROBOMME, reach=(1.0,) * 20)
    with caplog.at_level(logging.WARNING):
        assert load_bundle(public, config=tiny_cpu(), statistics=given).statistics == given
    assert "in place of" in caplog.text
    assert "robomme/norm_stats.json" in caplog.text
