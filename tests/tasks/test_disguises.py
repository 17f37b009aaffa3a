"""Disguised environments change pictures and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from dual_system.tasks.disguises import Pictures, another_seed, disguised
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.seeds import split_of
from dual_system.tasks.task import TaskError

SEED = 500_001


def played(environment: Environment, steps: int, seed: int = SEED) -> list[Snapshot]:
    snapshots = [environment.reset(seed)]
    for _, action in zip(range(steps), environment.oracle(), strict=False):
        snapshots.append(environment.step(action))
        if snapshots[-1].status is not Status.ONGOING:
            break
    return snapshots


@pytest.mark.parametrize("pictures", ["other-scene", "without-cue"])
@pytest.mark.parametrize("task", ["PickHighlight", "VideoUnmask", "PickXtimes"])
def test_physics_texts_and_judgement_are_the_episode_s_own(task: str, pictures: Pictures) -> None:
    with disguised(task, pictures, render=False) as odd, make_environment(task, render=False) as plain:
        for ours, own in zip(played(odd, 60), played(plain, 60), strict=True):
            np.testing.assert_array_equal(ours.state, own.state)
            assert (ours.status, ours.grounded_subgoal) == (own.status, own.grounded_subgoal)
        assert odd.instruction == plain.instruction


def test_another_scene_s_pictures_are_those_of_that_scene_under_the_same_commands() -> None:
    with disguised("PickHighlight", "other-scene") as odd, make_environment("PickHighlight") as other:
        shown = [odd.reset(SEED), *(odd.step(action) for _, action in zip(range(5), odd.oracle(), strict=False))]
        expected = [other.reset(another_seed(SEED), odd.difficulty)]
        expected += [other.step(snapshot.command) for snapshot in shown[1:]]
    for ours, theirs in zip(shown, expected, strict=True):
        for camera, picture in theirs.frames.items():
            np.testing.assert_array_equal(ours.frames[camera], picture)


def test_a_scene_that_is_over_is_shown_as_it_ended() -> None:
    with disguised("VideoUnmask", "other-scene") as odd:
        odd.reset(SEED)
        odd._other._max_steps = 3
        held = [odd.step(odd.physics.command()) for _ in range(6)]
    assert {snapshot.status for snapshot in held} == {Status.ONGOING}
    np.testing.assert_array_equal(held[2].frames["front"], held[5].frames["front"])


@pytest.mark.parametrize(("task", "step"), [("PickHighlight", 20), ("VideoUnmask", 0)])
def test_without_its_cue_a_scene_and_its_retellings_look_alike(task: str, step: int) -> None:
    def pictures(kind: Pictures, retelling: int | None) -> np.ndarray:
        with disguised(task, kind) as environment:
            environment.reset(SEED)
            if retelling is not None:
                environment.reset(SEED, layout=environment.task.retold(environment.layout)[retelling])
            if environment.has_demonstration:
                return next(environment.demonstration()).frames["front"]
            hold = environment.reset(SEED, layout=environment.layout).command
            looks = [at == step for at in range(1, step + 1)]
            return [environment.step(hold, look=look) for look in looks][-1].frames["front"]

    assert not np.array_equal(pictures("own", None), pictures("own", 0))
    np.testing.assert_array_equal(pictures("without-cue", None), pictures("without-cue", 0))


@pytest.mark.parametrize("task", ["PickHighlight", "VideoUnmask", "MoveCube"])
def test_a_retold_scene_has_the_same_present_and_another_answer(task: str) -> None:
    with disguised(task, "retold", render=False) as odd, make_environment(task, render=False) as plain:
        ours, own = odd.reset(SEED), plain.reset(SEED)
        assert odd.instruction == plain.instruction
        assert odd.layout in plain.task.retold(plain.layout)
        assert odd.layout != plain.layout
        np.testing.assert_allclose(ours.state, own.state, atol=0.02)


def test_a_task_without_another_past_is_refused() -> None:
    with disguised("StopCube", "retold", render=False) as odd, pytest.raises(TaskError, match="one past only"):
        odd.reset(SEED)


def test_the_other_scene_is_another_one_and_never_held_out() -> None:
    for seed in (0, 50_000, 500_000, 799_999, 800_000, 820_099, 1_000_000):
        assert another_seed(seed) != seed
        assert split_of(another_seed(seed)) == "demo"
