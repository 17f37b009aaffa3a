"""The schedule of an episode: lockstep is exact, real time degrades in order, and nothing moves without a reason."""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from clock import schedules
from clock.conductor import Conductor, Stage, invocation_seed
from protocol import messages as m

MS = 1_000_000
DIM = 3
NEVER = 10**9  # ms

Info = Callable[..., m.EpisodeInfo]
Delays = Callable[[int], int]


def think(query: m.Query, infer_ms: int = 100) -> m.Cognition:
    vector = np.full((2, 4), query.query + 1, np.float32)
    return m.Cognition(
        query=query.query, tick=query.tick, source_ns=query.source_ns, ready_ns=0, vector=vector,
        infer_ns=infer_ms * MS, is_transition=query.query % 3 == 2,
    )  # fmt: skip


def act(asked: m.Invocation, horizon: int = 20, **changes: Any) -> m.ActionChunk:
    rows = 0.01 * (asked.tick + np.arange(horizon)[:, None] + np.zeros(DIM))
    values = {
        "invocation": asked.invocation, "t_row0": asked.tick, "horizon": horizon, "action_dim": DIM,
        "dt_ns": 50 * MS, "rows": rows.astype(np.float32).ravel(), "source_ns": asked.now_ns,
        "ref_query": asked.ref_query, "age_ns": asked.age_ns, "infer_ns": 25 * MS,
    }  # fmt: skip
    return m.ActionChunk(**(values | changes))


def look(tick: int, source_ns: int, status: m.TaskStatus = m.TaskStatus.ONGOING) -> m.Observation:
    return m.Observation(tick=tick, source_ns=source_ns, proprio=np.full(DIM, 0.1, np.float32), status=status)


@dataclass
class Play:
    """What a conductor did, with when it did it."""

    conductor: Conductor
    effects: list[tuple[int, Any]] = field(default_factory=list)

    def of(self, cls: type) -> list[Any]:
        return [effect for _, effect in self.effects if isinstance(effect, cls)]

    @property
    def levels(self) -> list[str]:
        return [tick.level.name for tick in self.of(m.Tick)]

    def events(self, name: str) -> list[m.Event]:
        return [event for event in self.of(m.Event) if event.name == name]


def lockstep(info: m.EpisodeInfo, num_ticks: int, order: np.random.Generator | None = None) -> Play:
    """Answers are handed over at once, or with ``order`` in any order and as late as time can wait for them."""
    play = Play(Conductor(info))
    conductor, inbox, now_ns = play.conductor, [look(0, 0)], 0
    while conductor.tick < num_ticks:
        for effect in conductor.poll(now_ns):
            play.effects.append((now_ns, effect))
            if isinstance(effect, m.Query):
                inbox.append(think(effect))
            elif isinstance(effect, m.Invocation):
                inbox.append(act(effect, info.schedule.horizon))
            elif isinstance(effect, m.Action):
                inbox.append(look(effect.tick + 1, conductor.deadline_ns(effect.tick + 1)))
        due_ns = conductor.next_ns(now_ns)
        is_free = not conductor.is_waiting(now_ns) and due_ns is not None
        if inbox and (order is None or not is_free or order.random() < 0.3):
            message = inbox.pop(int(order.integers(len(inbox))) if order else 0)
            hear(conductor, message, now_ns)
        elif is_free:
            now_ns = max(now_ns, due_ns)
    return play


def hear(conductor: Conductor, message: Any, now_ns: int) -> None:
    if isinstance(message, m.Observation):
        conductor.on_observation(message)
    elif isinstance(message, m.Cognition):
        conductor.on_cognition(message, now_ns)
    else:
        conductor.on_chunk(message, now_ns)


