"""The in-process bus keeps the promises that the code makes of any bus."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.bus import Bell, LocalBus, Request, Sample, Subscription
from protocol.errors import CallFailed
from protocol.topics import Priority


def put(bus: LocalBus, key: str, payload: bytes) -> None:
    bus.publish(key, payload, encoding="e", attachment=b"a", priority=Priority.DATA)


def payloads(subscription: Subscription) -> list[bytes]:
    return [sample.payload for sample in subscription.drain()]


def ring(keep: int, count: int) -> Subscription:
    subscription = Subscription(keep)
    for number in range(count):
        subscription.put(lambda number=number: Sample("k", bytes([number]), "", b""))  # type: ignore[misc]
    return subscription


@given(sent=st.lists(st.binary(max_size=4), max_size=8))
def test_messages_arrive_in_the_order_they_were_sent(sent: list[bytes]) -> None:
    bus = LocalBus()
    subscription = bus.subscribe("a/*", keep=8)
    for payload in sent:
        put(bus, "a/b", payload)
    assert payloads(subscription) == sent


@given(keep=st.integers(1, 8), count=st.integers(0, 20))
def test_a_ring_keeps_the_newest(keep: int, count: int) -> None:
    assert payloads(ring(keep, count)) == [bytes([n]) for n in range(count)][-keep:]


@given(keep=st.integers(1, 8), count=st.integers(0, 20))
def test_what_fell_out_of_a_ring_is_counted(keep: int, count: int) -> None:
    subscription = ring(keep, count)
    assert subscription.num_superseded == max(0, count - keep)
    subscription.drain()
    assert subscription.num_superseded == max(0, count - keep)


@given(keep=st.integers(1, 4), expected=st.lists(st.booleans(), max_size=20))
def test_who_is_not_expected_pushes_out_nobody_else_and_the_order_is_kept(keep: int, expected: list[bool]) -> None:
    subscription = Subscription(keep, lambda attachment: attachment == b"expected")
    for number, is_expected in enumerate(expected):
        attachment = b"expected" if is_expected else b"other"
        subscription.put(lambda number=number: Sample("k", bytes([number]), "", b""), attachment)  # type: ignore[misc]
    kinds = [[n for n, each in enumerate(expected) if each is kind] for kind in (True, False)]
    assert payloads(subscription) == [bytes([n]) for n in sorted(kinds[0][-keep:] + kinds[1][-keep:])]
    assert subscription.num_superseded == max(0, len(kinds[0]) - keep)
    assert subscription.num_strange_superseded == max(0, len(kinds[1]) - keep)


def test_what_falls_out_of_a_ring_is_never_copied() -> None:
    copied = []
    subscription = Subscription(1)
    for number in range(3):
        subscription.put(lambda number=number: copied.append(number) or Sample("k", b"", "", b""))  # type: ignore[misc, func-returns-value]
    subscription.drain()
    assert copied == [2]


def test_a_drained_subscription_is_empty() -> None:
    subscription = ring(4, 2)
    subscription.drain()
    assert subscription.drain() == []


def test_a_message_reaches_every_subscriber_whose_expression_matches() -> None:
    bus = LocalBus()
    matching, other = [bus.subscribe("a/*", keep=2), bus.subscribe("a/b", keep=2)], bus.subscribe("a/c", keep=2)
    put(bus, "a/b", b"1")
    assert [payloads(s) for s in matching] == [[b"1"], [b"1"]]
    assert payloads(other) == []


def test_what_was_sent_before_a_subscription_is_not_seen() -> None:
    bus = LocalBus()
    put(bus, "a", b"1")
    assert payloads(bus.subscribe("a", keep=2)) == []


def test_key_encoding_and_attachment_travel_along() -> None:
    bus = LocalBus()
    subscription = bus.subscribe("a", keep=1)
    put(bus, "a", b"1")
    assert subscription.drain() == [Sample("a", b"1", "e", b"a")]


def test_a_call_is_answered_by_the_participant_that_serves_it() -> None:
    bus = LocalBus()
    inbox = bus.serve("twice")

    def participant() -> bool:
        requests = inbox.drain()
        for request in requests:
            request.reply(request.payload * 2)
        return bool(requests)

    bus.add_participant(participant)
    assert bus.call("twice", b"ab", timeout_ns=1) == b"abab"


def test_a_call_waits_for_a_participant_that_needs_several_steps() -> None:
    bus = LocalBus()
    inbox, waiting = bus.serve("slow"), [b"think", b"think"]

    def participant() -> bool:
        if waiting:
            waiting.pop()
            return True
        for request in inbox.drain():
            request.reply(b"done")
        return True

    bus.add_participant(participant)
    assert bus.call("slow", b"", timeout_ns=1) == b"done"


def test_a_call_that_nobody_serves_fails() -> None:
    with pytest.raises(CallFailed, match=r"no answer on a/b within 2000 ms: nobody serves it"):
        LocalBus().call("a/b", b"", timeout_ns=2_000_000_000)


def test_a_call_whose_server_is_idle_fails() -> None:
    bus = LocalBus()
    bus.serve("mute")
    bus.add_participant(lambda: False)
    with pytest.raises(CallFailed, match="has nothing to do and did not answer"):
        bus.call("mute", b"", timeout_ns=1)


def test_a_participant_that_waits_for_an_answer_is_not_stepped_meanwhile() -> None:
    bus, steps = LocalBus(), []
    inbox = bus.serve("other")

    def asking() -> bool:
        steps.append("asking")
        return bus.call("other", b"", timeout_ns=1) == b"done"

    def answering() -> bool:
        requests = inbox.drain()
        for request in requests:
            request.reply(b"done")
        return bool(requests)

    bus.add_participant(asking)
    bus.add_participant(answering)
    bus.run_participants()
    assert steps == ["asking"]


def test_every_participant_gets_its_turn_whoever_was_busy() -> None:
    bus, turns = LocalBus(), []
    for name in "abc":
        bus.add_participant(lambda name=name: turns.append(name) is None)  # type: ignore[misc]
    bus.wait(0)
    assert turns == ["a", "b", "c"]


def test_a_full_inbox_forgets_the_oldest_request() -> None:
    inbox = LocalBus().serve("k")
    for number in range(40):
        inbox.put(Request(bytes([number]), lambda payload: None))
    assert [request.payload[0] for request in inbox.drain()] == list(range(8, 40))


def alive(subscription: Subscription) -> list[tuple[str, bytes]]:
    return [(sample.key, sample.payload) for sample in subscription.drain()]


def test_tokens_are_seen_to_appear_and_to_go() -> None:
    bus = LocalBus()
    watching = bus.watch_alive("alive/*")
    bus.declare_alive("alive/ponder")
    bus.end_alive("alive/ponder")
    assert alive(watching) == [("alive/ponder", b"1"), ("alive/ponder", b"")]


def test_tokens_that_were_there_before_are_seen() -> None:
    bus = LocalBus()
    for proc in ("ponder", "pounce"):
        bus.declare_alive(f"alive/{proc}")
    bus.declare_alive("other/sim")
    assert alive(bus.watch_alive("alive/*")) == [("alive/ponder", b"1"), ("alive/pounce", b"1")]


def test_a_closed_bus_delivers_nothing() -> None:
    bus = LocalBus()
    subscription = bus.subscribe("a", keep=1)
    bus.close()
    put(bus, "a", b"1")
    assert payloads(subscription) == []


def test_a_rung_bell_does_not_wait() -> None:
    bell = Bell()
    bell.ring()
    bell.wait(10**15)  # eleven days, had it not been rung


def test_a_bell_that_may_not_wait_returns() -> None:
    Bell().wait(0)
