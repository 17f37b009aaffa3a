"""Noise: a seed's alone, none in clean episodes, none at contact; and the label is what the oracle said."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.data import rollout
from dual_system.data.dart import DART, Dart, DartConfig, episode_std_rad
from dual_system.data.episode import Row
from dual_system.data.jobs import Job, Look
from dual_system.data.rollout import play
from dual_system.tasks.clearance import Clearance
from dual_system.tasks.environment import Environment, make_environment

TASK = "VideoUnmask"
SEEDS = range(3, 40)
CLEAN = next(seed for seed in SEEDS if episode_std_rad("dart", seed) == 0.0)
NOISY = next(seed for seed in SEEDS if episode_std_rad("dart", seed) > 0.02)


def job(**changes: object) -> Job:
    values = {"task": TASK, "slot": 6, "image_px": 32, "max_steps": 1300, "look": Look(), "noise": "dart"}
    return Job(**values | changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def environment() -> Iterator[Environment]:
    with make_environment(TASK, render=False) as env:
        yield env


def played(environment: Environment, seed: int, **changes: object) -> list[Row]:
    found: list[Row] = []
    play(environment, job(**changes), seed, take=lambda row, frames: found.append(row))
    return found


@pytest.fixture(scope="module")
def noisy(environment: Environment) -> list[Row]:
    return played(environment, NOISY)


def executed(rows: list[Row]) -> np.ndarray:
    return np.stack([row.action if row.executed_action is None else row.executed_action for row in rows])


def labels(rows: list[Row]) -> np.ndarray:
    return np.stack([row.action for row in rows])


def test_one_seed_is_one_episode_whatever_was_played_before(environment: Environment, noisy: list[Row]) -> None:
    played(environment, CLEAN)
    again = played(environment, NOISY)
    np.testing.assert_array_equal(executed(again), executed(noisy))
    np.testing.assert_array_equal([row.state for row in again], [row.state for row in noisy])


def test_the_label_is_what_the_oracle_says_and_the_other_column_what_was_done(
    environment: Environment, noisy: list[Row], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[np.ndarray] = []
    done: list[np.ndarray] = []
    oracle, step = environment.oracle, environment.step

    def listening(motions: object) -> Iterator[np.ndarray]:
        for action in oracle(motions):  # type: ignore[arg-type]
            said.append(action.copy())
            yield action

    def watching(action: np.ndarray, **how: bool) -> object:
        done.append(action)
        return step(action, **how)

    monkeypatch.setattr(environment, "oracle", listening)
    monkeypatch.setattr(environment, "step", watching)
    own = [row for row in played(environment, NOISY) if not row.is_demonstration]
    np.testing.assert_array_equal(labels(own), said)
    np.testing.assert_array_equal(executed(own), done)
    off_rad = np.abs(executed(own) - labels(own))[:, :7]
    assert off_rad.max() > DART.std_rad / 2
    assert (off_rad < 6 * episode_std_rad("dart", NOISY)).all()


def test_a_clean_episode_is_the_one_without_noise(environment: Environment) -> None:
    clean, plain = played(environment, CLEAN), played(environment, CLEAN, noise="none")
    np.testing.assert_array_equal(executed(clean), labels(plain))
    np.testing.assert_array_equal([row.state for row in clean], [row.state for row in plain])
    assert {row.executed_action is None for row in plain} == {True}
    assert not any(row.executed_action is None for row in clean if not row.is_demonstration)


def test_the_gripper_and_the_demonstration_are_left_alone(noisy: list[Row]) -> None:
    np.testing.assert_array_equal(executed(noisy)[:, 7], labels(noisy)[:, 7])
    shown = [row for row in noisy if row.is_demonstration]
    np.testing.assert_array_equal(executed(shown), labels(shown))


def test_there_is_no_noise_where_the_gripper_closes_on_something(noisy: list[Row]) -> None:
    own = [row for row in noisy if not row.is_demonstration]
    closing = np.flatnonzero(np.diff(labels(own)[:, 7]) < 0) + 1
    assert closing.size
    for first in closing:
        np.testing.assert_array_equal(executed(own)[first : first + 3], labels(own)[first : first + 3])


@given(st.tuples(st.floats(0, 1), st.floats(0, 1)), st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_noise_fades_on_the_way_to_contact_and_to_a_stop(
    clearances_m: tuple[float, float], speeds_rad_s: tuple[float, float]
) -> None:
    (near, far), (slow, fast) = sorted(clearances_m), sorted(speeds_rad_s)
    assert 0.0 <= DART.share(near, slow) <= DART.share(far, slow) <= DART.share(far, fast) <= 1.0
    assert DART.share(min(near, DART.touch_m), fast) == DART.share(far, 0.0) == 0.0
    assert DART.share(DART.free_m, DART.moving_rad_s) == 1.0


def test_an_arm_that_is_told_to_stay_stays(environment: Environment) -> None:
    environment.reset(NOISY, "easy")
    dart = Dart(environment.physics, NOISY)
    there = np.append(environment.physics.arm_qpos() + 0.1, 1.0).astype(np.float32)
    assert not np.array_equal(dart.executed(there), there)  # it moved
    for _ in range(30):
        np.testing.assert_array_equal(dart.executed(there), there)


def test_strengths_are_spread_as_configured() -> None:
    stds_rad = np.array([episode_std_rad("dart", seed) for seed in range(4000)])
    assert 0.13 < np.mean(stds_rad == 0.0) < 0.17
    noisy_rad = stds_rad[stds_rad > 0]
    assert DART.std_rad * 0.3 <= noisy_rad.min() < DART.std_rad * 0.32
    assert DART.std_rad * 1.68 < noisy_rad.max() <= DART.std_rad * 1.7
    assert not any(episode_std_rad("none", seed) for seed in range(50))


def test_far_from_everything_the_noise_is_as_strong_and_as_slow_as_said(environment: Environment) -> None:
    environment.reset(NOISY, "easy")
    assert Clearance(environment.physics).tool_m() > DART.free_m  # at home
    config = DartConfig(clean_share=0.0)
    dart = Dart(environment.physics, NOISY, config)
    to_and_fro = [np.append(environment.physics.arm_qpos() + side, 1.0).astype(np.float32) for side in (-0.01, 0.01)]
    nudges = np.stack([dart.executed(action) - action for action in to_and_fro * 5_000])[100:, :7]
    np.testing.assert_allclose(nudges.std(0), dart.std_rad, rtol=0.1)
    np.testing.assert_allclose(
        [np.corrcoef(nudges[10:, joint], nudges[:-10, joint])[0, 1] for joint in range(7)], np.exp(-1), atol=0.08
    )


def test_what_is_executed_stays_within_the_limits(environment: Environment) -> None:
    environment.reset(NOISY, "easy")
    dart = Dart(environment.physics, NOISY)
    at_the_limit = environment.physics.robot.action_high.astype(np.float32)
    low, high = (limit.astype(np.float32) for limit in (environment.physics.robot.action_low, at_the_limit))
    for back_rad in (0.0, 0.05) * 25:
        action = dart.executed(at_the_limit - np.float32(back_rad))
        assert (action <= high).all()
        assert (action >= low).all()


def test_what_the_fingers_hold_is_not_in_the_way(environment: Environment) -> None:
    """Lifted, a container is in the hand; what counts is how far the table and the others are."""
    snapshot = environment.reset(NOISY, "easy")
    clearance, script = Clearance(environment.physics), environment.oracle()
    seen: list[tuple[float, float]] = []
    while snapshot.status.value == "ongoing" and (action := next(script, None)) is not None:
        snapshot = environment.step(action, look=False)
        if any(environment.physics.is_grasped(f"container_{number}") for number in range(3)):
            seen.append((float(snapshot.tcp_pose[2]), clearance.tool_m()))
    height_m, free_m = max(seen)
    assert height_m > 0.1
    assert free_m > 0.03


def test_a_rejection_says_whether_there_was_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    def solve(environment: object, job: Job, seed: int, rejected: tuple[object, ...]) -> dict[str, bytes]:
        if len(rejected) < 3:
            raise rollout.UnsolvedError("the cube fell")
        return {"rejected": repr([each.noise_rad for each in rejected]).encode()}  # type: ignore[attr-defined]

    monkeypatch.setattr(rollout, "kept_environment", lambda *args, **options: None)
    monkeypatch.setattr(rollout, "_solve", solve)
    expected = [episode_std_rad("dart", job().seed(attempt)) for attempt in range(3)]
    assert rollout.work_out(job())["rejected"] == repr(expected).encode()
