"""In an episode only those are obeyed whom its opening named, and nobody else ends it or takes its servers away."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clock.report import ADMITTED_EVENT
from clock.service import ClockService, ServiceConfig
from clock.watch import HEARTBEAT_TIMEOUT_NS
from model_server import membership
from protocol import messages as m
from protocol import topics
from protocol.link import Link
from sim_client.recorder import Recorder

Info = Callable[..., m.EpisodeInfo]
WATCHES = ServiceConfig()


@pytest.fixture
def strangers(rig: Any, episode_info: Info, paper: m.Schedule) -> dict[str, Link]:
    """Processes that nobody opened an episode with, under the names of those that are in it."""
    header = episode_info(paper).header
    links = {proc: Link(rig.bus, robot="r0", proc=proc) for proc in ("clock", "ponder", "pounce", "sim")}
    for link in links.values():
        link.enter_episode(header.session, header.episode, header.epoch)
    return links


def test_plausible_messages_of_strangers_change_no_command(
    rig: Any, new_rig: Callable[..., Any], strangers: dict[str, Link], episode_info: Info, paper: m.Schedule
) -> None:
    info, take = episode_info(paper), rig.listen(topics.INVOCATION, topics.QUERY, topics.EVENT)
    _, undisturbed = new_rig().run(info, 100)

    def lie() -> None:
        take()
        tick = rig.clock.conductor.tick if rig.clock.conductor else 0
        values = np.ones(3, np.float32)
        action = m.Action(tick=tick, deadline_ns=0, level=m.Level.PLAY, values=values)
        strangers["clock"].publish(topics.ACTION, action, at_ns=0)
        strangers["clock"].publish(topics.QUERY, m.Query(query=99, tick=tick, source_ns=0), at_ns=0)
        strangers["sim"].publish(topics.OBSERVATION, rig.observation(tick, 0, (1, 1, 1)), at_ns=0)
        for asked in rig.said.get(m.Invocation, [])[-1:]:
            chunk = m.ActionChunk(
                invocation=asked.invocation, t_row0=asked.tick, ref_query=asked.ref_query, horizon=20, action_dim=3,
                dt_ns=50_000_000, rows=np.ones(60, np.float32), source_ns=asked.now_ns, age_ns=asked.age_ns,
                infer_ns=1, action_space=m.ActionSpace.JOINT_TARGET, model_hash="fake",
            )  # fmt: skip
            strangers["pounce"].publish(topics.CHUNK, chunk, at_ns=0)
        for query in rig.said.get(m.Query, [])[-1:]:
            cognition = m.Cognition(
                query=query.query, tick=query.tick, source_ns=query.source_ns, ready_ns=0,
                vector=np.ones((2, 8), np.float32), model_hash="fake",
            )  # fmt: skip
            strangers["ponder"].publish(topics.COGNITION, cognition, at_ns=0)

    rig.meanwhile = lie
    outcome, disturbed = rig.run(info, 100)
    take()
    assert outcome.status == m.TaskStatus.SUCCESS
    assert disturbed.commands == undisturbed.commands
    alarms = [event.text for event in rig.said[m.Event] if event.name == "stranger"]
    assert {text.split("#")[0] for text in alarms} == {
        "clock heard that sim", "clock heard that ponder", "clock heard that pounce", "sim heard that clock",
        "ponder heard that sim", "ponder heard that clock", "pounce heard that sim",
    }  # fmt: skip
    assert all(rig.links[proc].dropped["stranger"] > 0 for proc in ("clock", "ponder", "pounce", "sim"))


@pytest.mark.parametrize(("topic", "proc"), [(topics.OBSERVATION, "sim"), (topics.ACTION, "clock")])
def test_a_second_sender_under_valid_ids_stops_all_motion(
    rig: Any, episode_info: Info, paper: m.Schedule, topic: Any, proc: str
) -> None:
    info = episode_info(paper)
    double = Link(rig.bus, robot="r0", proc=proc, boot_id=rig.links[proc].boot_id)
    double.enter_episode("s1", info.header.episode, 1)

    def double_it() -> None:
        if rig.clock.conductor is not None and rig.clock.conductor.tick == 30:
            action = m.Action(tick=31, deadline_ns=0, level=m.Level.PLAY, values=np.ones(3, np.float32))
            message = action if topic is topics.ACTION else rig.observation(31, 0)
            double.publish(topic, message, at_ns=0)

    rig.meanwhile = double_it
    rig.patience_ns = 200_000_000
    outcome, world = rig.run(info, 100)
    assert outcome.status == m.TaskStatus.ABORTED
    assert outcome.num_ticks in (30, 31)
    assert len({tuple(command) for command in world.commands[30:]}) <= 1  # the last command, held


@pytest.mark.parametrize("proc", ["clock", "ponder", "pounce"])
def test_only_who_opened_an_episode_closes_it(
    rig: Any, strangers: dict[str, Link], episode_info: Info, paper: m.Schedule, proc: str
) -> None:
    rig.enter(episode_info(paper))
    opener = {"clock": "sim"}.get(proc, "clock")
    reply = strangers[opener].call(topics.CLOSE, proc, m.CloseRequest(), timeout_ns=1)
    assert "can close it" in reply.error
    assert rig.links[proc].episode == "ep-1"


def test_a_second_clock_does_not_take_servers_out_of_a_running_episode(
    rig: Any, episode_info: Info, paper: m.Schedule
) -> None:
    rig.enter(episode_info(paper))
    second = ClockService(Link(rig.bus, robot="r0", proc="clock"), ServiceConfig(watches=False))
    reply = second.open(m.OpenRequest(info=episode_info(paper, session="s2", epoch=2)))
    assert reply.error == "ponder refuses the episode: it is in episode ep-1, whose clock is there"
    assert (reply.refusal, reply.try_again) == (m.Refusal.BUSY, True)
    assert [rig.links[proc].episode for proc in ("ponder", "pounce")] == ["ep-1", "ep-1"]


def test_servers_whose_clock_is_gone_are_free(
    rig: Any, episode_info: Info, paper: m.Schedule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(membership, "_CLOCK_SILENCE_NS", 0)
    rig.enter(episode_info(paper))
    rig.bus.end_alive(topics.alive_key("r0", "clock"))
    rig.bus.run_participants()
    second = ClockService(Link(rig.bus, robot="r0", proc="clock"), ServiceConfig(watches=False))  # under its token
    reply = second.open(m.OpenRequest(info=episode_info(paper, session="s2", epoch=2)))
    assert reply.error == ""


def test_the_loss_of_an_earlier_clock_frees_no_server_of_the_next(
    rig: Any, episode_info: Info, paper: m.Schedule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(membership, "_CLOCK_SILENCE_NS", 0)
    rig.bus.end_alive(topics.alive_key("r0", "clock"))
    rig.bus.run_participants()
    rig.enter(episode_info(paper))
    second = ClockService(Link(rig.bus, robot="r0", proc="clock"), ServiceConfig(watches=False))
    reply = second.open(m.OpenRequest(info=episode_info(paper, session="s2", epoch=2)))
    assert reply.refusal == m.Refusal.BUSY


def test_a_second_pounce_is_let_in_when_the_first_one_is_lost_and_not_before(
    new_rig: Callable[..., Any], fake_pounce: Any, episode_info: Info, paper: m.Schedule,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    rig = new_rig(WATCHES)
    rig.enter(episode_info(paper))
    recorder = Recorder(rig.links["sim"], "jpeg")
    recorder.begin(episode_info(paper), None)
    link = Link(rig.bus, robot="r0", proc="pounce")
    first, rig.pounce = rig.pounce, SimpleNamespace(step=lambda: False)
    second = rig.start_pounce(link, fake_pounce)
    assert link.episode == ""

    rig.clock._host.zero_ns -= 2 * HEARTBEAT_TIMEOUT_NS  # the first one has been silent for that long
    rig.settle()
    monkeypatch.setattr(membership, "_ASK_AGAIN_NS", 0)
    second._membership._ask_again_ns = 0
    second.step()
    assert link.episode == "ep-1"
    recorder.step()
    assert rig.links["sim"].members["pounce"] == link.boot_id
    first._phase("idle")
    assert rig.links["clock"].members["pounce"] == link.boot_id


def test_what_lets_a_server_in_is_an_event_of_the_clocks_alone(
    rig: Any, strangers: dict[str, Link], episode_info: Info, paper: m.Schedule
) -> None:
    rig.enter(episode_info(paper))
    recorder = Recorder(rig.links["sim"], "jpeg")
    before = dict(rig.links["sim"].members)
    event = m.Event(
        severity=m.Severity.INFO, name=ADMITTED_EVENT, text="", attributes={"proc": "pounce", "boot_id": "5"}
    )
    for proc in ("clock", "pounce"):
        strangers[proc].publish(topics.EVENT, event, at_ns=0)
    rig.links["pounce"].publish(topics.EVENT, event, at_ns=0)
    recorder.step()
    assert rig.links["sim"].members == before


def test_a_server_that_lost_its_episode_comes_back_by_itself(
    rig: Any, episode_info: Info, paper: m.Schedule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(membership, "_ASK_AGAIN_NS", 0)
    rig.enter(episode_info(paper))
    rig.pounce._membership._leave()
    rig.pounce._membership._ask_again_ns = 0
    rig.settle()
    assert rig.links["pounce"].episode == "ep-1"


def test_two_processes_under_one_servers_name_open_no_episode(
    new_rig: Callable[..., Any], fake_pounce: Any, episode_info: Info, paper: m.Schedule
) -> None:
    rig = new_rig(WATCHES)
    other = Link(rig.bus, robot="r0", proc="pounce")
    health = dataclasses.replace(rig.pounce._heartbeat.health)
    other.publish(topics.HEALTH, health, at_ns=0, clock_id="host/monotonic")
    rig.clock.step()
    reply = rig.open(episode_info(paper))
    assert "two processes answer to the name of pounce" in reply.error
    assert reply.try_again
