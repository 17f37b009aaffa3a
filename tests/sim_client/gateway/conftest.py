"""A gateway around the robot in one thread, and clients' messages as the dialects' own libraries would send them."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from clock import schedules
from protocol import messages as m
from sim_client.gateway.body import PANDA, Body
from sim_client.gateway.exchange import Answer, Step, Terms
from sim_client.gateway.machine import Machine, Plan
from sim_client.gateway.websocket import WebsocketSide

PX, DIM = 4, 3
TERMS = Terms(
    mode=m.Mode.LOCKSTEP, rows=1, control_hz=20, cameras={}, state_key="", version="0.0.0",
    robot=replace(PANDA.example(), num_proprio=DIM),
)  # fmt: skip


def shade(value: int) -> np.ndarray:
    return np.full((PX, PX, 3), value % 256, np.uint8)


def make_step(value: int = 0, **changes: Any) -> Step:
    """What a client sees whose pictures are all of one shade."""
    values: dict[str, Any] = {
        "instruction": "put the cube in the bin",
        "frames": {"front": shade(value), "wrist": shade(value + 1)},
        "state": np.zeros(DIM, np.float32),
        "begins": False,
    }
    return Step(**(values | changes))


@dataclass
class Bench:
    """A machine whose working thread is the test's."""

    machine: Machine
    rig: Any

    def ask(self, step: Step, client: str = "anna") -> Answer:
        """Submits a step and works until it is answered. Raises Refused."""
        future = self.machine.submit(client, step)
        while not future.done():
            self.machine.step()
        answer = future.result(0)
        assert answer is not None
        return answer

    def tell(self, request: Any, client: str = "anna") -> None:
        future = self.machine.submit(client, request)
        while not future.done():
            self.machine.step()
        assert future.result(0) is None


@pytest.fixture(scope="session")
def step_of() -> Callable[..., Step]:
    return make_step


@pytest.fixture(scope="session")
def picture_of() -> Callable[[int], np.ndarray]:
    return shade


@pytest.fixture
def bench_with(new_rig: Callable[..., Any], robot_with: Callable[..., m.Robot]) -> Callable[..., Bench]:
    """A gateway with a plan of the paper's schedule, or with these changes of it."""

    def make(schedule: m.Schedule | None = None, **changes: Any) -> Bench:
        base = schedule or schedules.paper()

        def describe(state: m.Floats, image_px: tuple[int, int]) -> m.Robot:
            return robot_with(image_height=image_px[0], image_width=image_px[1])

        values: dict[str, Any] = {
            "schedule": lambda seed, horizon: replace(base, seed=seed),
            "num_rows": 1,
            "body": Body(DIM, describe),
            "suite": "tests",
        }
        rig = new_rig()
        return Bench(Machine(Plan(**(values | changes)), rig.links["sim"], None), rig)

    return make


@pytest.fixture
def bench(bench_with: Callable[..., Bench]) -> Bench:
    return bench_with()


@pytest.fixture(scope="session")
def terms_with() -> Callable[..., Terms]:
    return lambda **changes: replace(TERMS, **changes)


@pytest.fixture(scope="session")
def working() -> Callable[[Machine], Any]:
    """Lets a machine work in a thread of its own for as long as the block lasts."""

    @contextmanager
    def work(machine: Machine) -> Iterator[None]:
        should_stop = threading.Event()
        thread = threading.Thread(target=machine.run, args=(should_stop.is_set,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            should_stop.set()
            thread.join(20)

    return work


@pytest.fixture(scope="session")
def listening() -> Callable[[WebsocketSide], Any]:
    """Serves websockets on a free loopback port for as long as the block lasts, and names it."""

    @contextmanager
    def listen(side: WebsocketSide) -> Iterator[int]:
        loop = asyncio.new_event_loop()
        server = loop.run_until_complete(side.start("127.0.0.1", 0))
        thread = threading.Thread(target=loop.run_forever, daemon=True)
        thread.start()
        try:
            yield int(server.sockets[0].getsockname()[1])
        finally:
            loop.call_soon_threadsafe(server.close)
            asyncio.run_coroutine_threadsafe(server.wait_closed(), loop).result(20)
            loop.call_soon_threadsafe(loop.stop)
            thread.join(20)
            loop.close()

    return listen