def realtime(
    info: m.EpisodeInfo,
    until_ms: int,
    *,
    ponder_ms: Delays = lambda query: 300,
    pounce_ms: Delays = lambda invocation: 40,
    at: dict[int, Callable[[Conductor], Any]] | None = None,
    stall_ms: tuple[int, int] = (0, 0),
) -> Play:
    """A world with transport and models that take their time. ``at``: interventions by instant (ms)."""
    play = Play(Conductor(dataclasses.replace(info, schedule=dataclasses.replace(info.schedule, mode=m.Mode.REALTIME))))
    conductor, coming = play.conductor, list[tuple[int, int, Any]]()

    def post(at_ns: int, what: Any) -> None:
        heapq.heappush(coming, (at_ns, len(play.effects) * 1000 + len(coming), what))

    post(0, look(0, 0))
    for at_ms, deed in (at or {}).items():
        post(at_ms * MS, deed)
    now_ns = 0
    while now_ns < until_ms * MS:
        due_ns = conductor.next_ns(now_ns)
        arrival_ns = coming[0][0] if coming else NEVER * MS
        now_ns = max(now_ns, min(arrival_ns, due_ns if due_ns is not None else NEVER * MS))
        if stall_ms[0] * MS <= now_ns < stall_ms[1] * MS:
            now_ns = stall_ms[1] * MS
        while coming and coming[0][0] <= now_ns:
            what = heapq.heappop(coming)[2]
            what(conductor) if callable(what) else hear(conductor, what, now_ns)
        for effect in conductor.poll(now_ns):
            play.effects.append((now_ns, effect))
            if isinstance(effect, m.Query):
                post(now_ns + ponder_ms(effect.query) * MS, think(effect))
            elif isinstance(effect, m.Invocation):
                post(now_ns + pounce_ms(effect.invocation) * MS, act(effect))
            elif isinstance(effect, m.Action):
                post(now_ns + 5 * MS, look(effect.tick + 1, conductor.deadline_ns(effect.tick + 1)))
    return play


@pytest.fixture
def paper_info(episode_info: Info) -> m.EpisodeInfo:
    return episode_info(schedules.paper())


@pytest.fixture
def live_info(episode_info: Info) -> m.EpisodeInfo:
    return episode_info(schedules.realtime())


def with_(info: m.EpisodeInfo, **changes: Any) -> m.EpisodeInfo:
    return dataclasses.replace(info, schedule=dataclasses.replace(info.schedule, **changes))


def plain(play: Play) -> list[Any]:
    """Everything the conductor did, except when an answer happened to arrive."""

    def values(effect: Any) -> Iterator[tuple[str, Any]]:
        for f in dataclasses.fields(effect):
            value = getattr(effect, f.name)
            if f.name not in ("header", "arrived_ns"):
                yield f.name, value.tobytes() if isinstance(value, np.ndarray) else value

    return [(now_ns, type(effect).__name__, dict(values(effect))) for now_ns, effect in play.effects]


# -- lockstep


def test_the_papers_schedule_gives_every_invocation_an_age_of_300_ms(paper_info: m.EpisodeInfo) -> None:
    invocations = lockstep(paper_info, 400).of(m.Invocation)
    assert len(invocations) == 20
    assert {invocation.age_ns for invocation in invocations} == {300 * MS}


