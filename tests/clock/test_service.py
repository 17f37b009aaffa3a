"""The clock service in one thread with both servers: what it refuses, what it remembers, whom it misses."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clock import schedules
from clock.conductor import Conductor
from clock.service import ROBOT_SILENCE_NS, ClockService, ServiceConfig
from clock.watch import TOKEN_GRACE_NS
from model_server import membership
from protocol import codec, topics
from protocol import messages as m
from protocol.link import Link
from protocol.process import host_clock_id

MS = 1_000_000
Info = Callable[..., m.EpisodeInfo]

REALTIME_PAPER = dataclasses.replace(
    schedules.paper(), mode=m.Mode.REALTIME, query_delay=schedules.MEASURED, invoke_delay=schedules.MEASURED
)
SLOW_LOCKSTEP = dataclasses.replace(schedules.paper(), invoke_delay=schedules.FIXED_300_MS)


@dataclass
class Monotonic:
    """``time.monotonic_ns``: a microsecond per look, more only by hand."""

    now_ns: int = 5_000 * MS

    def __call__(self) -> int:
        self.now_ns += 1_000
        return self.now_ns


@pytest.fixture
def monotonic(monkeypatch: pytest.MonkeyPatch) -> Monotonic:
    clock = Monotonic()
    monkeypatch.setattr(time, "monotonic_ns", clock)
    return clock


def spec_of(engine: Any, **changes: Any) -> Any:
    engine.spec = dataclasses.replace(engine.spec, **changes)
    return engine


@pytest.fixture
def fitted(new_rig: Callable[..., Any], fake_ponder: Any, fake_pounce: Any) -> Callable[..., Any]:
    """A rig whose engines have other specs."""

    def fit(ponder: dict[str, Any], pounce: dict[str, Any], **options: Any) -> Any:
        return new_rig(
            ponder_engine=spec_of(fake_ponder, **ponder), pounce_engine=spec_of(fake_pounce, **pounce), **options
        )

    return fit


def serve_time(rig: Any, skew_ns: int = 0, clock_id: str = "robot/monotonic") -> None:
    """Lets the robot's own computer, whose clock is ahead by ``skew_ns``, say what time it has."""
    service = rig.links["sim"].serve(topics.TIME)

    def tell(request: m.TimeRequest) -> m.TimeReply:
        now_ns = time.monotonic_ns() + skew_ns
        return m.TimeReply(clock_id=clock_id, t1_ns=now_ns, t2_ns=now_ns)

    rig.bus.add_participant(lambda: service.answer(tell) > 0)


# -- what is refused


@pytest.mark.parametrize(
    ("ponder", "pounce", "sentence"),
    [
        ({"num_carriers": 3}, {}, "carriers K: PONDER gives 3, POUNCE expects 2. Load checkpoints trained together."),
        ({"hidden_size": 9}, {}, "hidden size H: PONDER gives 9, POUNCE expects 8. Load checkpoints trained together."),
        (
            {},
            {"horizon": 16},
            "POUNCE gives chunks of (16, 3), the episode was opened for (20, 3). Load another checkpoint.",
        ),
        ({}, {"action_dim": 8}, "POUNCE gives chunks of (20, 8), the episode was opened for (20, 3)."),
        ({}, {"proprio_dim": 8}, "pounce refuses the episode: POUNCE reads 8 joint values, the robot has 3"),
    ],
)
def test_parts_that_do_not_fit_are_refused(
    fitted: Callable[..., Any], episode_info: Info, paper: m.Schedule, ponder: Any, pounce: Any, sentence: str
) -> None:
    reply = fitted(ponder, pounce).open(episode_info(paper))
    assert sentence in reply.error
    assert not reply.try_again


def test_a_pounce_without_cognition_fits_any_ponder(
    fitted: Callable[..., Any], episode_info: Info, paper: m.Schedule
) -> None:
    assert fitted({"num_carriers": 3}, {"num_carriers": 0}).open(episode_info(paper)).error == ""


