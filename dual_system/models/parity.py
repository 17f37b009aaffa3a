"""``pp-parity``: compares this package's outputs with the public implementations'. One JSON line per golden folder.

Every tensor that a golden expects is compared by its largest absolute error: features, velocity, loss, sampling.
GR00T is run twice, since its head attends to padding: the head alone on the stored features (every row must agree),
and end to end (the rows that the golden names must).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

from dual_system.models import flow
from dual_system.models.flow import EulerStep
from dual_system.models.golden import Golden, GoldenError, read_golden
from dual_system.models.groot import flow as groot_flow
from dual_system.models.groot.pounce import GrootInputs, GrootPounce
from dual_system.models.pi05.pounce import Pounce, PounceInputs
from protocol.command_line import command, parse

AGREES, DISAGREES, UNREADABLE = 0, 1, 2
TOLERANCE = 1e-4

Tensors = dict[str, Tensor]


@dataclass(frozen=True, slots=True, kw_only=True)
class ParityConfig:
    """Runs golden folders through our networks. Exit code 0: within tolerance, 1: not, 2: no golden."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Golden folders, pi0.5 or GR00T N1.5."""
    tolerance: float = TOLERANCE
    """Largest absolute error allowed; masks and buckets must be equal."""


def max_abs_errors(golden: Golden) -> dict[str, float]:
    """Returns the largest absolute error of every compared tensor, by the golden's names.

    Names that begin with ``end_to_end.`` are GR00T's second run. NaN anywhere is an error of infinity.

    Raises:
        GoldenError: a tensor is missing or has another shape than the network's.
    """
    with torch.inference_mode():
        compared = {name: (ours, expected) for name, ours, expected in _compared(golden)}
    return {name: _max_abs_error(name, *pair) for name, pair in compared.items()}


