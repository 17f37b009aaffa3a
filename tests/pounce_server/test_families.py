"""Either family drives a whole robot, chosen by what is loaded; what does not fit the robot is refused at the door."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest

from clock.check import disagreements
from dual_system.models.action_space import ActionSpace
from dual_system.models.normalisation import Quantiles, RobotStatistics
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.pounce.checkpoint import random_bundle, save_bundle
from dual_system.models.pounce.configs import in_space, tiny_cpu, tiny_groot
from dual_system.tasks import panda
from pounce_server.contract import EngineSpec, check_robot
from pounce_server.engine import EagerEngine
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.__main__ import main as sim_client
from sim_client.panda_robot import simulated_robot

NUM_TICKS = 22  # two invocations of the paper's schedule
FAMILIES = {"pi05": tiny_cpu, "groot": tiny_groot}
K, H = 2, 8  # of the fake PONDER

PANDA = simulated_robot(panda.PANDA_WRISTCAM, np.append(panda.HOME_QPOS, 0.04))
SPEC = EngineSpec(
    horizon=20, action_dim=8, proprio_dim=8, num_carriers=K, cognition_size=H, image_px=224, num_steps=10,
    num_cameras=2, model_hash="", is_random=True, has_fresh_prefix=True, dtype="float32",
)  # fmt: skip

Info = Callable[..., m.EpisodeInfo]

pytestmark = pytest.mark.usefixtures("short_warm_up")


@pytest.fixture(scope="module")
def episodes(short_warm_up: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, EpisodeRecord]:
    """PickHighlight by both families in lockstep: all is real but the bus, and only the folder differs."""
    records = {}
    for family, config in FAMILIES.items():
        checkpoint, out = (tmp_path_factory.mktemp(f"{family}_{what}") for what in ("checkpoint", "out"))
        save_bundle(random_bundle(config(cognition_size=tiny_ponder().hidden_size), seed=0), checkpoint)
        arguments = ["--in-process", "--seed", "7", "--max-steps", str(NUM_TICKS), "--no-progress"]
        assert sim_client([*arguments, "--pounce-checkpoint", str(checkpoint), "--out", str(out)]) == 0
        (episode,) = json.loads((out / "results.json").read_text())["episodes"]
        records[family] = read_log(out / episode["mcap"])
    return records


@pytest.mark.sim
@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_plays_every_tick_of_pick_highlight(episodes: dict[str, EpisodeRecord], family: str) -> None:
    record = episodes[family]
    assert record.info.task == "PickHighlight"
    assert [tick.level for tick in record.ticks] == [m.Level.PLAY] * NUM_TICKS
    assert [(chunk.horizon, chunk.action_dim) for chunk in record.chunks] == [(20, 8)] * 2
    assert next(disagreements(record), None) is None


@pytest.mark.sim
def test_the_families_are_two_models(episodes: dict[str, EpisodeRecord]) -> None:
    pi05, groot = (episodes[family].chunks[0] for family in FAMILIES)
    assert pi05.model_hash != groot.model_hash
    assert not np.array_equal(pi05.rows, groot.rows)


@pytest.fixture
def opened(new_rig: Callable[..., Any], episode_info: Info, robot_with: Callable[..., m.Robot]) -> Callable[..., Any]:
    """Opens an episode of a robot at a clock service whose POUNCE is the real engine."""

    def open_(family: str, schedule: m.Schedule, *, robot_dim: int, horizon: int = 20) -> tuple[Any, m.OpenReply]:
        config = FAMILIES[family](num_carriers=K, cognition_size=H, horizon=horizon)
        rig = new_rig(pounce_engine=EagerEngine(random_bundle(config, seed=0)))
        low, high, step = (np.full(robot_dim, value, np.float32) for value in (-3, 3, 0.2))
        robot = robot_with(command_low=low, command_high=high, max_step=step, initial_command=0 * low, num_proprio=8)
        return rig, rig.open(episode_info(schedule, robot=robot))

    return open_


REFUSED = {
    "action space": ({"robot_dim": 3}, r"POUNCE gives chunks of (20, 8), the episode was opened for (20, 3)"),
    "horizon": ({"robot_dim": 8, "horizon": 16}, r"POUNCE gives chunks of (16, 8), the episode was opened for (20, 8)"),
}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("changes", "sentence"), REFUSED.values(), ids=REFUSED.keys())
def test_a_model_of_another_robot_or_schedule_is_refused_before_motion(
    opened: Callable[..., Any], paper: m.Schedule, family: str, changes: dict[str, int], sentence: str
) -> None:
    rig, reply = opened(family, paper, **changes)
    assert sentence in reply.error
    rig.show(0, 0, np.zeros(8))
    rig.settle()
    assert rig.clock._episode is None, "nobody is there who could command anything"


@pytest.mark.parametrize("family", FAMILIES)
def test_a_model_of_this_robot_and_schedule_is_not(opened: Callable[..., Any], paper: m.Schedule, family: str) -> None:
    _, reply = opened(family, paper, robot_dim=8)
    assert reply.error == ""


MISFITS: dict[str, tuple[ActionSpace, dict[str, Any], str]] = {
    "an arm of other limits": (
        "ee_delta",
        {"command_high": np.full(8, 3, np.float32)},
        "this checkpoint moves the tool (ee_delta) and knows the Panda's arm only; panda_wristcam has joint limits",
    ),
    "an arm of fewer joints": ("ee_delta", {"command_low": np.full(4, -1, np.float32)}, "knows the Panda's arm only"),
    "one camera": ("joint_delta", {"cameras": ("front",)}, "POUNCE reads 2 cameras, the robot has 1: front"),
    "two fingers": ("ee_delta", {"num_proprio": 9}, "POUNCE reads 8 joint values, the robot has 9"),
}


@pytest.mark.parametrize(("space", "changes", "sentence"), MISFITS.values(), ids=MISFITS.keys())
def test_a_robot_that_the_checkpoint_cannot_move_is_refused_with_the_reason(
    space: ActionSpace, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        check_robot(replace(PANDA, **changes), replace(SPEC, space=space))


@pytest.mark.parametrize("space", get_args(ActionSpace))
def test_the_panda_is_not(space: ActionSpace) -> None:
    check_robot(PANDA, replace(SPEC, space=space))


def test_an_arm_that_tool_deltas_do_not_fit_is_refused_at_the_door(
    new_rig: Callable[..., Any], episode_info: Info, paper: m.Schedule
) -> None:
    table = Quantiles(q01=(-0.1,) * 7, q99=(0.1,) * 7)
    statistics = RobotStatistics(state=table, action=table, space="ee_delta")
    bundle = random_bundle(in_space(tiny_cpu(num_carriers=K, cognition_size=H), "ee_delta"), 0, statistics=statistics)
    rig = new_rig(pounce_engine=EagerEngine(bundle))
    small = replace(PANDA, image_height=4, image_width=4)  # what the rig's PONDER sees
    other = replace(small, command_low=np.full(8, -4, np.float32))
    assert "knows the Panda's arm only" in rig.open(episode_info(paper, robot=other)).error
    assert rig.clock._episode is None
    assert rig.open(episode_info(paper, robot=small)).error == ""