@pytest.mark.parametrize(
    ("ponder", "pounce", "who"),
    [
        ({"is_random": True}, {}, "ponder"),
        ({}, {"is_random": True}, "pounce"),
        ({}, {"has_fresh_prefix": True}, "pounce"),
        ({"is_random": True}, {"is_random": True}, "ponder and pounce"),
    ],
)
class TestUntrainedWeights:
    def test_do_not_move_a_real_robot(
        self,
        fitted: Callable[..., Any],
        episode_info: Info,
        robot_with: Callable[..., m.Robot],
        paper: m.Schedule,
        ponder: Any,
        pounce: Any,
        who: str,
    ) -> None:
        rig = fitted(ponder, pounce)
        serve_time(rig)
        reply = rig.open(episode_info(paper, robot=robot_with(is_simulated=False)))
        assert reply.error == f"{who} run untrained weights, which never move a real robot."

    def test_move_a_simulated_one_with_a_warning(
        self, fitted: Callable[..., Any], episode_info: Info, paper: m.Schedule, ponder: Any, pounce: Any, who: str
    ) -> None:
        warnings = fitted(ponder, pounce).open(episode_info(paper)).warnings
        assert warnings == tuple(
            f"{name} runs untrained weights: expect motion, not skill" for name in who.split(" and ")
        )


def test_trained_weights_move_a_real_robot(
    rig: Any, episode_info: Info, robot_with: Callable[..., m.Robot], paper: m.Schedule
) -> None:
    serve_time(rig)
    assert rig.open(episode_info(paper, robot=robot_with(is_simulated=False))).error == ""


class TestPounceAlone:
    def test_moves_a_real_robot_and_the_log_says_what_it_reads(
        self, rig: Any, episode_info: Info, robot_with: Callable[..., m.Robot], paper: m.Schedule
    ) -> None:
        serve_time(rig)
        take = rig.listen(topics.EVENT)
        reply = rig.open(episode_info(paper, robot=robot_with(is_simulated=False), policy="pounce"))
        assert (reply.error, [contract.proc for contract in reply.contracts]) == ("", ["pounce"])
        take()
        assert "POUNCE plays alone: it reads its learned null" in {event.text for event in rig.said[m.Event]}

    def test_plays_although_no_ponder_runs(self, rig: Any, episode_info: Info, paper: m.Schedule) -> None:
        rig.ponder = SimpleNamespace(step=lambda: False)
        rig.run(episode_info(paper, policy="pounce"), 45)
        requests = rig.pounce_engine.requests
        assert [(request.cognition, request.age_ns, request.subgoal) for request in requests] == [(None, 0, "")] * 3

    def test_untrained_is_refused_a_real_robot_as_ever(
        self, fitted: Callable[..., Any], episode_info: Info, robot_with: Callable[..., m.Robot], paper: m.Schedule
    ) -> None:
        rig = fitted({}, {"is_random": True})
        serve_time(rig)
        info = episode_info(paper, robot=robot_with(is_simulated=False), policy="pounce")
        assert rig.open(info).error == "pounce run untrained weights, which never move a real robot."

    def test_a_ponder_that_runs_beside_it_is_told_of_no_episode(
        self, rig: Any, episode_info: Info, paper: m.Schedule
    ) -> None:
        rig.enter(episode_info(paper, policy="pounce"))
        assert not rig.ponder.rejoin()
        assert rig.links["ponder"].episode == ""


def test_a_schedule_that_cannot_be_kept_is_refused_with_the_way_out(rig: Any, episode_info: Info) -> None:
    reply = rig.open(episode_info(REALTIME_PAPER))
    assert reply.error.startswith("the schedule cannot be kept: d <= s <= H - d with d=1 s=20 H=20: fails, 1 starved")
    assert "--invoke-every-ticks 19" in reply.error
    assert "--allow-starved" in reply.error


