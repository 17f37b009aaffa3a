"""The oracle takes an arm over in the middle of a grasp: it goes on from where the tool is, and solves the episode."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment
from dual_system.tasks.oracle import FailedGrasp, Motions

SEED = 6
LOW_M, HIGH_M = 0.06, 0.13
Build = Callable[[str], Environment]
When = Callable[[Environment], bool]


def taken_over(
    env: Environment, when: When, *, offset: tuple[int, int, int] | None = None
) -> tuple[Motions, Iterator[np.ndarray]]:
    """Somebody plays, perhaps missing the first grasp by ``offset``, until the moment has come."""
    snapshot = env.reset(SEED)
    somebody = Motions(env.physics, None if offset is None else FailedGrasp(before=0, offset=offset))
    for action in env.oracle(somebody):
        assert snapshot.status is Status.ONGOING, "the moment never came"
        if somebody.num_grasps and when(env):
            break
        snapshot = env.step(action)
    motions = Motions(env.physics, resumes=True)
    return motions, iter(env.oracle(motions))


def height_m(env: Environment) -> float:
    return float(env.physics.tcp_transform()[2, 3])


def is_open(env: Environment) -> bool:
    return env.physics.gripper_command() > 0


@pytest.mark.parametrize("task", ["PickHighlight", "VideoUnmask"])  # a cube, a container
@pytest.mark.parametrize("offset", [None, (0, 0, 1), pytest.param((-1, 1, 0), marks=pytest.mark.acceptance)])
@pytest.mark.parametrize("num_steps", [0, 30, 60])
def test_whenever_it_is_taken_over_the_episode_is_solved(
    environment: Build, task: str, offset: tuple[int, int, int] | None, num_steps: int
) -> None:
    env = environment(task)
    steps = iter(range(num_steps))
    motions, script = taken_over(env, lambda env: next(steps, None) is None, offset=offset)
    for action in script:
        snapshot = env.step(action)
        if snapshot.status is not Status.ONGOING:
            break
    assert snapshot.status is Status.SUCCESS
    assert motions.has_resumed


def test_on_its_way_down_it_goes_on_down(environment: Build) -> None:
    env = environment("PickHighlight")
    _, script = taken_over(env, lambda env: is_open(env) and LOW_M < height_m(env) < 0.1)
    highest_m, at_m = height_m(env), height_m(env)
    for action in script:
        if action[7] < 0:
            break
        env.step(action)
        at_m = height_m(env)
        highest_m = max(highest_m, at_m)
    assert highest_m < 0.1
    assert at_m < 0.03


def test_what_it_holds_it_lifts_and_never_lets_go(environment: Build) -> None:
    env = environment("PickHighlight")
    cubes = [f"cube_{target}" for target in range(3)]
    _, script = taken_over(env, lambda env: height_m(env) < 0.03 and any(map(env.physics.is_grasped, cubes)))
    for action in script:
        assert action[7] < 0
        if env.step(action).status is not Status.ONGOING:
            break
    assert height_m(env) > LOW_M - 0.01  # and the target counts as picked


def test_empty_it_rises_closed_and_opens_high(environment: Build) -> None:
    env = environment("PickHighlight")
    _, script = taken_over(
        env,
        lambda env: not is_open(env) and height_m(env) < LOW_M and env.physics.finger_openings_m().min() < 0.005,
        offset=(-1, 1, 0),
    )
    for action in script:
        if action[7] > 0:
            break
        env.step(action)
    assert height_m(env) > HIGH_M


def test_other_motions_begin_as_they_always_do(environment: Build) -> None:
    env = environment("PickXtimes")
    env.reset(SEED)
    motions = Motions(env.physics, resumes=True)
    plain, resuming = (np.stack(list(itertools.islice(each.rest(), 30))) for each in (Motions(env.physics), motions))
    np.testing.assert_array_equal(plain, resuming)
    assert not motions.has_resumed


@pytest.mark.parametrize("axis", [0, 1])
def test_a_cube_that_was_turned_over_is_picked_as_well(environment: Build, axis: int) -> None:
    """One of the two axes that it is usually closed along then points up."""
    env = environment("PickHighlight")
    env.reset(SEED, "hard")
    cube = f"cube_{env.layout.targets[0]}"
    quaternion = np.zeros(4)
    quaternion[[0, 1 + axis]] = np.sqrt(0.5)
    env.physics.place(cube, np.concatenate([env.physics.position_m(cube), quaternion]))
    env.physics.refresh()
    for action in Motions(env.physics).pick(cube):
        assert np.isfinite(action).all()
        env.step(action)
    assert env.physics.is_grasped(cube)
