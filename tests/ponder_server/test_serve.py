"""PONDER on a bus: it answers, or says why not, and never crashes for what it is sent."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest

from ponder_server.contract import Text
from protocol import messages as m
from protocol import topics
from protocol.link import Link

MS = 1_000_000
Info = Callable[..., m.EpisodeInfo]


@dataclasses.dataclass
class Ward:
    """A PONDER in an episode whose clock and robot are this test."""

    rig: Any
    take: Callable[[], None]

    def ask(self, query: int, tick: int) -> None:
        self.rig.links["clock"].publish(topics.QUERY, m.Query(query=query, tick=tick, source_ns=7), at_ns=0)

    def step(self) -> None:
        while self.rig.ponder.step():
            pass
        self.take()

    def said(self, cls: type) -> list[Any]:
        return self.rig.said.get(cls, [])

    def events(self) -> dict[str, str]:
        return {event.name: event.text for event in self.said(m.Event)}

    @property
    def health(self) -> m.Health:
        return self.rig.ponder._heartbeat.health  # what the next beat will say


@pytest.fixture
def ward(rig: Any, episode_info: Info, paper: m.Schedule) -> Ward:
    rig.enter(episode_info(paper))
    take = rig.listen(topics.COGNITION, topics.SUBGOAL, topics.EVENT, topics.HEALTH, topics.PHASE)
    return Ward(rig, take)


@pytest.mark.parametrize("is_late", [False, True], ids=["observation first", "query first"])
def test_a_query_is_answered_whichever_comes_first(ward: Ward, is_late: bool) -> None:
    steps = [lambda: ward.rig.show(3, 7), lambda: ward.ask(0, 3)]
    for step in reversed(steps) if is_late else steps:
        step()
        ward.step()
    assert [(c.query, c.tick, c.source_ns) for c in ward.said(m.Cognition)] == [(0, 3, 7)]


def test_an_answer_is_signed_on_the_producers_clock(ward: Ward) -> None:
    ward.rig.show(3, 7)
    ward.ask(0, 3)
    ward.step()
    (cognition,) = ward.said(m.Cognition)
    assert (cognition.header.proc, cognition.header.clock_id.endswith("/monotonic")) == ("ponder", True)
    assert cognition.header.at_ns == cognition.ready_ns


def test_a_missed_observation_is_told(ward: Ward) -> None:
    ward.ask(0, 3)
    ward.rig.show(4, 7)
    ward.step()
    assert ward.said(m.Cognition) == []
    assert ward.events()["observation_missed"] == "query 0: tick 3 never came"


def test_frames_of_another_size_are_refused_and_counted(ward: Ward) -> None:
    image = m.Image(camera="front", codec=m.ImageCodec.RAW, height=5, width=5, data=bytes(75))
    ward.rig.show(3, 7, images=(image, image))
    ward.step()
    assert dict(ward.rig.links["ponder"].dropped) == {"wrong_shape": 1}


def test_bytes_that_are_no_picture_are_counted_and_the_next_query_is_answered(ward: Ward) -> None:
    image = m.Image(camera="front", codec=m.ImageCodec.JPEG, height=4, width=4, data=b"no")
    ward.rig.show(3, 7, images=(image, image))
    ward.rig.show(4, 7)
    ward.ask(0, 3)
    ward.ask(1, 4)
    ward.step()
    assert dict(ward.rig.links["ponder"].dropped) == {"no_picture": 1}
    assert [c.query for c in ward.said(m.Cognition)] == [1]


def test_a_full_context_is_an_event_and_not_a_crash(ward: Ward) -> None:
    engine = ward.rig.ponder_engine
    engine.spec = dataclasses.replace(engine.spec, max_context_tokens=20)
    for query in range(2):
        ward.rig.show(query, 7)
        ward.ask(query, query)
        ward.step()
    assert [c.query for c in ward.said(m.Cognition)] == [0]
    assert ward.events()["fire_refused"].startswith("query 1: session 'ep-1' holds 18 tokens and needs 8 more")


def test_a_refused_fire_leaves_ponder_idle(ward: Ward) -> None:
    ward.rig.ponder_engine.contexts.clear()
    ward.rig.show(0, 7)
    ward.ask(0, 0)
    ward.step()
    assert ward.said(m.Phase)[-1].state == "idle"
    assert not ward.health.is_inferring


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"cameras": ("front",)}, "robot 'arm' has 1 cameras ['front']; PONDER expects 2"),
        ({"image_height": 8}, "robot 'arm': camera 'front' gives 8 x 4 px; PONDER reads 4 x 4 px"),
    ],
)
def test_a_robot_whose_pictures_cannot_be_read_is_refused_before_it_moves(
    rig: Any,
    episode_info: Info,
    paper: m.Schedule,
    robot_with: Callable[..., m.Robot],
    changes: dict[str, Any],
    said: str,
) -> None:
    reply = rig.open(episode_info(paper, robot=robot_with(**changes)))
    assert reply.error == f"ponder refuses the episode: {said}"
    assert rig.ponder_engine.contexts == {}


def test_a_demonstration_too_long_refuses_the_episode(
    rig: Any, episode_info: Info, paper: m.Schedule, monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_(*arguments: Any) -> int:
        raise ValueError("demo instant 3 has no view")

    monkeypatch.setattr(rig.ponder_engine, "open", open_)
    assert rig.open(episode_info(paper)).error == "ponder refuses the episode: demo instant 3 has no view"


def test_texts_are_published_for_the_log(ward: Ward) -> None:
    ward.rig.ponder_engine.texts = (Text(kind="subgoal", text="pick", token_ids=(4,), truncated=False),)
    ward.rig.show(0, 7)
    ward.ask(0, 0)
    ward.step()
    assert [(s.text, s.query) for s in ward.said(m.Subgoal)] == [("pick", 0)]


def test_while_it_thinks_its_heartbeat_says_so(ward: Ward) -> None:
    seen = []
    ward.rig.ponder_engine.on_fire = lambda: seen.append(ward.health.is_inferring)
    ward.rig.show(0, 7)
    ward.ask(0, 0)
    ward.step()
    assert (seen, ward.health.is_inferring) == ([True], False)


def test_its_heartbeat_says_which_query_comes_next(ward: Ward) -> None:
    ward.rig.show(0, 7)
    ward.ask(0, 0)
    ward.step()
    assert (ward.health.next_index, ward.health.num_answered) == (1, 1)


def test_its_heartbeat_says_which_episode_is_open(ward: Ward) -> None:
    assert (ward.health.state, ward.health.open_episode) == (m.ServingState.READY, "ep-1")


def test_warm_up_measures_before_ready_is_said(rig: Any) -> None:
    health = rig.ponder._heartbeat.health
    assert (health.infer_p50_ns, health.infer_p99_ns, health.model_hash) == (78 * MS, 78 * MS, "fake-ponder")


def test_an_episodes_contract_says_what_the_engine_is(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    contract, _ = rig.enter(episode_info(paper)).contracts
    assert (contract.proc, contract.num_carriers, contract.hidden_size) == ("ponder", 2, 8)
    assert (contract.context_tokens, contract.max_context_tokens) == (10, 1000)
    assert contract.preferred_codec == m.ImageCodec.RAW


def test_a_query_of_another_epoch_is_not_answered(ward: Ward) -> None:
    ward.rig.show(0, 7)
    ward.rig.links["clock"].epoch = 9
    ward.ask(0, 0)
    ward.step()
    assert ward.said(m.Cognition) == []
    assert dict(ward.rig.links["ponder"].dropped) == {"other_episode": 1}


def test_a_closed_episode_frees_its_context(ward: Ward) -> None:
    ward.rig.links["clock"].call(topics.CLOSE, "ponder", m.CloseRequest(), timeout_ns=1)
    assert (ward.rig.ponder_engine.contexts, ward.rig.links["ponder"].episode) == ({}, "")


def test_opening_again_replaces_the_context(ward: Ward, episode_info: Info, paper: m.Schedule) -> None:
    ward.rig.enter(episode_info(paper, epoch=2))
    assert set(ward.rig.ponder_engine.contexts) == {"ep-2"}


def test_a_broken_journal_leaves_ponder_outside_the_episode(ward: Ward, fake_ponder: Any) -> None:
    ward.rig.show(0, 0)
    ward.rig.clock.step()
    journal = ward.rig.clock._episode.journal
    journal[0] = dataclasses.replace(journal[0], observation=b"\xff")
    restarted = ward.rig.start_ponder(Link(ward.rig.bus, robot="r0", proc="ponder"), fake_ponder)
    health = restarted._heartbeat.health
    assert (health.open_episode, fake_ponder.contexts) == ("", {})


@pytest.mark.slow
def test_a_real_engine_restarts_as_if_it_had_never_died(
    new_rig: Callable[..., Any],
    fake_pounce: Any,
    episode_info: Info,
    paper: m.Schedule,
    robot_with: Callable[..., m.Robot],
) -> None:
    """The tiny network on the CPU: a rebuilt context gives the same hidden states, bit for bit."""
    from ponder_server.__main__ import build_engine
    from ponder_server.config import ContextOptions, PonderOptions

    vectors = []
    for is_restarted in (False, True):
        engines = [build_engine(PonderOptions(context=ContextOptions(max_context_tokens=2048))) for _ in range(2)]
        for engine in engines:
            engine.warm_up = lambda: [1]  # type: ignore[method-assign]
        spec = engines[0].spec
        fake_pounce.spec = dataclasses.replace(
            fake_pounce.spec, num_carriers=spec.num_carriers, cognition_size=spec.hidden_size
        )
        rig = new_rig(ponder_engine=engines[0], pounce_engine=fake_pounce, px=spec.image_px[0])
        take = rig.listen(topics.COGNITION)

        def restart(rig: Any = rig, engine: Any = engines[1], once: list[bool] = [is_restarted]) -> None:  # noqa: B006
            if once[0] and rig.clock.conductor.num_queries == 3:
                once[0] = False
                rig.ponder = rig.start_ponder(Link(rig.bus, robot="r0", proc="ponder"), engine)

        rig.meanwhile = restart
        height, width = spec.image_px
        rig.run(episode_info(paper, robot=robot_with(image_height=height, image_width=width)), 90)
        take()
        vectors.append({c.query: c.vector.tobytes() for c in rig.said[m.Cognition]})
    assert vectors[0].keys() == set(range(5))
    assert vectors[0] == vectors[1]
