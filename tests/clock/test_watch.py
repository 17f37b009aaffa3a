"""A server that died, froze, hangs or forgot is noticed within its timeout, and is back only in the episode."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.watch import HEARTBEAT_TIMEOUT_NS, TOKEN_GRACE_NS, Change, Watch
from protocol.messages import Header, Health, ServingState

MS = 1_000_000
PROCS = ("ponder",)
READY = ServingState.READY
GONE_NS = TOKEN_GRACE_NS + 1


def health(state: ServingState = READY, episode: str = "e1", detail: str = "", proc: str = "ponder") -> Health:
    return Health(header=Header(proc=proc), state=state, open_episode=episode, detail=detail)


@pytest.fixture
def watch() -> Watch:
    """One that has just heard a good server."""
    watch = Watch()
    watch.on_health(health(), 0)
    assert watch.poll(PROCS, "e1", 0) == []
    return watch


def test_a_beating_server_is_not_lost(watch: Watch) -> None:
    for now_ms in range(0, 10_000, 100):
        watch.on_health(health(), now_ms * MS)
        assert watch.poll(PROCS, "e1", now_ms * MS) == []


def test_a_silent_server_is_lost_after_its_timeout_and_not_before(watch: Watch) -> None:
    assert watch.poll(PROCS, "e1", HEARTBEAT_TIMEOUT_NS) == []
    (change,) = watch.poll(PROCS, "e1", HEARTBEAT_TIMEOUT_NS + 1)
    assert change == Change(
        proc="ponder", is_lost=True, why="no heartbeat for 700 ms: it is frozen, or its inference loop hangs"
    )


def test_a_dead_process_is_lost_with_its_token(watch: Watch) -> None:
    watch.on_token("ponder", False)
    assert watch.poll(PROCS, "e1", TOKEN_GRACE_NS) == []
    (change,) = watch.poll(PROCS, "e1", TOKEN_GRACE_NS + 1)
    assert (change.is_lost, "liveliness token is gone" in change.why) == (True, True)


def test_a_token_that_anybody_withdraws_loses_no_server_that_beats(watch: Watch) -> None:
    for now_ms in range(0, 5_000, 100):
        watch.on_token("ponder", now_ms % 200 == 0)
        watch.on_health(health(), now_ms * MS)
        watch.on_token("ponder", False)
        assert watch.poll(PROCS, "e1", (now_ms + 99) * MS) == []


def test_what_a_process_outside_of_the_episode_says_under_a_servers_name_is_nothing(watch: Watch) -> None:
    watch.members = {"ponder": 0}
    watch.on_health(replace(health(ServingState.FAILED), header=Header(proc="ponder", boot_id=7)), 1)
    assert watch.poll(PROCS, "e1", 1) == []
    watch.members = {"ponder": 7}
    watch.on_health(health(), 2)  # nor what its predecessor says
    (change,) = watch.poll(PROCS, "e1", HEARTBEAT_TIMEOUT_NS + 1)
    assert "no heartbeat" in change.why


def test_a_hung_loop_is_lost_although_its_token_lives(watch: Watch) -> None:
    watch.on_token("ponder", True)
    assert [c.is_lost for c in watch.poll(PROCS, "e1", 2 * HEARTBEAT_TIMEOUT_NS)] == [True]


def test_a_restarted_server_that_does_not_know_the_episode_is_lost(watch: Watch) -> None:
    watch.on_health(health(episode=""), 1)
    (change,) = watch.poll(PROCS, "e1", 1)
    assert change.why == "it was restarted and does not know the episode yet"


@pytest.mark.parametrize("state", [s for s in ServingState if s not in (READY, ServingState.UNSPECIFIED)])
def test_a_server_that_is_not_ready_is_lost(watch: Watch, state: ServingState) -> None:
    watch.on_health(health(state, detail="why"), 1)
    assert [c.why for c in watch.poll(PROCS, "e1", 1)] == [f"it is {state.name.lower()} why"]


def test_a_loss_is_told_once(watch: Watch) -> None:
    watch.on_token("ponder", False)
    assert [len(watch.poll(PROCS, "e1", now_ns)) for now_ns in (GONE_NS, GONE_NS + 1, 10**10)] == [1, 0, 0]


def test_a_server_is_back_only_when_it_knows_the_episode(watch: Watch) -> None:
    watch.on_token("ponder", False)
    watch.poll(PROCS, "e1", GONE_NS)
    steps = [health(ServingState.LOADING, ""), health(ServingState.WARMING, ""), health(READY, ""), health()]
    told = []
    for now_ns, beat in enumerate(steps, GONE_NS):
        watch.on_health(beat, now_ns)
        told.append([change.is_lost for change in watch.poll(PROCS, "e1", now_ns)])
    assert told == [[], [], [], [False]]


def test_a_server_never_heard_is_lost_after_the_timeout() -> None:
    watch = Watch()
    assert watch.poll(PROCS, "e1", 10**12) == []
    assert [c.is_lost for c in watch.poll(PROCS, "e1", 10**12 + HEARTBEAT_TIMEOUT_NS + 1)] == [True]


def test_a_successors_token_is_no_sign_that_it_knows_the_episode(watch: Watch) -> None:
    """The token of a restarted process comes before its first heartbeat; its predecessor's says nothing about it."""
    watch.on_token("ponder", False)
    watch.poll(PROCS, "e1", GONE_NS)
    watch.on_token("ponder", True)
    assert watch.poll(PROCS, "e1", GONE_NS) == []
    watch.on_health(health(episode="e1"), GONE_NS)
    assert [change.is_lost for change in watch.poll(PROCS, "e1", GONE_NS)] == [False]