def test_the_papers_schedule_plays_every_row_of_every_chunk(paper_info: m.EpisodeInfo) -> None:
    ticks = lockstep(paper_info, 400).of(m.Tick)
    assert [(tick.invocation, tick.row) for tick in ticks] == [(k // 20, k % 20) for k in range(400)]
    assert {tick.level for tick in ticks} == {m.Level.PLAY}


def test_an_invocation_carries_the_vector_of_its_reference(paper_info: m.EpisodeInfo) -> None:
    for invocation in lockstep(paper_info, 200).of(m.Invocation):
        assert (invocation.cognition == invocation.ref_query + 1).all()


def test_equal_schedules_are_equal_episodes(paper_info: m.EpisodeInfo) -> None:
    assert plain(lockstep(paper_info, 200)) == plain(lockstep(paper_info, 200))


DELAYS = st.sampled_from(
    [
        schedules.MEASURED,
        schedules.NONE,
        schedules.FIXED_300_MS,
        schedules.TRAINING_DELAY,
        m.Delay(kind=m.DelayKind.FIXED, mean_ns=1_700 * MS),
    ]
)


@given(seed=st.integers(0, 2**32 - 1), query_delay=DELAYS, invoke_delay=DELAYS, period=st.integers(1, 20))
@example(seed=0, query_delay=schedules.MEASURED, invoke_delay=schedules.TRAINING_DELAY, period=1)  # due between ticks
@example(seed=4, query_delay=schedules.FIXED_300_MS, invoke_delay=schedules.FIXED_300_MS, period=2)  # due together
@settings(max_examples=40, deadline=None)
def test_lockstep_does_not_depend_on_when_answers_come(
    episode_info: Info, seed: int, query_delay: m.Delay, invoke_delay: m.Delay, period: int
) -> None:
    info = with_(
        episode_info(schedules.paper()),
        query_delay=query_delay,
        invoke_delay=invoke_delay,
        invoke_period_ticks=period,
        seed=seed,
    )
    late = lockstep(info, 80, np.random.default_rng(seed))
    assert plain(late) == plain(lockstep(info, 80))


def test_null_delivery_gives_nothing_and_age_zero(paper_info: m.EpisodeInfo) -> None:
    info = with_(paper_info, delivery=m.Delivery(kind=m.DeliveryKind.NULL))
    given_ = {(i.ref_query, i.age_ns, i.cognition.size) for i in lockstep(info, 100).of(m.Invocation)}
    assert given_ == {(None, 0, 0)}


def test_ponder_is_queried_although_its_answers_are_not_delivered(paper_info: m.EpisodeInfo) -> None:
    info = with_(paper_info, delivery=m.Delivery(kind=m.DeliveryKind.NULL))
    assert len(lockstep(info, 100).of(m.Query)) == len(lockstep(paper_info, 100).of(m.Query))


def test_held_transitions_are_delivered_with_the_age_they_are_told(paper_info: m.EpisodeInfo) -> None:
    held = m.Delivery(kind=m.DeliveryKind.HELD_TRANSITION, reported_age_ns=300 * MS)
    invocations = lockstep(with_(paper_info, delivery=held), 200).of(m.Invocation)
    assert [i.ref_query for i in invocations] == [0, 0, 2, 2, 2, 5, 5, 5, 8, 8]
    assert {i.age_ns for i in invocations} == {300 * MS}


def test_an_old_held_vector_is_still_there(paper_info: m.EpisodeInfo) -> None:
    held = with_(paper_info, delivery=m.Delivery(kind=m.DeliveryKind.HELD_TRANSITION))
    for invocation in lockstep(held, 800).of(m.Invocation):
        assert (invocation.cognition == invocation.ref_query + 1).all()


@pytest.mark.parametrize(
    "changes",
    [{"invoke_period_ticks": 5}, {"query_delay": schedules.TRAINING_DELAY}, {"seam": m.Seam(kind=m.SeamKind.ENSEMBLE)}],
)
def test_a_seed_depends_on_the_episode_and_the_invocation_only(
    paper_info: m.EpisodeInfo, changes: dict[str, Any]
) -> None:
    seeds = [i.seed for i in lockstep(with_(paper_info, **changes), 200).of(m.Invocation)]
    assert seeds == [invocation_seed(paper_info.schedule.seed, j) for j in range(len(seeds))]


def test_seeds_differ_between_invocations_and_episodes() -> None:
    seeds = {invocation_seed(episode, j) for episode in range(20) for j in range(50)}
    assert len(seeds) == 1000
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_a_chunk_is_told_what_is_left_of_the_one_before(paper_info: m.EpisodeInfo) -> None:
    second = lockstep(with_(paper_info, invoke_period_ticks=5), 12).of(m.Invocation)[1]
    assert second.previous_rows.reshape(-1, DIM)[:, 0] == pytest.approx(0.01 * np.arange(5, 20), abs=1e-6)


def test_time_stands_still_while_an_answer_is_owed(paper_info: m.EpisodeInfo) -> None:
    conductor = Conductor(paper_info)
    conductor.on_observation(look(0, 0))
    (query,) = conductor.poll(0)
    assert not conductor.is_waiting(299 * MS)
    assert conductor.is_waiting(300 * MS)
    conductor.on_cognition(think(query), 300 * MS)
    assert not conductor.is_waiting(300 * MS)


# -- the beginning and the end


@pytest.mark.parametrize("wait", [m.WaitKind.STAND_STILL, m.WaitKind.HOLD])
def test_nothing_is_asked_before_the_first_observation(live_info: m.EpisodeInfo, wait: m.WaitKind) -> None:
    conductor = Conductor(with_(live_info, wait=wait))
    assert [conductor.poll(now_ms * MS) for now_ms in (0, 50, 5_000)] == [[], [], []]


def test_nothing_is_played_before_the_first_cognition(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 5_000, ponder_ms=lambda query: 4_000)
    order = [type(effect).__name__ for _, effect in play.effects]
    assert play.effects[order.index("Stamp")][1].kind == m.StampKind.COGNITION
    assert order.index("Stamp") < order.index("Invocation") < order.index("Action")


def test_tick_zero_is_due_when_the_first_chunk_came(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 1_000, ponder_ms=lambda query: 200, pounce_ms=lambda invocation: 70)
    assert play.of(m.Tick)[0].deadline_ns == 270 * MS


def test_with_hold_the_initial_command_is_held_until_the_first_chunk(live_info: m.EpisodeInfo) -> None:
    initial = np.array([0.3, -0.2, 1], np.float32)
    info = with_(live_info, wait=m.WaitKind.HOLD)
    info = dataclasses.replace(info, robot=dataclasses.replace(info.robot, initial_command=initial))
    play = realtime(info, 2_000, ponder_ms=lambda query: 900)
    held = play.levels.index("PLAY")
    assert play.levels[:held] == ["HOLD"] * held
    assert held >= 18
    assert all((action.values == initial).all() for action in play.of(m.Action)[:held])


@pytest.mark.parametrize("status", [s for s in m.TaskStatus if s > m.TaskStatus.ONGOING])
def test_nothing_happens_after_the_task_has_ended(live_info: m.EpisodeInfo, status: m.TaskStatus) -> None:
    conductor = realtime(live_info, 2_000).conductor
    conductor.on_observation(look(1_000, 2_000 * MS, status))
    assert conductor.poll(3_000 * MS) == []
    assert conductor.stage == Stage.ENDED


# -- real time


def test_a_steady_real_time_episode_never_starves(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 8_000)
    assert set(play.levels) == {"PLAY"}


def test_deadlines_do_not_drift(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 8_000)
    start_ns = play.conductor.start_ns
    assert [t.deadline_ns - start_ns for t in play.of(m.Tick)] == [50 * MS * k for k in range(len(play.levels))]


def test_a_late_chunk_loses_the_rows_that_are_past(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 3_000, pounce_ms=lambda invocation: 140)
    first_rows = {}
    for tick in play.of(m.Tick):
        first_rows.setdefault(tick.invocation, tick.row)
    assert [first_rows[j] for j in (1, 2, 3)] == [3, 3, 3]


def test_a_row_is_played_at_its_own_tick_however_late_its_chunk(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 6_000, pounce_ms=lambda invocation: 30 + 97 * invocation % 400)
    assert {tick.tick - tick.t_row0 - tick.row for tick in play.of(m.Tick)} == {0}


def test_the_papers_horizon_starves_d_ticks_per_chunk_in_real_time(paper_info: m.EpisodeInfo) -> None:
    play = realtime(with_(paper_info, query_delay=schedules.MEASURED, invoke_delay=schedules.MEASURED), 6_000,
                    pounce_ms=lambda invocation: 140)  # fmt: skip
    assert play.levels[20:40] == ["HOLD"] * 3 + ["PLAY"] * 17
    assert play.levels[40:60] == ["HOLD"] * 3 + ["PLAY"] * 17


def test_one_request_at_a_time_is_under_way_at_each_server(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 12_000, ponder_ms=lambda query: 1_600, pounce_ms=lambda invocation: 440)
    for asked, kind in ((m.Query, m.StampKind.COGNITION), (m.Invocation, m.StampKind.CHUNK)):
        under_way = most = 0
        for _, effect in play.effects:
            under_way += isinstance(effect, asked) - (isinstance(effect, m.Stamp) and effect.kind == kind)
            most = max(most, under_way)
        assert most == 1


def test_a_lost_chunk_does_not_silence_pounce_for_ever(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 8_000, pounce_ms=lambda invocation: NEVER if invocation == 2 else 40,
                    at={4_000: lambda c: c.engage(4_000 * MS)})  # fmt: skip
    assert [i.invocation for i in play.of(m.Invocation)][:4] == [0, 1, 2, 3]
    assert play.levels[-1] == "PLAY"


def test_a_lost_cognition_costs_an_older_reference_and_not_the_episode(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 8_000, ponder_ms=lambda query: NEVER if query == 2 else 300)
    assert set(play.levels) == {"PLAY", "STALE"}  # an alarm while the next query is under way; its rows are played
    assert play.of(m.Invocation)[-1].ref_query > 2


def test_an_overdue_answer_is_still_taken(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 8_000, ponder_ms=lambda query: 2_500 if query == 1 else 300)
    stamps = [stamp.index for stamp in play.of(m.Stamp) if stamp.kind == m.StampKind.COGNITION]
    assert 1 in stamps


def test_a_slow_ponder_means_an_older_reference_with_a_growing_age(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 4_000, ponder_ms=lambda query: 300 if query == 0 else NEVER)
    invocations = play.of(m.Invocation)
    assert {i.ref_query for i in invocations} == {0}
    ages = [i.age_ns for i in invocations]
    assert set(np.diff(ages[1:])) == {500 * MS}


def test_without_fresh_cognition_the_robot_goes_down_the_whole_ladder(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 16_000, ponder_ms=lambda query: 300 if query == 0 else NEVER)
    assert list(dict.fromkeys(play.levels)) == ["PLAY", "STALE", "HOLD", "DECELERATE", "STOPPED"]


def test_rows_are_stale_exactly_when_their_age_says_so(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 9_000, ponder_ms=lambda query: 300 if query == 0 else NEVER)
    limit = live_info.schedule.max_age_ns
    assert all((t.level == m.Level.STALE) == (t.age_ns > limit) for t in play.of(m.Tick))


def test_a_dead_pounce_means_hold_then_slow_down_then_stop(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 6_000, pounce_ms=lambda invocation: 40 if invocation < 2 else NEVER)
    down = [level for level in play.levels if level != "PLAY"]
    schedule = live_info.schedule
    assert down[:10] == ["HOLD"] * schedule.hold_limit_ticks
    assert down[10:19] == ["DECELERATE"] * (schedule.decelerate_ticks - 1)
    assert set(down[19:]) == {"STOPPED"}
    assert play.levels.index("HOLD") == 10 + schedule.horizon


def test_a_stopped_robot_stays_stopped_when_pounce_is_back(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 9_000, pounce_ms=lambda invocation: NEVER if invocation == 2 else 40,
                    at={1_500: lambda c: c.on_lost("pounce"), 4_500: lambda c: c.on_back("pounce")})  # fmt: skip
    assert play.levels[-1] == "STOPPED"
    still = [action.values for action in play.of(m.Action)][-40:]
    assert all((values == still[0]).all() for values in still)


def test_engage_starts_motion_again(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 9_000, pounce_ms=lambda invocation: NEVER if invocation == 2 else 40,
                    at={1_500: lambda c: c.on_lost("pounce"), 4_500: lambda c: c.on_back("pounce"),
                        6_000: lambda c: c.engage(6_000 * MS)})  # fmt: skip
    assert play.levels[-1] == "PLAY"


def test_every_change_of_level_is_told(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 16_000, ponder_ms=lambda query: 300 if query == 0 else NEVER)
    told = [event.text.split(":")[0] for event in play.events("level")]
    assert told == ["PLAY -> STALE", "STALE -> HOLD", "HOLD -> DECELERATE", "DECELERATE -> STOPPED"]


def test_ticks_that_the_clock_slept_through_are_skipped_and_not_caught_up(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 4_000, stall_ms=(2_000, 2_330))
    ticks = play.of(m.Tick)
    assert [tick.tick for tick in ticks] == list(range(len(ticks)))
    skipped = [tick.tick for tick in ticks if tick.level == m.Level.SKIPPED]
    assert skipped == [34, 35, 36, 37, 38]
    assert set(skipped).isdisjoint(action.tick for action in play.of(m.Action))
    assert len(play.events("ticks_skipped")) == 1


def test_an_absent_ponder_is_not_queried(live_info: m.EpisodeInfo) -> None:
    play = realtime(live_info, 6_000, at={1_200: lambda c: c.on_lost("ponder"), 4_200: lambda c: c.on_back("ponder")})
    instants_ms = [now_ns / MS for now_ns, effect in play.effects if isinstance(effect, m.Query)]
    assert not [at for at in instants_ms if 1_200 < at < 4_200]
    assert [at for at in instants_ms if at > 4_200]
    assert len(play.events("query_skipped")) == 1


def test_a_query_is_about_an_observation_that_no_query_was_about(live_info: m.EpisodeInfo) -> None:
    asked = [query.tick for query in realtime(live_info, 8_000).of(m.Query)]
    assert asked == sorted(set(asked))


def test_a_nan_row_is_held_and_told(live_info: m.EpisodeInfo) -> None:
    conductor = realtime(live_info, 1_000).conductor
    for effect in conductor.poll(conductor.deadline_ns(conductor.tick)):
        assert not isinstance(effect, m.Invocation)
    before = conductor.last_command
    for chunk in conductor._chunks:
        chunk.rows_NA[:] = np.nan
    effects = conductor.poll(conductor.deadline_ns(conductor.tick))
    (action,) = [effect for effect in effects if isinstance(effect, m.Action)]
    assert action.level == m.Level.HOLD
    assert (action.values == before).all()
    assert [effect.name for effect in effects if isinstance(effect, m.Event)] == ["non_finite_row", "level"]


# -- answers nobody asked for


@dataclass
class Desk:
    """A conductor with one query, then one invocation, under way."""

    conductor: Conductor
    query: m.Query
    invocation: m.Invocation


@pytest.fixture
def desk(live_info: m.EpisodeInfo) -> Desk:
    conductor = Conductor(live_info)
    conductor.on_observation(look(0, 0))
    (query,) = conductor.poll(0)
    conductor.on_cognition(think(query), 300 * MS)
    _, invocation = conductor.poll(300 * MS)
    assert isinstance(query, m.Query)
    assert isinstance(invocation, m.Invocation)
    return Desk(conductor, query, invocation)


@pytest.mark.parametrize(
    "changes",
    [
        {"invocation": 1},
        {"source_ns": 299 * MS},
        {"horizon": 10, "rows": np.zeros(10 * DIM, np.float32)},
        {"action_dim": 2, "rows": np.zeros(20 * 2, np.float32)},
        {"action_space": m.ActionSpace.EE_POSE},
    ],
    ids=["index", "source", "horizon", "action_dim", "action_space"],
)
def test_a_chunk_nobody_asked_for_is_not_taken(desk: Desk, changes: dict[str, Any]) -> None:
    assert not desk.conductor.on_chunk(act(desk.invocation, **changes), 320 * MS)
    assert desk.conductor.poll(400 * MS) == []


@pytest.mark.parametrize("changes", [{"query": 7}, {"source_ns": 1}, {}], ids=["index", "source", "answered"])
def test_a_cognition_nobody_asked_for_is_not_taken(desk: Desk, changes: dict[str, Any]) -> None:
    assert not desk.conductor.on_cognition(dataclasses.replace(think(desk.query), **changes), 320 * MS)


def test_the_second_of_two_answers_is_not_taken(desk: Desk) -> None:
    assert desk.conductor.on_chunk(act(desk.invocation), 320 * MS)
    assert not desk.conductor.on_chunk(act(desk.invocation, rows=np.ones(20 * DIM, np.float32)), 330 * MS)


def test_an_answer_after_its_server_was_lost_is_not_taken(desk: Desk) -> None:
    desk.conductor.on_lost("pounce")
    assert not desk.conductor.on_chunk(act(desk.invocation), 320 * MS)


def test_an_older_observation_does_not_replace_a_newer_one(desk: Desk) -> None:
    assert desk.conductor.on_observation(look(5, 9))
    assert not desk.conductor.on_observation(look(4, 8))
