"""Either family drives a whole robot, chosen by what is loaded; what does not fit the robot is refused at the door."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from ponderpounce.models.ponder_configs import tiny_cpu as tiny_ponder
from ponderpounce.models.pounce_checkpoint import random_bundle, save_bundle
from ponderpounce.models.pounce_configs import tiny_cpu, tiny_groot
from pounce_server.engine import EagerEngine
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.__main__ import main as sim_client

NUM_TICKS = 22  # two invocations of the paper's schedule
FAMILIES = {"pi05": tiny_cpu, "groot": tiny_groot}
K, H = 2, 8  # of the fake PONDER

Info = Callable[..., m.EpisodeInfo]


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, EpisodeRecord]:
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
