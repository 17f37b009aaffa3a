"""pp-parity: the public implementations' numbers agree, goldens of any size run, and a wrong number is named."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from dual_system.models import flow
from dual_system.models.golden import GoldenError, read_golden
from dual_system.models.groot import flow as groot_flow
from dual_system.models.groot.pounce import GrootInputs
from dual_system.models.groot.weights import save_weights as save_groot
from dual_system.models.parity import main, max_abs_errors
from dual_system.models.pi05.pounce import PounceInputs
from dual_system.models.pi05.weights import save_weights as save_pi05
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.initialise import random_groot_pounce, random_pounce
from dual_system.models.stored_tensors import WeightsError

COMMITTED = Path(__file__).parent / "data" / "goldens"
SHARED = Path(__file__).parents[3] / "shared" / "goldens"


def _public_golden(name: str) -> Path:
    for root in (COMMITTED, SHARED):
        if (root / name).is_dir():
            return root / name
    pytest.skip(f"golden {name} is neither committed nor in ../shared/goldens beside the checkout")


def _line(folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    code = main([str(folder)])
    (line,) = capsys.readouterr().out.splitlines()
    return code, json.loads(line)


# -- goldens of our own: any size, expected by the model's plain methods


def _random_pi05(folder: Path, sizes: dict[str, int], seed: int) -> None:
    base = tiny_cpu(num_carriers=0)
    language = replace(
        base.pi05.language,
        width=sizes["width"],
        depth=sizes["depth"],
        num_heads=sizes["heads"],
        num_kv_heads=sizes["kv_heads"],
        head_dim=sizes["head_dim"],
    )
    vision = replace(base.pi05.vision, depth=sizes["vision_depth"], image_px=28 * sizes["side"], patch_px=28)
    pi05 = replace(
        base.pi05,
        vision=vision,
        language=language,
        expert=replace(language, width=2 * sizes["width"], mlp_width=24),
        action_dim=sizes["action_dim"],
        horizon=sizes["horizon"],
    )
    config = replace(
        base,
        pi05=pi05,
        num_cameras=sizes["views"],
        num_steps=sizes["steps"],
        robot_action_dim=min(3, sizes["action_dim"]),
    )
    model = random_pounce(config, seed).requires_grad_(False)
    inputs = config.example_inputs(sizes["batch"], seed=seed)
    inputs = replace(inputs, is_token=torch.arange(12) < 12 - torch.arange(sizes["batch"])[:, None])
    given = _given(config, inputs, seed)
    expected = {
        "velocity": model.pi05.velocity_at(
            flow.noised(given["actions"], given["noise"], given["time"]), given["time"], model.prefill(inputs)
        ),
        "loss_unreduced": model.unreduced_loss(inputs, given["actions"], given["noise"], given["time"]),
        "loss_mean_real": model.loss(inputs, given["actions"], given["noise"], given["time"])[None],
        "actions": list(model.sample(inputs, given["noise"], model.step_table()))[-1].actions,
    }
    streams = {
        name: {
            "width": stream.width,
            "depth": stream.depth,
            "heads": stream.num_heads,
            "kv_heads": stream.num_kv_heads,
            "head_dim": stream.head_dim,
            "mlp": stream.mlp_width,
        }
        for name, stream in (("llm", pi05.language), ("expert", pi05.expert))
    }
    streams["llm"]["vocab"] = pi05.vocab_size
    _write(folder, "pi05", config, vision, streams, given, expected)
    save_pi05(model, folder / "weights.safetensors")


def _random_groot(folder: Path, sizes: dict[str, int], seed: int) -> None:
    base = tiny_groot(num_carriers=0)
    eagle, heads = base.groot.eagle, sizes["width"] // 8
    vision = replace(eagle.vision, depth=sizes["vision_depth"], image_px=28 * sizes["side"], patch_px=28)
    language = replace(
        eagle.language,
        width=sizes["width"],
        depth=sizes["depth"],
        num_heads=sizes["heads"],
        num_kv_heads=sizes["kv_heads"],
        head_dim=sizes["head_dim"],
    )
    groot = replace(
        base.groot,
        eagle=replace(eagle, vision=vision, language=language),
        mixer=replace(base.groot.mixer, num_heads=heads, head_dim=8, depth=sizes["depth"]),
        dit=replace(base.groot.dit, num_heads=2, head_dim=6, depth=sizes["dit_depth"]),
        action_dim=sizes["action_dim"],
        horizon=sizes["horizon"],
        num_embodiments=sizes["embodiments"],
        num_future_tokens=sizes["depth"],
    )
    config = replace(
        base,
        groot=groot,
        embodiment=0,
        num_cameras=sizes["views"],
        num_steps=sizes["steps"],
        robot_action_dim=min(3, sizes["action_dim"]),
    )
    model = random_groot_pounce(config, seed).requires_grad_(False)
    batch_size = sizes["batch"]
    inputs = config.example_inputs(batch_size, seed=seed)
    inputs = replace(inputs, embodiment=torch.arange(batch_size) % sizes["embodiments"])
    given = _given(config, inputs, seed) | {
        "state": inputs.state[:, None],
        "embodiment_id": inputs.embodiment,
        "action_mask": (torch.arange(groot.action_dim) < 3).float().expand(batch_size, groot.horizon, -1).contiguous(),
    }
    batch = inputs, given["actions"], given["noise"], given["time"]
    x = groot_flow.noised(given["actions"], given["noise"], given["time"])
    expected = {
        "backbone_features": model.features(inputs),
        "velocity": model.groot.velocity_at(x, given["time"], model.prefill(inputs)),
        "loss_unreduced": model.unreduced_loss(*batch) * given["action_mask"],
        "loss": model.loss(*batch, action_mask_BNA=given["action_mask"])[None],
        "actions": list(model.sample(inputs, given["noise"], model.step_table()))[-1].actions,
    }
    parts = {
        "llm": {
            "width": language.width,
            "depth": language.depth,
            "heads": language.num_heads,
            "kv_heads": language.num_kv_heads,
            "head_dim": language.head_dim,
            "mlp": language.mlp_width,
            "vocab": language.vocab_size,
            "rope_theta": language.rope_base,
            "rms_norm_eps": language.norm_eps,
        },
        "select_layer": language.depth,
        "image_token_id": groot.eagle.image_token_id,
        "vl_mixer": {"depth": groot.mixer.depth, "heads": heads, "head_dim": 8, "mlp": groot.mixer.mlp_width},
        "dit": {
            "depth": groot.dit.depth,
            "heads": 2,
            "head_dim": 6,
            "mlp": groot.dit.mlp_width,
            "timestep_channels": groot.time_channels,
        },
        "head": {
            "hidden": groot.hidden_width,
            "max_num_embodiments": groot.num_embodiments,
            "future_tokens": groot.num_future_tokens,
            "max_seq_len": groot.max_actions,
            "num_timestep_buckets": groot.num_time_buckets,
        },
        "state_dim": groot.state_dim,
        "real_state_dim": config.robot_state_dim,
        "end_to_end_rows": list(range(batch_size)),
    }
    _write(folder, "groot_n1_5", config, vision, parts, given, expected)
    save_groot(model, folder / "weights.safetensors")


def _given(config: Any, inputs: PounceInputs | GrootInputs, seed: int) -> dict[str, Tensor]:
    batch_size, num_views = inputs.images.shape[:2]
    return {
        "images": inputs.images,
        "image_masks": torch.ones(batch_size, num_views, dtype=torch.bool),
        "token_ids": inputs.token_ids,
        "token_mask": inputs.is_token,
        "actions": config.example_actions(batch_size, seed=seed),
        "noise": torch.randn(
            batch_size,
            config.horizon,
            config.padded_action_dim,
            generator=torch.Generator().manual_seed(seed),
        ),
        "time": torch.linspace(0.1, 0.9, batch_size),
    }


def _write(
    folder: Path,
    family: str,
    config: Any,
    vision: Any,
    parts: dict[str, Any],
    given: dict[str, Tensor],
    expected: dict[str, Tensor],
) -> None:
    folder.mkdir()
    sizes = {
        "family": family,
        "vision": {
            "hidden": vision.width,
            "depth": vision.depth,
            "heads": vision.num_heads,
            "mlp": vision.mlp_width,
            "image_size": vision.image_px,
            "patch": vision.patch_px,
        },
        "action_dim": config.padded_action_dim,
        "real_action_dim": config.robot_action_dim,
        "horizon": config.horizon,
        "num_steps": config.num_steps,
        "views": config.num_cameras,
    }
    (folder / "config.json").write_text(json.dumps(sizes | parts))
    save_file(given, folder / "inputs.safetensors")
    save_file(expected, folder / "expected.safetensors")


SIZES = {
    "smallest": {
        "batch": 1, "views": 1, "side": 1, "vision_depth": 1, "width": 8, "depth": 1, "heads": 1, "kv_heads": 1,
        "head_dim": 4, "dit_depth": 1, "action_dim": 3, "horizon": 1, "steps": 1, "embodiments": 1,
    },
    "odd": {
        "batch": 3, "views": 3, "side": 2, "vision_depth": 3, "width": 24, "depth": 5, "heads": 6, "kv_heads": 3,
        "head_dim": 10, "dit_depth": 5, "action_dim": 7, "horizon": 33, "steps": 7, "embodiments": 5,
    },
}  # fmt: skip
WRITERS: dict[str, Callable[[Path, dict[str, int], int], None]] = {"pi05": _random_pi05, "groot": _random_groot}


@pytest.fixture(params=WRITERS)
def own_golden(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    WRITERS[request.param](tmp_path / "own", SIZES["smallest"], 0)
    return tmp_path / "own"


@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES.keys())
@pytest.mark.parametrize("writer", WRITERS.values(), ids=WRITERS.keys())
def test_goldens_of_any_size_run(
    writer: Callable[[Path, dict[str, int], int], None],
    sizes: dict[str, int],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    writer(tmp_path / "own", sizes, 5)
    code, line = _line(tmp_path / "own", capsys)
    assert (code, line["failed"], line["not_compared"]) == (0, [], [])
    assert {"velocity", "loss_unreduced", "actions"} <= line["max_abs_error"].keys()


# -- the public implementations


@pytest.mark.parametrize("name", ["pi05_base", "pi05_three_views", "groot_base"])
def test_public_implementations_agree_to_a_ten_thousandth(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, line = _line(_public_golden(name), capsys)
    assert (code, line["agrees"], line["failed"]) == (0, True, [])
    assert line["not_compared"] == [], "every tensor of the golden is looked at"
    assert max(line["max_abs_error"].values()) < 1e-4


def test_padding_that_looks_nowhere_agrees_too() -> None:
    """The golden does not ask for it, because attention kernels differ there; ours averages, as the public one does."""
    golden = read_golden(_public_golden("groot_base"))
    assert golden.end_to_end_rows == (0, 1)
    assert not golden.given["token_mask"][2].all()
    errors = max_abs_errors(replace(golden, end_to_end_rows=(0, 1, 2)))
    assert errors["end_to_end.actions"] < 1e-4


# -- what must not pass


def _change(folder: Path, name: str, change: Callable[[Tensor], Tensor]) -> None:
    tensors = load_file(folder / "expected.safetensors")
    tensors[name] = change(tensors[name]).contiguous()
    save_file(tensors, folder / "expected.safetensors")


@pytest.mark.parametrize("name", ["velocity", "loss_unreduced", "actions"])
def test_one_wrong_number_is_named_and_fails(own_golden: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    def nudge(tensor: Tensor) -> Tensor:
        tensor.view(-1)[-1] += 2e-4
        return tensor

    _change(own_golden, name, nudge)
    code, line = _line(own_golden, capsys)
    assert code == 1
    assert {failed.removeprefix("end_to_end.") for failed in line["failed"]} == {name}


def test_nan_is_no_agreement(own_golden: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _change(own_golden, "actions", lambda tensor: torch.full_like(tensor, torch.nan))
    code, line = _line(own_golden, capsys)
    assert (code, line["agrees"]) == (1, False)


def test_a_tensor_that_nobody_knows_is_reported(own_golden: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tensors = load_file(own_golden / "expected.safetensors")
    save_file(tensors | {"entropy": torch.zeros(1)}, own_golden / "expected.safetensors")
    code, line = _line(own_golden, capsys)
    assert (code, line["not_compared"]) == (0, ["entropy"])


def test_the_tolerance_is_an_option(own_golden: Path) -> None:
    _change(own_golden, "velocity", lambda tensor: tensor + 1e-3)
    assert main([str(own_golden)]) == 1
    assert main([str(own_golden), "--tolerance", "0.01"]) == 0


def _without(folder: Path, file: str, name: str) -> None:
    tensors = load_file(folder / file)
    del tensors[name]
    save_file(tensors, folder / file)


def _set(folder: Path, name: str, value: object) -> None:
    sizes = json.loads((folder / "config.json").read_text())
    *path, last = name.split(".")
    record = sizes
    for part in path:
        record = record.setdefault(part, {})
    record[last] = value
    (folder / "config.json").write_text(json.dumps(sizes))


BROKEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "no weights": (lambda folder: (folder / "weights.safetensors").unlink(), "has no weights.safetensors"),
    "no config": (lambda folder: (folder / "config.json").unlink(), "config.json"),
    "config is no object": (lambda folder: (folder / "config.json").write_text("[]") and None, "holds a list"),
    "no size": (lambda folder: _set(folder, "llm.mlp", None), "no llm.mlp"),
    "another family": (lambda folder: _set(folder, "family", "gr00t_n1_7"), "family is 'gr00t_n1_7', expected 'pi05'"),
    "another gelu": (lambda folder: _set(folder, "vision.activation", "gelu"), "vision.activation is 'gelu', built"),
    "heads that do not fit": (lambda folder: _set(folder, "vision.heads", 7), "does not split into 7 heads"),
    "another width": (lambda folder: _set(folder, "llm.mlp", 5), "misshapen"),
    "inputs lack one": (lambda folder: _without(folder, "inputs.safetensors", "noise"), "no noise"),
    "nothing expected": (lambda folder: _without(folder, "expected.safetensors", "velocity"), "no velocity"),
    "a shape of its own": (
        lambda folder: _change(folder, "actions", lambda tensor: tensor[..., :1]),
        "actions: expected shape",
    ),
}


@pytest.mark.parametrize(("damage", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_a_folder_that_is_no_golden_says_why(
    own_golden: Path, damage: Callable[[Path], None], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(own_golden)
    assert main([str(own_golden)]) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert message in json.loads(said.out)["error"]


def test_misread_sizes_are_refused_when_read(own_golden: Path) -> None:
    _set(own_golden, "llm.depth", 2)
    with pytest.raises((WeightsError, GoldenError, ValueError), match=r"llm|language|missing|select_layer"):
        read_golden(own_golden)


def test_without_a_folder_it_says_what_to_type(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "name at least one golden folder" in capsys.readouterr().err
