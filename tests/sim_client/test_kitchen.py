"""The kitchen's tasks in sim-client: which names there are, and the robot that episodes are opened for."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from dual_system.tasks.kitchen import environment, omron
from dual_system.tasks.kitchen.catalogue import TASKS
from dual_system.tasks.kitchen.environment import KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.tasks.kitchen.layout import StateReader
from dual_system.tasks.task import TaskError, task_names
from protocol import checks
from sim_client import evaluate, worlds
from sim_client.condition import ConditionOptions, EvalOptions, Job
from sim_client.kitchen_robot import panda_omron
from sim_client.robot_file import read_robot

ROOT = Path(__file__).parents[2]


def test_there_are_the_sixteen_the_twenty_four_and_the_goal_sets() -> None:
    names = worlds.names()
    assert len(names) == len(set(names))
    assert set(names) == {*task_names(), *TASKS, *GOAL_SETS}
    for name in names:
        worlds.require(name)
    with pytest.raises(TaskError, match="unknown task 'OpenDrawers'"):
        worlds.require("OpenDrawers")


def test_the_robot_is_the_one_of_the_example() -> None:
    """Whoever serves by the file serves the kitchen, and the other way round."""
    robot = panda_omron()
    checks.check_robot(robot)
    described = read_robot(ROOT / "examples/robots/panda_omron.toml").describe(np.zeros(53, np.float32), (128, 128))
    same = {field.name for field in dataclasses.fields(robot)} - {
        "at_exit", "dimensions", "home", "max_lead", "max_picture_age_ns", "state_high", "state_low",
    }  # fmt: skip
    assert len(same) > 12
    for name in same:
        np.testing.assert_array_equal(getattr(robot, name), getattr(described, name), err_msg=name)
    for ours, theirs in zip(robot.dimensions, described.dimensions, strict=True):
        assert (ours.name, ours.kind, ours.at_stop) == (theirs.name, theirs.kind, theirs.at_stop)
    assert (robot.state_high >= 0.99).sum() > 40
    assert (robot.state_low == -robot.state_high).all()


def test_wherever_its_joints_can_be_is_measured() -> None:
    """And a little further: the limits of simulated joints are soft."""
    robot, model = panda_omron(), omron.panda_omron_spec().compile()
    data, reader = mujoco.MjData(model), StateReader(model)
    for end in (0, 1):
        for name in (*omron.ARM_JOINTS, *omron.FINGER_JOINTS):
            joint = model.joint(name)
            data.qpos[joint.qposadr[0]] = joint.range[end] + 0.02 * (2 * end - 1)
        mujoco.mj_forward(model, data)
        state = reader.state(data)
        assert ((robot.state_low <= state) & (state <= robot.state_high)).all()


def test_a_kitchen_episode_is_of_its_own_suite_and_no_longer_than_the_papers() -> None:
    with worlds.open_world("OpenDrawer", render=False, max_steps=1300) as world:
        assert isinstance(world, KitchenEnvironment)
        first = world.reset(0)
        robot = worlds.robot_of(world, first)
        assert (len(first.state), len(first.command)) == (robot.num_proprio, robot.action_dim)
        assert ((robot.state_low <= first.state) & (first.state <= robot.state_high)).all()
        assert worlds.suite_of(world) == "RoboCasa-DC"
        assert world._max_steps == 1000
        with pytest.raises(TaskError, match="OpenDrawer has no difficulties"):
            world.reset(0, "easy")


def test_all_are_the_sixteen_and_suites_are_evaluated_apart() -> None:
    assert worlds.chosen(("all",)) == task_names()
    assert worlds.chosen(("TwoDrawers", "OpenDrawer", "OpenDrawer")) == ("OpenDrawer", "TwoDrawers")
    for others in ("all", "StopCube"):
        with pytest.raises(TaskError, match="evaluate each suite by itself"):
            worlds.chosen(("OpenDrawer", others))


@pytest.mark.parametrize(
    ("task", "pictures", "it_has"),
    [
        ("OpenDrawer", "retold", "own, without-cue, last-frame"),
        ("TwoDrawers", "other-scene", "own, retold, without-cue, last-frame"),
        ("StopCube", "last-frame", "own, other-scene, without-cue, retold"),
    ],
)
def test_pictures_that_a_task_has_not_are_refused_at_once(task: str, pictures: worlds.Pictures, it_has: str) -> None:
    with pytest.raises(TaskError, match=f"{task} has no --pictures {pictures}; it has {it_has}"):
        EvalOptions(out=Path("nowhere"), tasks=(task,), condition=ConditionOptions(pictures=pictures)).jobs()


def test_the_kitchen_is_evaluated_in_the_paper_s_protocol() -> None:
    """Fifty scenes of a split, a thousand steps, one cognition an episode if asked, chunks of the policy's length."""
    options = EvalOptions(out=Path("nowhere"), tasks=("OpenDrawer",), condition=ConditionOptions(query_period_ms=0))
    assert len(options.jobs()) == 3 * 50
    schedule = options.sim().schedule.of_episode("lockstep", seed=0, horizon=16)
    assert (schedule.max_ticks, schedule.invoke_period_ticks) == (1000, 16)
    assert schedule.query_period_ns > 1000 * 50_000_000


def test_results_say_which_goal_was_done() -> None:
    with worlds.open_world("PressOrServe", render=False, max_steps=1300, pictures="retold") as world:
        assert isinstance(world, KitchenEnvironment)
        world.reset(0)
        found = worlds.goals_of(world)["goals"]
        assert found["done"] is None
        assert found["of"] == 2
        assert {found["own"], found["twin"]} == {0, 1}
        assert world.scene.goal == found["twin"]


def test_a_scene_without_a_demonstration_is_a_line_and_no_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """It is counted apart, and nothing is played in it."""
    with worlds.open_world("CoffeePressButton", render=False, max_steps=1300) as world:
        assert isinstance(world, KitchenEnvironment)
        world.reset(0)
        assert worlds.why_unpaired(world) == ""
        world.reset(0)
        monkeypatch.setattr(environment, "perform", lambda world, steps: iter(()))
        assert "the script misses its goal; there is no demonstration" in worlds.why_unpaired(world)

    def pretended(job: Job) -> dict[str, object]:
        line = {"task": job.task, "seed": job.seed, "run": job.run, "success": not job.seed, "reason": "no way"}
        if not job.seed:
            return line | {"status": "SUCCESS"}
        return line | {"status": "ABORTED", **({"unpaired": "no way"} if job.seed < 3 else {})}

    class Here:
        def __init__(self, num_workers: int, play: object) -> None:
            pass

        def run(self, jobs: list[Job]) -> Iterator[tuple[Job, dict[str, object]]]:
            yield from ((job, pretended(job)) for job in jobs)

    monkeypatch.setattr(evaluate, "LocalWorkers", Here)
    arguments = ["--tasks", "OpenDrawer", "--episodes", "4", "--runs", "1", "--no-progress"]
    assert evaluate.main(["--out", str(tmp_path), *arguments]) == evaluate.DONE
    told = capsys.readouterr().out
    assert "OpenDrawer: 1 of 2 (2 more have no demonstration)" in told
    assert "1 broken off: no way\n" in told
