"""What the log has although messages arrive while it is being written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock import schedules
from protocol import messages as m
from protocol.bus import LocalBus
from protocol.link import Link, Stream
from protocol.mcap_log import read_log
from protocol.topics import ACTION, CHUNK, STAMP, SUBGOAL, TICK
from sim_client.recorder import KEEP, Recorder

COMMAND = np.zeros(3, np.float32)


def test_what_newer_messages_pushed_out_unread_is_told_in_the_log(
    episode_info: Callable[..., m.EpisodeInfo], tmp_path: Path
) -> None:
    bus = LocalBus()
    info = episode_info(schedules.realtime())
    sim = Link(bus, robot=info.header.robot, proc="sim")
    sim.enter_episode(info.header.session, info.header.episode, info.header.epoch)
    recorder = Recorder(sim, "jpeg")
    recorder.begin(info, tmp_path / "episode.mcap")
    for tick in range(KEEP + 3):
        sim.publish(SUBGOAL, m.Subgoal(kind=m.SubgoalKind.TASK_SIMPLE, text="", tick=tick), at_ns=tick)
    result = m.EpisodeResult(status=m.TaskStatus.TIMEOUT, is_success=False, reason="", num_ticks=0)
    assert any("'subgoal': 3" in sentence for sentence in recorder.end(result))
    assert read_log(tmp_path / "episode.mcap").metadata["ponderpounce.result"]["dropped_messages"] == "3"


def test_a_tick_in_the_log_has_its_action_whenever_they_arrive(
    episode_info: Callable[..., m.EpisodeInfo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock publishes another action and its account before each topic is drained."""
    bus = LocalBus()
    info = episode_info(schedules.realtime())
    clock, sim = (Link(bus, robot=info.header.robot, proc=proc) for proc in ("clock", "sim"))
    header = info.header
    clock_is = m.Member(proc="clock", boot_id=clock.boot_id)
    for link in (clock, sim):
        link.enter_episode(header.session, header.episode, header.epoch, (clock_is,))
    recorder = Recorder(sim, "jpeg")
    recorder.begin(info, tmp_path / "episode.mcap")
    tick, receive = 0, Stream.receive

    def late(stream: Stream[Any]) -> Any:
        nonlocal tick
        clock.publish(ACTION, m.Action(tick=tick, deadline_ns=tick, level=m.Level.HOLD, values=COMMAND), at_ns=tick)
        told = m.Tick(tick=tick, deadline_ns=tick, decided_ns=tick, late_ns=0, level=m.Level.HOLD, action=COMMAND)
        clock.publish(TICK, told, at_ns=tick)
        tick += 1
        return receive(stream)

    monkeypatch.setattr(Stream, "receive", late)
    recorder.step()
    recorder.end(m.EpisodeResult(status=m.TaskStatus.TIMEOUT, is_success=False, reason="", num_ticks=tick))
    record = read_log(tmp_path / "episode.mcap")
    assert len(record.ticks) > 2
    assert {each.tick for each in record.ticks} <= {each.tick for each in record.actions}


@pytest.mark.parametrize("comes", [True, False])
def test_a_log_waits_for_an_answer_whose_stamp_was_faster(
    episode_info: Callable[..., m.EpisodeInfo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, comes: bool
) -> None:
    bus, info = LocalBus(), episode_info(schedules.realtime())
    clock, pounce, sim = (Link(bus, robot=info.header.robot, proc=proc) for proc in ("clock", "pounce", "sim"))
    members = [m.Member(proc=link.proc, boot_id=link.boot_id) for link in (clock, pounce)]
    for link in (clock, pounce, sim):
        link.enter_episode(info.header.session, info.header.episode, info.header.epoch, members)
    recorder = Recorder(sim, "jpeg")
    recorder.begin(info, tmp_path / "episode.mcap")
    clock.publish(STAMP, m.Stamp(kind=m.StampKind.CHUNK, index=0, source_ns=0, ready_ns=1, arrived_ns=1), at_ns=1)
    num_looks = 0

    def wait(timeout_ns: int) -> None:
        nonlocal num_looks
        num_looks += 1
        if comes and num_looks == 3:
            horizon, action_dim = info.schedule.horizon, info.robot.action_dim
            answer = m.ActionChunk(
                invocation=0,
                t_row0=0,
                horizon=horizon,
                action_dim=action_dim,
                dt_ns=50_000_000,
                rows=np.zeros(horizon * action_dim, np.float32),
                source_ns=0,
                ref_query=None,
                age_ns=0,
            )
            pounce.publish(CHUNK, answer, at_ns=1)

    monkeypatch.setattr(bus, "wait", wait)
    recorder.end(m.EpisodeResult(status=m.TaskStatus.TIMEOUT, is_success=False, reason="", num_ticks=0))
    record = read_log(tmp_path / "episode.mcap")
    assert (len(record.stamps), len(record.chunks)) == (1, int(comes))
