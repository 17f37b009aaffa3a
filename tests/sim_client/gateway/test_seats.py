"""Several clients at once: each has a robot of its own, and one too many hears so."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import TransportError
from sim_client.gateway.exchange import Answer, Busy, Finish, Step
from sim_client.gateway.lease import Lease
from sim_client.gateway.machine import Machine
from sim_client.gateway.options import GatewayOptions
from sim_client.gateway.seats import Seats, seat_names


@dataclass
class Seat:
    """The door of a machine: its lease, and what was handed in."""

    robot: str
    lease: Lease
    asked: list[str] = field(default_factory=list)
    now_ns: int = 0
    is_closed: bool = False

    @property
    def holder(self) -> str:
        return self.lease.holder

    @property
    def heard_ns(self) -> int:
        return self.lease.heard_ns

    def submit(self, client: str, request: Step | Finish) -> Future[Answer | None]:
        if isinstance(request, Finish):
            self.lease.release(client)
        else:
            self.lease.acquire(client, self.now_ns)
            self.asked.append(client)
        return Future()


def hall(count: int, idle_ns: int = 10**12, *, resets_inherit: bool = False) -> tuple[Seats, list[Seat]]:
    seats = [Seat(robot, Lease(idle_ns)) for robot in seat_names("r0", count)]
    return Seats(seats, resets_inherit=resets_inherit), seats  # type: ignore[arg-type]


clients = st.sampled_from("abcdef")


@given(st.integers(1, 4), st.lists(st.tuples(clients, st.booleans()), max_size=60))
def test_nobody_shares_a_seat_and_nobody_loses_one(count: int, said: list[tuple[str, bool]]) -> None:
    """True in ``said``: the client finishes. A model of the hall is a set of those who sit."""
    door, seats = hall(count)
    sitting: set[str] = set()
    for client, leaves in said:
        if leaves:
            door.submit(client, Finish())
            sitting.discard(client)
        elif client in sitting or len(sitting) < count:
            door.submit(client, step())
            sitting.add(client)
        else:
            with pytest.raises(Busy, match="driven by" if count == 1 else f"all {count} seats are taken"):
                door.submit(client, step())
        holders = [seat.holder for seat in seats if seat.holder]
        assert sorted(holders) == sorted(sitting)
    for client in sitting:
        assert sum(seat.holder == client for seat in seats) == 1


def step() -> Any:
    return Step.__new__(Step)


def test_a_free_seat_is_taken_before_one_whose_client_fell_silent() -> None:
    door, seats = hall(2, idle_ns=0)
    door.submit("anna", step())
    door.submit("berta", step())
    assert [seat.holder for seat in seats] == ["anna", "berta"]
    door.submit("carla", step())
    assert [seat.holder for seat in seats] == ["carla", "berta"]


@pytest.mark.parametrize(
    ("client", "request_", "left"),
    [
        ("10.0.0.1:9", Finish(is_reset=True), ["10.0.0.1:1", ""]),
        ("10.0.0.1:9", Finish(), ["10.0.0.1:1", "10.0.0.1:2"]),
        ("10.0.0.2:9", Finish(is_reset=True), ["10.0.0.1:1", "10.0.0.1:2"]),
    ],
    ids=["a reset of the same host", "a client that leaves", "another host's reset"],
)
def test_a_reset_over_a_new_connection_ends_what_the_last_one_left_open(
    client: str, request_: Finish, left: list[str]
) -> None:
    """As RoboMME's policy repository's evaluator does it, once an episode."""
    door, seats = hall(2, resets_inherit=True)
    for number, seat in enumerate(seats):
        seat.now_ns = 5 - number  # the second was silent for longer
        door.submit(f"10.0.0.1:{number + 1}", step())
    door.submit(client, request_)
    assert [seat.holder for seat in seats] == left


def test_a_reset_takes_nobodys_robot_while_a_seat_is_free_or_in_real_time() -> None:
    for door, seats in (hall(2, resets_inherit=True), hall(1)):
        door.submit("10.0.0.1:1", step())
        door.submit("10.0.0.1:2", Finish(is_reset=True))
        assert seats[0].holder == "10.0.0.1:1"


def test_names_are_different_and_the_first_is_the_robots_own() -> None:
    assert seat_names("r0", 3) == ("r0", "r0-1", "r0-2")


@pytest.mark.parametrize("count", [0, 65])
def test_how_many_seats_there_may_be(count: int) -> None:
    with pytest.raises(TransportError, match=f"--seats {count}: expected 1 to 64"):
        GatewayOptions(dialect="openpi", seats=count).check()


def test_clients_play_side_by_side_in_lockstep(
    bench_with: Callable[..., Any], step_of: Callable[..., Step], working: Callable[..., Any]
) -> None:
    """Each against servers of its own here, to the bit as if alone: only doors are shared."""
    alone = bench_with()
    expected = [alone.ask(step_of(value, begins=value == 0)).rows_NA.tobytes() for value in range(5)]
    benches = [bench_with() for _ in range(3)]
    door = Seats([bench.machine for bench in benches])
    rows: dict[str, list[bytes]] = {}

    def play(client: str) -> None:
        for value in range(5):
            answer = door.submit(client, step_of(value, begins=value == 0)).result(20)
            assert answer is not None
            rows.setdefault(client, []).append(answer.rows_NA.tobytes())

    should_stop = threading.Event()
    runner = threading.Thread(target=door.run, args=(should_stop.is_set,), daemon=True)
    runner.start()
    players = [threading.Thread(target=play, args=(name,)) for name in ("anna", "berta", "carla")]
    for player in players:
        player.start()
    for player in players:
        player.join(30)
    should_stop.set()
    runner.join(20)
    assert rows == dict.fromkeys(("anna", "berta", "carla"), expected)


def test_a_seat_that_fails_leaves_the_others(
    bench_with: Callable[..., Any], step_of: Callable[..., Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    benches = [bench_with() for _ in range(2)]
    machines: Sequence[Machine] = [bench.machine for bench in benches]
    broken = threading.Event()

    def fails() -> None:
        broken.set()
        raise RuntimeError("a bug")

    monkeypatch.setattr(machines[0], "step", fails)
    door = Seats(machines)
    should_stop = threading.Event()
    runner = threading.Thread(target=door.run, args=(should_stop.is_set,), daemon=True)
    runner.start()
    assert broken.wait(20)
    while not machines[0].is_closed:
        time.sleep(0.01)
    assert door.submit("anna", step_of(begins=True)).result(20) is not None
    should_stop.set()
    runner.join(20)