def test_a_schedule_that_cannot_be_kept_may_be_accepted(new_rig: Callable[..., Any], episode_info: Info) -> None:
    reply = new_rig(ServiceConfig(watches=False, allow_starved=True)).open(episode_info(REALTIME_PAPER))
    assert reply.error == ""
    assert "1 starved tick(s) per chunk" in reply.warnings[0]


def test_in_lockstep_a_starving_schedule_is_a_warning(rig: Any, episode_info: Info) -> None:
    reply = rig.open(episode_info(SLOW_LOCKSTEP))
    assert (reply.error, "6 starved tick(s) per chunk" in reply.warnings[0]) == ("", True)


def test_another_session_finds_the_robot_busy(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    rig.enter(episode_info(paper))
    reply = rig.clock.open(m.OpenRequest(info=episode_info(paper, session="s2")))
    assert (reply.error, reply.try_again) == ("robot r0 is busy with episode ep-1", True)


def test_the_same_session_may_start_over(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    rig.enter(episode_info(paper))
    rig.enter(episode_info(paper, epoch=2))
    assert {rig.links[proc].episode for proc in ("clock", "ponder", "pounce")} == {"ep-2"}


@pytest.mark.parametrize("epoch", [0, 1, 3])
def test_an_epoch_that_is_not_new_is_refused(rig: Any, episode_info: Info, paper: m.Schedule, epoch: int) -> None:
    rig.enter(episode_info(paper, epoch=3))
    assert rig.open(episode_info(paper, epoch=epoch)).error == f"epoch {epoch} of session s1 is not after 3"


@pytest.mark.parametrize("header", [{"session": "s/1"}, {"episode": "*"}, {"episode": ""}])
def test_an_id_that_keys_would_misread_is_refused(
    rig: Any, episode_info: Info, paper: m.Schedule, header: dict[str, str]
) -> None:
    info = episode_info(paper)
    reply = rig.open(dataclasses.replace(info, header=dataclasses.replace(info.header, **header)))
    assert "use 1 to 128 letters" in reply.error


@pytest.mark.parametrize("pounce", [{"horizon": 16}, {"proprio_dim": 8}])
def test_after_a_refusal_nobody_is_in_an_episode(
    fitted: Callable[..., Any], episode_info: Info, paper: m.Schedule, pounce: dict[str, int]
) -> None:
    rig = fitted({}, pounce)
    rig.open(episode_info(paper))
    assert {link.episode for link in rig.links.values()} == {""}
    assert rig.ponder_engine.contexts == {}


def test_after_a_refusal_the_same_epoch_may_be_opened(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    assert rig.open(episode_info(REALTIME_PAPER)).error
    assert rig.open(episode_info(paper)).error == ""


# -- who is ready


@pytest.fixture
def watchful(new_rig: Callable[..., Any]) -> Any:
    return new_rig(ServiceConfig(watches=True))


def test_servers_that_beat_are_ready(watchful: Any, episode_info: Info, paper: m.Schedule) -> None:
    assert watchful.open(episode_info(paper)).error == ""


def test_a_server_that_is_not_there_may_still_come(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    alone = ClockService(Link(rig.bus, robot="r1", proc="clock"), ServiceConfig())
    reply = alone.open(m.OpenRequest(info=episode_info(paper)))
    assert reply.error == "ponder is not there: start ponder-serve, or check its endpoint"
    assert reply.try_again


@pytest.mark.parametrize(
    ("health", "sentence"),
    [
        (m.Health(state=m.ServingState.LOADING, progress=0.25, detail="shard 2"), "pounce is loading (25%) shard 2"),
        (m.Health(state=m.ServingState.WARMING), "pounce is warming (0%)"),
        (m.Health(state=m.ServingState.FAILED, detail="no such file"), "pounce failed: no such file"),
    ],
)
def test_a_server_that_is_not_ready_says_why(
    watchful: Any, episode_info: Info, paper: m.Schedule, health: m.Health, sentence: str
) -> None:
    watchful.links["pounce"].publish(topics.HEALTH, health, at_ns=0)
    watchful.clock.step()
    reply = watchful.open(episode_info(paper))
    assert (reply.error, reply.try_again) == (sentence, True)


def test_a_lost_server_is_told_and_told_when_it_is_back(watchful: Any, episode_info: Info, paper: m.Schedule) -> None:
    take = watchful.listen(topics.EVENT)
    watchful.enter(episode_info(paper))
    key = topics.alive_key("r0", "pounce")
    watchful.bus.end_alive(key)
    deadline_ns = time.monotonic_ns() + 2 * TOKEN_GRACE_NS
    while time.monotonic_ns() < deadline_ns:
        watchful.clock.step()
    watchful.bus.declare_alive(key)
    watchful.links["pounce"].publish(
        topics.HEALTH, m.Health(state=m.ServingState.READY, open_episode="ep-1"), at_ns=0, clock_id="host/monotonic"
    )
    watchful.clock.step()
    take()
    names = [event.name for event in watchful.said[m.Event]]
    assert [name for name in names if name.startswith("pounce")] == ["pounce_lost", "pounce_back"]


def test_an_episode_ends_with_its_robot(
    watchful: Any, monotonic: Monotonic, episode_info: Info, paper: m.Schedule
) -> None:
    watchful.bus.declare_alive(topics.alive_key("r0", "sim"))
    watchful.enter(episode_info(paper))
    watchful.clock.step()
    watchful.bus.end_alive(topics.alive_key("r0", "sim"))
    watchful.clock.step()
    assert watchful.clock.conductor is not None  # a starved robot loses its token before it stops talking
    monotonic.now_ns += ROBOT_SILENCE_NS
    watchful.settle()
    assert watchful.clock.conductor is None


# -- whose time


@pytest.mark.parametrize("skew_ms", [-50, 0, 50])
def test_a_skewed_clock_is_measured_and_its_instants_become_ours(
    rig: Any, monotonic: Monotonic, episode_info: Info, robot_with: Callable[..., m.Robot], skew_ms: int
) -> None:
    serve_time(rig, skew_ms * MS)
    take = rig.listen(topics.QUERY)
    rig.enter(episode_info(schedules.realtime(), robot=robot_with(is_simulated=False)))
    zero_ns = monotonic.now_ns
    seen = dataclasses.replace(rig.observation(0, 0), source_ns=zero_ns + skew_ms * MS)
    rig.links["sim"].publish(topics.OBSERVATION, seen, at_ns=0, clock_id="robot/monotonic")
    rig.clock.step()
    monotonic.now_ns += 40 * MS
    seen = dataclasses.replace(rig.observation(1, 0), source_ns=monotonic.now_ns - 10 * MS + skew_ms * MS)
    rig.links["sim"].publish(topics.OBSERVATION, seen, at_ns=0, clock_id="robot/monotonic")
    rig.clock.step()
    take()
    (query,) = rig.said[m.Query]
    assert abs(query.source_ns) < MS  # episode time 0 is the first observation
    assert rig.clock.conductor._newest.source_ns == pytest.approx(30 * MS, abs=MS)


def test_a_clock_known_too_badly_is_refused(
    new_rig: Callable[..., Any], episode_info: Info, paper: m.Schedule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(membership, "host_clock_id", lambda: "attic/monotonic")
    reply = new_rig(ServiceConfig(watches=False, max_clock_bound_ns=0)).open(episode_info(paper))
    assert reply.error.startswith("the clock of ponder (attic/monotonic) is known to ")  # how well, its load says
    assert "--max-clock-bound-ms" in reply.error


def test_the_bound_does_not_matter_on_one_host(
    new_rig: Callable[..., Any], episode_info: Info, paper: m.Schedule
) -> None:
    assert new_rig(ServiceConfig(watches=False, max_clock_bound_ns=0)).open(episode_info(paper)).error == ""


def test_a_clock_that_cannot_be_is_refused(
    rig: Any, monotonic: Monotonic, episode_info: Info, robot_with: Callable[..., m.Robot], paper: m.Schedule
) -> None:
    service = rig.links["sim"].serve(topics.TIME)
    rig.bus.add_participant(lambda: service.answer(lambda request: m.TimeReply(clock_id="x", t2_ns=10**12)) > 0)
    reply = rig.open(episode_info(paper, robot=robot_with(is_simulated=False)))
    assert reply.error.startswith("the clock of sim (x): impossible exchange")


def test_an_observation_on_an_unknown_clock_is_dropped(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    rig.enter(episode_info(paper))
    rig.links["sim"].publish(topics.OBSERVATION, rig.observation(0, 0), at_ns=0, clock_id="robot/monotonic")
    rig.clock.step()
    assert dict(rig.links["clock"].dropped) == {"unknown_clock": 1}
    assert rig.clock.conductor.num_queries == 0


def test_an_observation_with_other_joints_is_dropped(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    rig.enter(episode_info(paper))
    rig.show(0, 0, joints=np.zeros(7))
    rig.clock.step()
    assert dict(rig.links["clock"].dropped) == {"wrong_shape": 1}


@pytest.mark.parametrize(
    ("tick", "source_ns"), [(2**53 - 1, 0), (21, 0), (0, 10**17), (0, 2_000 * MS), (0, 101 * MS), (0, -(10**18))]
)
def test_an_observation_that_cannot_be_of_now_is_dropped(
    rig: Any, episode_info: Info, paper: m.Schedule, tick: int, source_ns: int
) -> None:
    rig.enter(episode_info(paper))
    rig.show(tick, source_ns)
    rig.clock.step()
    assert dict(rig.links["clock"].dropped) == {"wrong_instant": 1}
    assert rig.clock.conductor.num_queries == 0


def test_impossible_observations_change_nothing_in_the_schedule(
    rig: Any, episode_info: Info, paper: m.Schedule
) -> None:
    info, take = episode_info(paper), rig.listen(topics.QUERY)
    stranger = Link(rig.bus, robot="r0", proc="sim")
    stranger.enter_episode("s1", info.header.episode, 1)

    def lie() -> None:
        newest = rig.clock.conductor.newest_tick if rig.clock.conductor else 0
        for tick, source_ns in ((newest + 2, 0), (2**53 - 1, 0), (newest, 10**17), (newest, -(10**17))):
            stranger.publish(topics.OBSERVATION, rig.observation(tick, source_ns), at_ns=0)

    rig.meanwhile = lie
    outcome, _ = rig.run(info, 60)
    take()
    assert outcome.status == m.TaskStatus.SUCCESS
    assert [(query.tick, query.source_ns // MS) for query in rig.said[m.Query]] == [
        (0, 0),
        (14, 1_000),
        (34, 2_000),
        (54, 3_000),
    ]


@pytest.mark.parametrize("changes", [{"model_hash": "other"}, {"is_random": True}])
@pytest.mark.parametrize("proc", ["ponder", "pounce"])
def test_a_server_that_comes_back_with_other_weights_is_not_played(
    rig: Any, fake_ponder: Any, fake_pounce: Any, episode_info: Info, paper: m.Schedule, proc: str,
    changes: dict[str, Any],
) -> None:  # fmt: skip
    take = rig.listen(topics.EVENT)
    rig.enter(episode_info(paper))
    engine = {"ponder": fake_ponder, "pounce": fake_pounce}[proc]
    engine.spec = dataclasses.replace(engine.spec, **changes)
    start = {"ponder": rig.start_ponder, "pounce": rig.start_pounce}[proc]
    setattr(rig, proc, start(Link(rig.bus, robot="r0", proc=proc), engine))
    rig.show(0, 0)
    rig.settle()
    take()
    (event,) = [event for event in rig.said[m.Event] if event.name == "other_model"]
    assert f"{proc} answers with" in event.text
    assert rig.links["clock"].dropped["other_model"] >= 1
    assert not rig.clock.conductor.ladder.has_played


def test_a_failing_handler_drops_the_message_and_a_failing_call_is_answered(
    rig: Any, episode_info: Info, paper: m.Schedule, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **options: Any) -> Any:
        raise KeyError("a bug")

    rig.enter(episode_info(paper))
    monkeypatch.setattr(rig.clock.conductor.__class__, "on_observation", fail)
    rig.show(0, 0)
    rig.clock.step()
    assert dict(rig.links["clock"].dropped) == {"failed": 1}
    monkeypatch.setattr(rig.clock.conductor.__class__, "engage", fail)
    reply = rig.listener.call(topics.ENGAGE, "clock", m.EngageRequest(operator="jane"), timeout_ns=1)
    assert reply.error == "unexpected error, see the log: KeyError('a bug')"


def test_a_failing_schedule_ends_the_episode_and_not_the_process(
    rig: Any, episode_info: Info, paper: m.Schedule, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any) -> Any:
        raise ZeroDivisionError("a bug")

    take = rig.listen(topics.EVENT)
    rig.enter(episode_info(paper))
    monkeypatch.setattr(rig.clock.conductor.__class__, "poll", fail)
    rig.show(0, 0)
    rig.settle()
    take()
    assert rig.clock.conductor is None
    assert "schedule_failed" in {event.name for event in rig.said[m.Event]}


# -- what is remembered


def test_a_journal_entry_holds_the_observation_its_query_names(rig: Any, episode_info: Info) -> None:
    rig.enter(episode_info(schedules.realtime()))  # in lockstep no robot is ahead of the clock
    for tick in (5, 4):  # the older one comes late
        rig.show(tick, 0)
    rig.clock.step()
    request = m.JournalRequest(first_query=0, max_queries=4)
    (entry,) = rig.links["ponder"].call(topics.JOURNAL, "clock", request, timeout_ns=1).entries
    assert entry.tick == codec.decode(m.Observation, entry.observation).tick == 5


def test_the_journal_of_another_episode_is_not_here(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    rig.enter(episode_info(paper))
    reply = rig.listener.call(topics.JOURNAL, "clock", m.JournalRequest(first_query=0, max_queries=4), timeout_ns=1)
    assert reply.error == "episode '' is not open here for listener"
    rig.listener.enter_episode("s1", "ep-1", 1)
    reply = rig.listener.call(topics.JOURNAL, "clock", m.JournalRequest(first_query=0, max_queries=4), timeout_ns=1)
    assert reply.error == "episode 'ep-1' is not open here for listener"


def test_without_an_episode_none_is_active(rig: Any) -> None:
    assert rig.listener.call(topics.ACTIVE, "clock", m.ActiveRequest(), timeout_ns=1).open is None


def test_an_oracles_episode_is_not_the_servers(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    rig.enter(episode_info(paper, policy="oracle"))
    assert rig.links["ponder"].episode == ""
    assert rig.listener.call(topics.ACTIVE, "clock", m.ActiveRequest(), timeout_ns=1).open is None


def restart_ponder(rig: Any, engine: Any, *, after_queries: int, dead_turns: int) -> None:
    """PONDER dies once ``after_queries`` were asked, and a new process takes its place some turns later."""
    turns = dict.fromkeys(("dead",), 0)

    def meanwhile() -> None:
        if rig.clock.conductor.num_queries < after_queries or turns["dead"] > dead_turns:
            return
        turns["dead"] += 1
        rig.ponder = SimpleNamespace(step=lambda: False)
        if turns["dead"] > dead_turns:
            rig.ponder = rig.start_ponder(Link(rig.bus, robot="r0", proc="ponder"), engine)

    rig.meanwhile = meanwhile


@pytest.mark.parametrize("dead_turns", [0, 50], ids=["between two queries", "while the world waits for it"])
@pytest.mark.parametrize("after_queries", [1, 4, 7])
def test_a_restarted_ponder_answers_as_if_it_had_never_died(
    new_rig: Callable[..., Any],
    fake_ponder: Any,
    episode_info: Info,
    paper: m.Schedule,
    after_queries: int,
    dead_turns: int,
) -> None:
    never, died = new_rig(), new_rig()
    info = episode_info(paper)
    vectors = []
    for rig in (never, died):
        take = rig.listen(topics.COGNITION)
        if rig is died:
            restart_ponder(rig, fake_ponder, after_queries=after_queries, dead_turns=dead_turns)
        _, world = rig.run(info, 200)
        take()
        vectors.append(({c.query: c.vector.tobytes() for c in rig.said[m.Cognition]}, world.commands))
    assert vectors[1] == vectors[0]
    assert fake_ponder.contexts.keys() == {"ep-1"}


def test_a_rebuilt_context_is_told(rig: Any, fake_ponder: Any, episode_info: Info, paper: m.Schedule) -> None:
    take = rig.listen(topics.EVENT)
    restart_ponder(rig, fake_ponder, after_queries=3, dead_turns=0)
    rig.run(episode_info(paper), 100)
    take()
    told = [event.text for event in rig.said[m.Event] if event.name == "context_rebuilt"]
    assert told == ["PONDER rebuilt its context from 3 observations"]


def test_a_journal_that_outgrew_its_limit_rebuilds_nothing(
    new_rig: Callable[..., Any], episode_info: Info, paper: m.Schedule
) -> None:
    rig = new_rig(ServiceConfig(watches=False, journal_limit_bytes=100))
    rig.enter(episode_info(paper))
    rig.show(0, 0)
    rig.clock.step()
    reply = rig.listener.call(topics.ACTIVE, "clock", m.ActiveRequest(), timeout_ns=1)
    assert (reply.open, "outgrew its limit" in reply.error) == (None, True)


# -- engage, close


def test_engage_needs_an_episode(rig: Any) -> None:
    request = m.EngageRequest(operator="jane")
    assert rig.listener.call(topics.ENGAGE, "clock", request, timeout_ns=1).error == "no episode is open"


def test_engage_is_told_with_who_said_so(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    take = rig.listen(topics.EVENT)
    rig.enter(episode_info(paper))
    rig.show(0, 0)
    rig.clock.step()
    rig.clock.conductor.ladder.level = m.Level.STOPPED
    reply = rig.listener.call(topics.ENGAGE, "clock", m.EngageRequest(operator="jane"), timeout_ns=1)
    take()
    assert (reply.error, reply.level) == ("", "HOLD")
    assert "motion may start again, says jane" in {event.text for event in rig.said[m.Event]}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"robot_state": m.RobotState.PROTECTIVE_STOP, "robot_text": "joint 4"}, "PROTECTIVE_STOP joint 4: clear that"),
        ({"proprio": np.full(3, 45, np.float32)}, "state 0 is 45, which arm cannot measure"),
    ],
)
def test_engage_is_refused_while_the_robot_cannot_move_safely(
    rig: Any, episode_info: Info, paper: m.Schedule, changes: dict[str, Any], why: str
) -> None:
    rig.enter(episode_info(paper))
    rig.show(0, 0, **changes)
    rig.clock.step()
    rig.clock.conductor.ladder.level = m.Level.STOPPED
    reply = rig.listener.call(topics.ENGAGE, "clock", m.EngageRequest(operator="jane"), timeout_ns=1)
    assert why in reply.error
    assert rig.clock.conductor.ladder.level == m.Level.STOPPED


def test_engage_is_refused_if_nobody_knows_where_the_arm_is_now(episode_info: Info) -> None:
    live_info = episode_info(schedules.realtime())
    conductor = Conductor(live_info)
    conductor.ladder.level = m.Level.STOPPED
    assert conductor.engage(0) == "no observation has come yet: nobody knows where the arm is"
    zeros = np.zeros(live_info.robot.num_proprio, np.float32)
    conductor.on_observation(m.Observation(tick=0, source_ns=0, proprio=zeros))
    assert conductor.engage(200 * MS) == ""
    assert conductor.engage(200 * MS) == "the robot is not stopped: its level is HOLD"
    conductor.ladder.level = m.Level.STOPPED
    assert conductor.engage(201 * MS) == "the newest observation is 201 ms old; at most 200 ms are allowed"


def test_closing_an_episode_closes_it_everywhere(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    rig.enter(episode_info(paper))
    assert rig.links["sim"].call(topics.CLOSE, "clock", m.CloseRequest(), timeout_ns=1).error == ""
    assert {rig.links[proc].episode for proc in ("clock", "ponder", "pounce")} == {""}
    assert rig.ponder_engine.contexts == {}


def test_a_late_query_does_not_bring_a_closed_episode_back(
    monotonic: Monotonic, new_rig: Callable[..., Any], episode_info: Info, paper: m.Schedule
) -> None:
    """The last query may still lie at PONDER's door when the episode is closed: it must not be thought over again."""
    rig, info = new_rig(), episode_info(paper)
    rig.run(info, 30)
    monotonic.now_ns += 2_000 * MS  # a server asks for its episode once a second at most
    rig.links["clock"].publish(topics.QUERY, m.Query(query=9, tick=29, source_ns=0), at_ns=0)
    assert rig.clock.close(m.CloseRequest(header=rig.links["sim"].header("close", 0))).error == ""
    rig.settle()
    assert rig.ponder_engine.contexts == {}


def test_a_demonstration_is_part_of_the_context(
    new_rig: Callable[..., Any], episode_info: Info, paper: m.Schedule, rig: Any
) -> None:
    demo = (m.DemoFrame(images=rig.observation(9, 0).images),)
    other = new_rig()
    rig.open(episode_info(paper), demo)
    other.open(episode_info(paper))
    digests = [r.ponder_engine.contexts["ep-1"].digest() for r in (rig, other)]
    assert digests[0] != digests[1]


# -- whole episodes


def test_in_one_thread_the_papers_ages_are_exact(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    take = rig.listen(topics.INVOCATION, topics.TICK)
    rig.run(episode_info(paper), 200)
    take()
    assert {i.age_ns for i in rig.said[m.Invocation]} == {300 * MS}
    assert {t.late_ns for t in rig.said[m.Tick]} == {0}


def test_two_runs_are_equal_bit_for_bit(new_rig: Callable[..., Any], episode_info: Info, paper: m.Schedule) -> None:
    runs = [new_rig().run(episode_info(paper), 150)[1].commands for _ in range(2)]
    assert runs[0] == runs[1]


def test_another_seed_is_another_episode(new_rig: Callable[..., Any], episode_info: Info, paper: m.Schedule) -> None:
    runs = [new_rig().run(episode_info(dataclasses.replace(paper, seed=seed)), 50)[1].commands for seed in (1, 2)]
    assert runs[0] != runs[1]


def test_a_second_episode_of_a_session_is_as_good_as_the_first(rig: Any, episode_info: Info, paper: m.Schedule) -> None:
    runs = [rig.run(episode_info(paper, epoch=epoch), 60)[1].commands for epoch in (1, 2)]
    assert runs[0] == runs[1]


def test_host_clock_ids_are_comparable() -> None:
    assert host_clock_id().endswith("/monotonic")
