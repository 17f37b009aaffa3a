"""POUNCE on a bus: it answers the newest invocation, or says why not, and never crashes for what it is sent."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pounce_server.contract import Request
from protocol import images, topics
from protocol import messages as m
from protocol.link import Link

MS = 1_000_000
ONE_CAMERA = images.pack({"front": np.zeros((4, 4, 3), np.uint8)}, m.ImageCodec.RAW)
Info = Callable[..., m.EpisodeInfo]


@dataclasses.dataclass
class Ward:
    """A POUNCE in an episode whose clock and robot are this test."""

    rig: Any
    take: Callable[[], None]

    def ask(self, invocation: int, tick: int, **changes: Any) -> None:
        values = {
            "invocation": invocation, "tick": tick, "now_ns": 7, "ref_query": 1, "age_ns": 300 * MS,
            "cognition": np.ones((2, 8), np.float32), "seed": 3,
        }  # fmt: skip
        self.rig.links["clock"].publish(topics.INVOCATION, m.Invocation(**(values | changes)), at_ns=7)

    def step(self) -> None:
        while self.rig.pounce.step():
            pass
        self.take()

    def said(self, cls: type) -> list[Any]:
        return self.rig.said.get(cls, [])

    def events(self) -> dict[str, str]:
        return {event.name: event.text for event in self.said(m.Event)}

    @property
    def health(self) -> m.Health:
        return self.rig.pounce._heartbeat.health  # what the next beat will say


@pytest.fixture
def ward(rig: Any, episode_info: Info, paper: m.Schedule) -> Ward:
    rig.enter(episode_info(paper))
    take = rig.listen(topics.CHUNK, topics.EVENT, topics.HEALTH, topics.PHASE)
    return Ward(rig, take)


@pytest.mark.parametrize("is_late", [False, True], ids=["observation first", "invocation first"])
def test_an_invocation_is_answered_whichever_comes_first(ward: Ward, is_late: bool) -> None:
    steps = [lambda: ward.rig.show(3, 7), lambda: ward.ask(0, 3)]
    for step in reversed(steps) if is_late else steps:
        step()
        ward.step()
    assert [(c.invocation, c.t_row0, c.source_ns) for c in ward.said(m.ActionChunk)] == [(0, 3, 7)]


def test_only_the_newest_invocation_is_answered(ward: Ward) -> None:
    ward.rig.show(3, 7)
    for invocation in range(3):
        ward.ask(invocation, 3)
    ward.step()
    assert [c.invocation for c in ward.said(m.ActionChunk)] == [2]


def test_equal_invocations_give_equal_rows(ward: Ward) -> None:
    ward.rig.show(3, 7)
    for invocation in range(2):
        ward.ask(invocation, 3)
        ward.step()
    first, second = ward.said(m.ActionChunk)
    assert (first.rows == second.rows).all()


def test_a_missed_observation_is_told(ward: Ward) -> None:
    ward.ask(0, 3)
    ward.rig.show(4, 7)
    ward.step()
    assert ward.said(m.ActionChunk) == []
    assert ward.events()["observation_missed"] == "invocation 0: tick 3 never came"


def test_a_cognition_of_another_shape_is_refused_and_counted(ward: Ward) -> None:
    ward.rig.show(3, 7)
    ward.ask(0, 3, cognition=np.ones((3, 8), np.float32))
    ward.step()
    assert ward.said(m.ActionChunk) == []
    assert dict(ward.rig.links["pounce"].dropped) == {"wrong_request": 1}


@pytest.mark.parametrize("changes", [{"proprio": np.zeros(8, np.float32)}, {"images": ONE_CAMERA}])
def test_an_observation_of_another_robot_is_refused_and_counted(ward: Ward, changes: dict[str, Any]) -> None:
    ward.rig.show(3, 7, **changes)
    ward.step()
    assert dict(ward.rig.links["pounce"].dropped) == {"wrong_shape": 1}


def test_a_request_that_the_engine_refuses_is_an_event_and_not_a_crash(ward: Ward) -> None:
    ward.rig.show(3, 7)
    ward.ask(0, 3, seed=2**64 - 1)
    ward.step()
    assert ward.events()["invocation_refused"].startswith("invocation 0: seed: expected 0 <= seed < 2**63")


def test_after_a_refusal_the_next_invocation_is_answered(ward: Ward) -> None:
    ward.rig.show(3, 7)
    ward.ask(0, 3, seed=2**64 - 1)
    ward.step()
    ward.ask(1, 3)
    ward.step()
    assert [c.invocation for c in ward.said(m.ActionChunk)] == [1]


def test_a_refused_invocation_leaves_pounce_idle(ward: Ward) -> None:
    ward.rig.show(3, 7)
    ward.ask(0, 3, seed=2**64 - 1)
    ward.step()
    assert ward.said(m.Phase)[-1].state == "idle"
    assert not ward.health.is_inferring


def test_rows_that_are_not_numbers_are_never_sent(ward: Ward, monkeypatch: pytest.MonkeyPatch) -> None:
    def invoke(request: Request, progress: Any) -> m.Floats:
        return np.full((20, 3), np.nan, np.float32)

    monkeypatch.setattr(ward.rig.pounce_engine, "invoke", invoke)
    ward.rig.show(3, 7)
    ward.ask(0, 3)
    ward.step()
    assert ward.said(m.ActionChunk) == []
    assert "ActionChunk.rows: expected finite numbers" in ward.events()["chunk_refused"]


def test_while_it_acts_its_heartbeat_says_so(ward: Ward) -> None:
    seen = []
    ward.rig.pounce_engine.on_invoke = lambda: seen.append(ward.health.is_inferring)
    ward.rig.show(3, 7)
    ward.ask(0, 3)
    ward.step()
    assert (seen, ward.health.is_inferring) == ([True], False)


def test_its_heartbeat_says_which_invocation_comes_next(ward: Ward) -> None:
    ward.rig.show(3, 7)
    ward.ask(4, 3)
    ward.step()
    assert (ward.health.next_index, ward.health.num_answered) == (5, 1)


def test_an_episodes_contract_says_what_the_engine_is(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    _, contract = rig.enter(episode_info(paper)).contracts
    assert (contract.proc, contract.horizon, contract.action_dim) == ("pounce", 20, 3)
    assert (contract.num_carriers, contract.hidden_size, contract.infer_p99_ns) == (2, 8, 25 * MS)


def test_a_restarted_pounce_is_as_good_as_one_that_never_died(
    new_rig: Callable[..., Any], fake_pounce: Any, episode_info: Info, paper: m.Schedule
) -> None:
    never, died = new_rig(), new_rig()
    _, undisturbed = never.run(episode_info(paper), 100)

    def restart() -> None:
        if died.clock.conductor.num_invocations == 2 and not fake_pounce.requests:
            died.pounce = SimpleNamespace(step=lambda: False)  # dead, with its last chunk on the way
            died.pounce = died.start_pounce(Link(died.bus, robot="r0", proc="pounce"), fake_pounce)

    died.meanwhile = restart
    _, disturbed = died.run(episode_info(paper), 100)
    assert fake_pounce.requests
    assert disturbed.commands == undisturbed.commands


def test_a_restarted_pounce_says_that_it_is_ready_in_the_episode(ward: Ward, fake_pounce: Any) -> None:
    restarted = ward.rig.start_pounce(Link(ward.rig.bus, robot="r0", proc="pounce"), fake_pounce)
    health = restarted._heartbeat.health
    assert (health.state, health.open_episode) == (m.ServingState.READY, "ep-1")


def test_outside_an_episode_nothing_is_answered(ward: Ward) -> None:
    ward.rig.links["clock"].call(topics.CLOSE, "pounce", m.CloseRequest(), timeout_ns=1)
    ward.rig.clock._episode = None  # and the clock knows of none to rejoin
    ward.rig.show(3, 7)
    ward.ask(0, 3)
    ward.step()
    assert ward.said(m.ActionChunk) == []
    assert ward.rig.links["pounce"].dropped["no_episode"] == 2
