"""The engine's contract: equal requests give equal bits, a heartbeat per step, a plain no to misfits."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_system.models.normalisation import ROBOMME
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu
from pounce_server.contract import PounceEngine, Request, example_request
from pounce_server.engine import EagerEngine


@pytest.fixture(scope="module")
def engine() -> EagerEngine:
    return EagerEngine(random_bundle(tiny_cpu(num_carriers=2, cognition_size=24), seed=0))


@pytest.fixture
def request_(engine: EagerEngine) -> Request:
    return example_request(engine.spec)


def test_engine_is_a_pounce_engine_that_admits_to_be_random(engine: EagerEngine) -> None:
    contract: PounceEngine = engine
    spec = contract.spec
    assert (spec.horizon, spec.action_dim, spec.proprio_dim) == (20, 8, 8)
    assert (spec.num_carriers, spec.cognition_size, spec.num_cameras) == (2, 24, 2)
    assert (spec.is_random, spec.has_fresh_prefix, spec.dtype) == (True, True, "float32")


def test_the_contract_needs_no_torch() -> None:
    script = "import sys, pounce_server.contract; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


def test_rows_are_finite_absolute_targets_that_vary(engine: EagerEngine, request_: Request) -> None:
    rows = engine.invoke(request_)
    assert rows.shape == (20, 8)
    assert rows.dtype == np.float32
    assert np.isfinite(rows).all()
    assert np.abs(rows[:, 7]).max() <= 1.0
    reach = np.asarray(ROBOMME.action.q99[:7]) - np.asarray(ROBOMME.action.q01[:7])
    away = np.abs(rows[:, :7] - request_.proprio[:7])
    assert (away < 4 * reach).all(), "a random model stays near the current state"
    assert (rows[:, :7].std(axis=0) > 1e-3).all()


def test_same_request_same_bits(engine: EagerEngine, request_: Request) -> None:
    first = engine.invoke(request_)
    engine.invoke(replace(request_, seed=99, cognition=None, age_ns=0))
    np.testing.assert_array_equal(engine.invoke(request_), first)


def test_bits_survive_the_checkpoint_folder(engine: EagerEngine, request_: Request, tmp_path: Path) -> None:
    save_bundle(random_bundle(tiny_cpu(num_carriers=2, cognition_size=24), seed=0), tmp_path)
    reloaded = EagerEngine(load_bundle(tmp_path))
    assert reloaded.spec == engine.spec
    np.testing.assert_array_equal(reloaded.invoke(request_), engine.invoke(request_))


CHANGES: dict[str, dict[str, Any]] = {
    "seed": {"seed": 1},
    "instruction": {"instruction": "put the peg into the box"},
    "frames": {"frames": (np.zeros((256, 256, 3), np.uint8), np.full((256, 256, 3), 255, np.uint8))},
    "missing camera": {"frames": (np.zeros((256, 256, 3), np.uint8), None)},
    "proprio": {"proprio": np.full(8, 0.3, np.float32)},
    "cognition": {"cognition": np.ones((2, 24), np.float32)},
    "null": {"cognition": None, "age_ns": 0},
    "age": {"age_ns": 2_000_000_000},
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_every_input_moves_the_rows(engine: EagerEngine, request_: Request, change: dict[str, Any]) -> None:
    changed = replace(request_, **change)
    offset = changed.proprio[:7] - request_.proprio[:7]  # the trivial part: rows are relative to proprio
    moved = engine.invoke(changed)[:, :7] - engine.invoke(request_)[:, :7] - offset
    assert np.abs(moved).max() > 1e-4


def test_bits_do_not_depend_on_where_an_array_lies(engine: EagerEngine, request_: Request) -> None:
    first = engine.invoke(request_)
    for offset in range(1, 16):
        buffer = np.zeros(64 + offset, np.float32)
        cognition = buffer[offset : offset + 48].reshape(2, 24)
        cognition[:] = request_.cognition
        np.testing.assert_array_equal(engine.invoke(replace(request_, cognition=cognition)), first)


def test_progress_beats_once_per_flow_step(engine: EagerEngine, request_: Request) -> None:
    beats: list[None] = []
    engine.invoke(request_, lambda: beats.append(None))
    assert len(beats) == engine.spec.num_steps == 10


def test_any_frame_size_is_accepted(engine: EagerEngine, request_: Request) -> None:
    frames = (np.zeros((480, 640, 3), np.uint8), np.zeros((1, 1, 3), np.uint8))
    assert np.isfinite(engine.invoke(replace(request_, frames=frames))).all()


def test_warm_up_measures_at_least_twenty(engine: EagerEngine) -> None:
    durations_ns = engine.warm_up()
    assert len(durations_ns) >= 20
    assert all(isinstance(duration_ns, int) and duration_ns > 0 for duration_ns in durations_ns)


FRAME = np.zeros((8, 8, 3), np.uint8)
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "one frame": ({"frames": (FRAME,)}, "expected 2 frames, .* came 1"),
    "blind": ({"frames": (None, None)}, "all 2 cameras are missing"),
    "float frame": (
        {"frames": (FRAME, FRAME.astype(np.float32))},
        r"frame 1: expected .* uint8, came .* float32",
    ),
    "grey frame": ({"frames": (FRAME[..., 0], FRAME)}, r"frame 0: expected \(h, w, 3\) uint8, came \(8, 8\)"),
    "empty frame": ({"frames": (FRAME[:0], FRAME)}, r"frame 0: .* came \(0, 8, 3\)"),
    "short proprio": ({"proprio": np.zeros(7, np.float32)}, r"proprio: expected \(8,\) float32, came \(7,\)"),
    "double proprio": ({"proprio": np.zeros(8)}, "proprio: expected .* came .* float64"),
    "nan proprio": (
        {"proprio": np.array([0, math.nan] * 4, np.float32)},
        "proprio: .* 4 that are not, first at 1",
    ),
    "wide cognition": (
        {"cognition": np.zeros((2, 25), np.float32)},
        r"cognition: expected \(2, 24\) .*came \(2, 25\)",
    ),
    "inf cognition": ({"cognition": np.full((2, 24), np.inf, np.float32)}, "cognition: expected finite"),
    "negative seed": ({"seed": -1}, "seed: expected 0 <= seed .* came -1"),
    "negative age": ({"age_ns": -1}, "must not be negative, came -1"),
    "old null": ({"cognition": None}, "null cognition has age 0 .* came age_ns 300000000"),
    "no words": ({"instruction": " \n"}, "instruction is empty"),
    "too many words": ({"instruction": "cube " * 500}, "prompt has .* tokens, expected at most 200 .* shorten"),
}


@pytest.mark.parametrize(("change", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_misfits_are_refused_by_name(
    engine: EagerEngine, request_: Request, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        engine.invoke(replace(request_, **change))


def test_without_carriers_cognition_is_refused_and_null_accepted() -> None:
    engine = EagerEngine(random_bundle(tiny_cpu(num_carriers=0), seed=0))
    request = example_request(engine.spec)
    assert request.cognition is None
    assert engine.spec.has_fresh_prefix is False
    assert np.isfinite(engine.invoke(request)).all()
    with pytest.raises(ValueError, match=r"no cognition \(K = 0\)"):
        engine.invoke(replace(request, cognition=np.zeros((1, 64), np.float32)))


def test_bfloat16_rows_stay_near_float32(engine: EagerEngine, request_: Request) -> None:
    half = EagerEngine(random_bundle(tiny_cpu(num_carriers=2, cognition_size=24), seed=0), dtype="bfloat16")
    assert half.spec.dtype == "bfloat16"
    error = np.abs(half.invoke(request_) - engine.invoke(request_))
    assert 0.0 < error.mean() < 1e-2


def test_unknown_dtype_is_refused() -> None:
    with pytest.raises(ValueError, match="came 'float16'"):
        EagerEngine(random_bundle(tiny_cpu(), seed=0), dtype="float16")