def test_a_new_episode_forgets_old_losses(watch: Watch) -> None:
    watch.on_token("ponder", False)
    watch.poll(PROCS, "e1", GONE_NS)
    watch.enter({"ponder": 0}, 10**12)
    assert watch.poll(PROCS, "e2", 10**12 + HEARTBEAT_TIMEOUT_NS) == []  # it has answered, and need not have beaten yet
    watch.on_health(health(episode="e2"), 10**12 + HEARTBEAT_TIMEOUT_NS)
    assert watch.poll(PROCS, "e2", 10**12 + HEARTBEAT_TIMEOUT_NS) == []


def test_a_heartbeat_from_before_the_opening_is_no_loss(watch: Watch) -> None:
    watch.enter({"ponder": 0}, 10**12)
    watch.on_health(health(episode="e1"), 10**12)
    assert watch.poll(PROCS, "e2", 10**12) == []
    watch.on_health(health(episode="e2"), 10**12 + 1)
    assert watch.poll(PROCS, "e2", 10**12 + 1) == []
    watch.on_health(health(episode="e1"), 10**12 + 2)
    assert [change.is_lost for change in watch.poll(PROCS, "e2", 10**12 + 2)] == [True]


def test_a_server_that_never_names_the_episode_is_lost(watch: Watch) -> None:
    watch.enter({"ponder": 0}, 0)
    told = []
    for now_ns in (0, HEARTBEAT_TIMEOUT_NS, HEARTBEAT_TIMEOUT_NS + 1):
        watch.on_health(health(episode=""), now_ns)
        told.append([change.is_lost for change in watch.poll(PROCS, "e2", now_ns)])
    assert told == [[], [], [True]]


def test_one_loss_is_not_the_others(watch: Watch) -> None:
    watch.on_health(health(proc="pounce"), 0)
    watch.on_token("pounce", False)
    assert [change.proc for change in watch.poll(("ponder", "pounce"), "e1", GONE_NS)] == ["pounce"]


def test_a_server_nobody_opened_is_nobodys_loss(watch: Watch) -> None:
    watch.on_token("sim", False)
    assert watch.poll(PROCS, "e1", 1) == []
    assert watch.is_gone("sim")


def test_the_health_of_a_lost_server_is_none(watch: Watch) -> None:
    assert watch.health_of("ponder") is not None
    watch.poll(PROCS, "e1", 10**10)
    assert watch.health_of("ponder") is None


@given(beats_ms=st.lists(st.integers(0, 5_000), max_size=30).map(sorted))
def test_lost_and_back_take_turns(beats_ms: list[int]) -> None:
    watch, told = Watch(), []
    watch.poll(PROCS, "e1", 0)
    for now_ms in range(0, 6_000, 50):
        for beat_ms in beats_ms:
            if now_ms - 50 < beat_ms <= now_ms:
                watch.on_health(health(), now_ms * MS)
        told += [change.is_lost for change in watch.poll(PROCS, "e1", now_ms * MS)]
    assert told == [position % 2 == 0 for position in range(len(told))]