def _compared(golden: Golden) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Pairs our tensors with the expected ones, where both are defined."""
    expected = golden.expected
    if isinstance(golden.model, Pounce):
        yield from _pairs(_run_pi05(golden, golden.model), expected, only={"prefix_hidden": "prefix_pad_mask"})
        return
    features = _groot_features(golden, golden.model)
    yield from _pairs(features, expected | golden.given, only={"backbone_features": "token_mask"})
    stored = expected.get("backbone_features", features["backbone_features"])
    yield from _pairs(_run_head(golden, golden.model, stored), expected, only={})
    rows = list(golden.end_to_end_rows)
    whole = _run_head(golden, golden.model, features["backbone_features"])
    for name in whole.keys() & expected.keys() - {"loss", "time_bucket", "state_features"}:
        yield f"end_to_end.{name}", whole[name][rows], expected[name][rows]


def _pairs(ours: Tensors, expected: Tensors, *, only: dict[str, str]) -> Iterator[tuple[str, Tensor, Tensor]]:
    """``only`` names the mask of a tensor that is defined in some rows only."""
    for name in ours.keys() & expected.keys():
        chosen = expected[only[name]] if name in only else slice(None)
        yield name, ours[name][chosen], expected[name][chosen]


def _run_pi05(golden: Golden, model: Pounce) -> Tensors:
    given = golden.given
    inputs = PounceInputs(
        images=given["images"],
        has_view=given["image_masks"],
        token_ids=given["token_ids"],
        is_token=given["token_mask"],
        age_ns=torch.zeros(len(given["time"]), dtype=torch.int64),
    )
    actions, noise, time = given["actions"], given["noise"], given["time"]
    prefix = model.pi05.embed_prefix(inputs.images, inputs.has_view, inputs.token_ids, inputs.is_token)
    velocity = model.pi05.velocity_at(flow.noised(actions, noise, time), time, model.pi05.prefill(prefix))
    return {
        "prefix_embeds": prefix.embeds,
        "prefix_pad_mask": prefix.is_real,
        "prefix_hidden": model.pi05.prefix_hidden(prefix),
        "time_cond": model.pi05.time_condition(time),
        "velocity": velocity,
        "loss_unreduced": model.unreduced_loss(inputs, actions, noise, time),
        "loss_mean_all": model.loss(inputs, actions, noise, time, over="all")[None],
        "loss_mean_real": model.loss(inputs, actions, noise, time, over="real")[None],
        **_sampled(noise, model.sample(inputs, noise, model.step_table())),
    }


def _groot_features(golden: Golden, model: GrootPounce) -> Tensors:
    given, eagle = golden.given, model.groot.eagle
    vision = eagle.vision_features(given["images"])
    embeds = eagle.input_embeds(vision, given["token_ids"])
    inputs = GrootInputs(
        images=given["images"],
        token_ids=given["token_ids"],
        is_token=given["token_mask"],
        state=given["state"][:, 0],
        embodiment=given["embodiment_id"],
        age_ns=torch.zeros(len(given["time"]), dtype=torch.int64),
    )
    return {"vision_features": vision, "input_embeds": embeds, "backbone_features": model.features(inputs)}


def _run_head(golden: Golden, model: GrootPounce, features: Tensor) -> Tensors:
    """Everything after Eagle."""
    given, groot = golden.given, model.groot
    actions, noise, time = given["actions"], given["noise"], given["time"]
    cache = groot.prefill(features, given["state"][:, 0], given["embodiment_id"])
    velocity = groot.velocity_at(groot_flow.noised(actions, noise, time), time, cache)
    loss = (groot_flow.target_velocity(actions, noise) - velocity).square() * given["action_mask"]
    return {
        "vl_features": groot.mixed(features),
        "state_features": groot.state_features(given["state"][:, 0], given["embodiment_id"]),
        "time_bucket": groot_flow.time_buckets(time, groot.config.num_time_buckets),
        "velocity": velocity,
        "loss_unreduced": loss,
        "loss": groot_flow.masked_mean(loss, given["action_mask"])[None],
        **_sampled(noise, groot.sample(noise, cache, model.step_table())),
    }


def _sampled(noise: Tensor, steps: Iterator[EulerStep]) -> Tensors:
    taken = list(steps)
    return {
        "sample_velocities": torch.stack([step.velocity for step in taken], dim=1),
        "sample_trajectory": torch.stack([noise, *(step.actions for step in taken)], dim=1),
        "actions": taken[-1].actions,
    }


def _max_abs_error(name: str, ours: Tensor, expected: Tensor) -> float:
    if ours.shape != expected.shape:
        raise GoldenError(f"{name}: expected shape {tuple(expected.shape)}, came {tuple(ours.shape)}")
    error = (ours.double() - expected.double()).abs()
    return error.nan_to_num(nan=torch.inf).max().item() if error.numel() else 0.0


def _is_exact(name: str) -> bool:
    return name in ("prefix_pad_mask", "time_bucket")


def report(golden: Golden, tolerance: float) -> dict[str, object]:
    """Returns the fields of one line: which tensors agree, which do not, which were not compared."""
    errors = max_abs_errors(golden)
    failed = [name for name, error in errors.items() if not error <= (0.0 if _is_exact(name) else tolerance)]
    return {
        "golden": golden.name,
        "family": "pi05" if isinstance(golden.model, Pounce) else "groot_n1_5",
        "agrees": not failed,
        "tolerance": tolerance,
        "max_abs_error": dict(sorted(errors.items())),
        "failed": sorted(failed),
        "not_compared": sorted(golden.expected.keys() - errors.keys()),
    }


@command("pp-parity")
def main(argv: list[str] | None = None) -> int:
    config = parse(ParityConfig, argv, prog="pp-parity")
    if not config.folders:
        sys.stderr.write("pp-parity: name at least one golden folder\n")
        return UNREADABLE
    return max(_check(folder, config.tolerance) for folder in config.folders)


def _check(folder: Path, tolerance: float) -> int:
    try:
        fields = report(read_golden(folder), tolerance)
    except (ValueError, OSError) as error:  # GoldenError, WeightsError, or a size that fits no network
        sys.stderr.write(f"pp-parity: {error}\n")
        sys.stdout.write(json.dumps({"golden": folder.name, "agrees": False, "error": str(error)}) + "\n")
        return UNREADABLE
    sys.stdout.write(json.dumps(fields) + "\n")
    return AGREES if fields["agrees"] else DISAGREES
