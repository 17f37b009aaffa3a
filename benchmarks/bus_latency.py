"""Latency of a policy call with a policy that costs nothing: ours beside the real openpi-client, in one run.

One call takes two 256 x 256 pictures and 8 joint values as numpy arrays to a numpy chunk (20, 8) on the client;
serialisation, transport, wake-ups and the server's decoding of both pictures are included. Every answer is compared
with the only right one for its request. Client and server are two processes of one host, on loopback.

openpi's client sends one message and gets one; so do our rows "observation -> chunk", through the same Link, codec and
bus as the daemons. The rows "pounce-serve" are the cost in a real episode: an observation, an invocation and a chunk,
and the daemon's phases and heartbeats beside them.
"""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from benchmarks.noop_policy import (
    ACTION_DIM,
    ANSWER_KEY,
    EPISODE,
    HORIZON,
    INSTRUCTION,
    NUM_PROPRIO,
    REQUEST_KEY,
    ROBOT,
    SIDE_PX,
    Wire,
    answer,
    endpoint_at,
)
from benchmarks.report import Report, Row, show, spread
from clock.schedules import realtime
from protocol import images, topics
from protocol import messages as m
from protocol.command_line import parse
from protocol.errors import CallFailed
from protocol.link import Link
from protocol.memory import keep_freed_memory
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, ZenohBus
from sim_client.launch import free_ports

_PATIENCE_S = 20.0
_AGAIN_S = 1.0

Pictures = dict[str, NDArray[np.uint8]]
Pipe = Connection
Call = Callable[[Pictures, NDArray[np.float32]], NDArray[np.float32]]


@dataclass(frozen=True, slots=True, kw_only=True)
class BusOptions:
    """Latency of a policy call, back to back and at 20 Hz."""

    rounds: int = 60
    """Rounds; each measures every row once, in rotating order."""
    calls: int = 40
    """Calls per row and round."""
    paced_rounds: int = 8
    paced_calls: int = 25
    paced_hz: int = 20
    warm_up_calls: int = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """One row: a wire, and the messages on it."""

    name: str
    wire: Wire
    messages: int
    shared_memory: bool = False
    unix: bool = False
    """A Unix socket, our default on one host, in the place of TCP on loopback."""
    codec: m.ImageCodec = m.ImageCodec.RAW
    keeps_memory: bool = False
    """Gives openpi's client our allocator setting (protocol/memory.py); our clients always have it."""


WAYS = (
    Way(name="openpi-client 0.1.2: websocket, msgpack-numpy", wire="openpi", messages=2),
    Way(name="openpi-client, our allocator setting lent to it", wire="openpi", messages=2, keeps_memory=True),
    Way(name="zenoh TCP, observation -> chunk", wire="observation", messages=2),
    Way(name="zenoh Unix socket (our default), observation -> chunk", wire="observation", messages=2, unix=True),
    Way(name="zenoh shared memory, observation -> chunk", wire="observation", messages=2, shared_memory=True),
    Way(
        name="zenoh Unix socket and shared memory, observation -> chunk",
        wire="observation",
        messages=2,
        shared_memory=True,
        unix=True,
    ),
    Way(name="zenoh shared memory, bare bytes (floor of the row above)", wire="bytes", messages=2, shared_memory=True),
    Way(name="zenoh TCP, JPEG, observation -> chunk", wire="observation", messages=2, codec=m.ImageCodec.JPEG),
    Way(name="zenoh TCP, pounce-serve", wire="pounce", messages=3),
    Way(name="zenoh Unix socket (our default), pounce-serve", wire="pounce", messages=3, unix=True),
    Way(name="zenoh shared memory, pounce-serve", wire="pounce", messages=3, shared_memory=True),
)


class OverWebsocket:
    """The real openpi-client, called as by its users."""

    def __init__(self, port: int) -> None:
        from openpi_client.websocket_client_policy import WebsocketClientPolicy

        self._policy = WebsocketClientPolicy("127.0.0.1", port)

    def __call__(self, pictures: Pictures, state: NDArray[np.float32]) -> NDArray[np.float32]:
        request = {
            "observation/image": pictures["front"],
            "observation/wrist_image": pictures["wrist"],
            "observation/state": state,
            "prompt": INSTRUCTION,
        }
        rows: NDArray[np.float32] = self._policy.infer(request)["actions"]
        return rows


class OverBus:
    """Our bus without our messages."""

    def __init__(self, bus: ZenohBus) -> None:
        self._bus = bus
        self._answers = bus.subscribe(ANSWER_KEY, keep=1)

    def __call__(self, pictures: Pictures, state: NDArray[np.float32]) -> NDArray[np.float32]:
        payload = b"".join([state.data.cast("B"), pictures["front"].data.cast("B"), pictures["wrist"].data.cast("B")])
        self._bus.publish(REQUEST_KEY, payload, encoding="", attachment=b"", priority=Priority.DATA_HIGH)
        deadline_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline_s:
            for sample in self._answers.drain():
                return np.frombuffer(sample.payload, np.float32).reshape(HORIZON, ACTION_DIM)
            self._bus.wait(20_000_000)
        raise TimeoutError(f"no answer within {_PATIENCE_S:.0f} s")


class OverLink:
    """Our robot's side and, if the server needs one, the clock's invocation."""

    def __init__(self, bus: ZenohBus, codec: m.ImageCodec, *, invokes: bool) -> None:
        self._bus = bus
        self._codec = codec
        self._invokes = invokes
        self._tick = 0
        self._link, self._clock = (Link(bus, robot=ROBOT, proc=proc) for proc in ("sim", "clock"))
        for link in (self._link, self._clock):
            link.enter_episode("bench", EPISODE, 1)
        self._chunks = self._link.subscribe(topics.CHUNK)
        if invokes:
            self._open()

    def __call__(self, pictures: Pictures, state: NDArray[np.float32]) -> NDArray[np.float32]:
        """Asks again after a second: on a busy host a picture may be dropped before it leaves, as in an episode."""
        deadline_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline_s:
            if (rows := self._asked(pictures, state)) is not None:
                return rows
        raise TimeoutError(f"no chunk for tick {self._tick} within {_PATIENCE_S:.0f} s")

    def _asked(self, pictures: Pictures, state: NDArray[np.float32]) -> NDArray[np.float32] | None:
        self._tick += 1
        tick, now_ns = self._tick, self._tick * 50_000_000
        packed = images.pack(pictures, self._codec)
        observation = m.Observation(tick=tick, source_ns=now_ns, proprio=state, images=packed)
        self._link.publish(topics.OBSERVATION, observation, at_ns=now_ns)
        if self._invokes:
            invocation = m.Invocation(
                invocation=tick, tick=tick, now_ns=now_ns, ref_query=None, age_ns=0, cognition=_NO_COGNITION
            )
            self._clock.publish(topics.INVOCATION, invocation, at_ns=now_ns)
        again_s = time.monotonic() + _AGAIN_S
        while time.monotonic() < again_s:
            for chunk in self._chunks.drain():
                if chunk.invocation == tick:
                    return chunk.rows_NA
            self._bus.wait(20_000_000)
        return None

    def _open(self) -> None:
        members = tuple(m.Member(proc=link.proc, boot_id=link.boot_id) for link in (self._link, self._clock))
        request = m.OpenRequest(info=episode_info(self._link.header("info", 0)), members=members)
        reply = self._clock.call(topics.OPEN, "pounce", request, timeout_ns=5_000_000_000)
        if reply.error:
            raise CallFailed("open", 5_000, reply.error)


def episode_info(header: m.Header) -> m.EpisodeInfo:
    """A minimal episode for pounce-serve."""
    bound = np.ones(ACTION_DIM, np.float32)
    return m.EpisodeInfo(
        header=header,
        task="noop",
        suite="benchmarks",
        seed=0,
        difficulty="none",
        instruction=INSTRUCTION,
        schedule=realtime(),
        robot=m.Robot(
            name="bench",
            command_low=-bound,
            command_high=bound,
            max_step=bound,
            initial_command=0 * bound,
            cameras=("front", "wrist"),
            image_height=SIDE_PX,
            image_width=SIDE_PX,
            num_proprio=NUM_PROPRIO,
            is_simulated=True,
        ),
        t0_unix_ns=time.time_ns(),
    )


class Contestant:
    """A way, the processes of its server and its client, and the durations of its calls."""

    def __init__(self, way: Way, server: subprocess.Popen[str], client: BaseProcess, pipe: Pipe) -> None:
        self.way = way
        self._pipe = pipe
        self._server = psutil.Process(server.pid)
        self._client = psutil.Process(client.pid)
        self.took_ms: list[float] = []
        self.client_cpu_s = 0.0
        self.server_cpu_s = 0.0

    def measure(self, calls: int, seed: int, hz: int | None) -> None:
        """Runs ``calls`` calls in the client's process, back to back or on absolute deadlines."""
        self._pipe.send(("prepare", calls, seed))
        self._answer()
        client_s, server_s = _cpu_s(self._client), _cpu_s(self._server)
        self._pipe.send(("measure", hz))
        self.took_ms += self._answer()
        self.client_cpu_s += _cpu_s(self._client) - client_s
        self.server_cpu_s += _cpu_s(self._server) - server_s

    def forget(self) -> None:
        self.took_ms.clear()
        self.client_cpu_s = self.server_cpu_s = 0.0

    def row(self, baseline_ms: float) -> Row:
        timing = spread(self.took_ms, "ms")
        ratio = round(float(np.percentile(self.took_ms, 50)) / baseline_ms, 2)
        return {
            "way": self.way.name,
            "messages": self.way.messages,
            **timing,
            "p50_vs_openpi": ratio,
            "asked_again": sum(took_ms > 1e3 * _AGAIN_S for took_ms in self.took_ms),
            "client_cpu_ms": round(self.client_cpu_s * 1e3 / len(self.took_ms), 2),
            "server_cpu_ms": round(self.server_cpu_s * 1e3 / len(self.took_ms), 2),
        }

    def _answer(self) -> Any:
        if not self._pipe.poll(120):
            raise TimeoutError(f"the client of {self.way.name!r} does not answer")
        answered = self._pipe.recv()
        if isinstance(answered, str):
            raise RuntimeError(f"the client of {self.way.name!r} failed: {answered}")
        return answered


def serve_client(way: Way, port: int, pipe: Pipe) -> None:
    """Runs one client in its own process, so that a client's process-wide settings do not affect the others."""
    asked: list[tuple[Pictures, NDArray[np.float32]]] = []
    try:
        with _connected(way, port) as call:
            pipe.send([])
            while True:
                command, *arguments = pipe.recv()
                if command == "prepare":
                    asked = requests(*arguments)
                    pipe.send([])
                else:
                    pipe.send(_measured(way, call, asked, *arguments))
    except EOFError:
        return
    except Exception as error:  # the parent prints it: children's tracebacks would mix
        pipe.send(f"{type(error).__name__}: {error}")


def _measured(way: Way, call: Call, asked: list[tuple[Pictures, NDArray[np.float32]]], hz: int | None) -> list[float]:
    took_ms = []
    start_ns = time.perf_counter_ns()
    for index, (pictures, state) in enumerate(asked):
        if hz:
            due_ns = start_ns + index * 1_000_000_000 // hz
            time.sleep(max(0, due_ns - time.perf_counter_ns()) / 1e9)
        before_ns = time.perf_counter_ns()
        rows = call(pictures, state)
        took_ms.append((time.perf_counter_ns() - before_ns) / 1e6)
        _check(way, rows, pictures, state)
    return took_ms


def _check(way: Way, rows: NDArray[np.float32], pictures: Pictures, state: NDArray[np.float32]) -> None:
    seen = pictures if way.codec == m.ImageCodec.RAW else _through_jpeg(pictures)
    expected = answer(seen["front"], seen["wrist"], state)
    if rows.shape != (HORIZON, ACTION_DIM) or not np.array_equal(rows, expected):
        raise AssertionError(f"{way.name}: the answer is not to what was asked")


@contextmanager
def contest() -> Iterator[list[Contestant]]:
    """Starts all servers and connects all clients; stops them at the end."""
    with ExitStack() as stack:
        contestants = []
        for way, port in zip(WAYS, free_ports(len(WAYS)), strict=True):
            server = stack.enter_context(_serving(way, port))
            client, pipe = stack.enter_context(_client(way, port))
            contestants.append(Contestant(way, server, client, pipe))
        yield contestants


@contextmanager
def _serving(way: Way, port: int) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "benchmarks.noop_policy", way.wire, "--port", str(port)]
    command += ["--shared-memory"] if way.shared_memory else []
    command += ["--unix"] if way.unix else []
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        if server.stdout is None or server.stdout.readline().strip() != "READY":
            raise RuntimeError(f"the server of {way.name!r} did not start")
        yield server
    finally:
        server.kill()
        server.wait()


@contextmanager
def _client(way: Way, port: int) -> Iterator[tuple[BaseProcess, Pipe]]:
    spawn = multiprocessing.get_context("spawn")  # a forked child would inherit the parent's allocator and threads
    ours, theirs = spawn.Pipe()
    client = spawn.Process(target=serve_client, args=(way, port, theirs), daemon=True)
    client.start()
    try:
        if not ours.poll(60) or isinstance(ours.recv(), str):
            raise RuntimeError(f"the client of {way.name!r} did not connect")
        yield client, ours
    finally:
        client.kill()
        client.join()


@contextmanager
def _connected(way: Way, port: int) -> Iterator[Call]:
    if way.wire == "openpi":
        if way.keeps_memory:
            keep_freed_memory()
        yield OverWebsocket(port)
        return
    bus = ZenohBus(Endpoints(connect=(endpoint_at(port, unix=way.unix),), shared_memory=way.shared_memory))
    try:
        time.sleep(1.0)  # until links and subscriptions are established
        yield OverBus(bus) if way.wire == "bytes" else OverLink(bus, way.codec, invokes=way.wire == "pounce")
    finally:
        bus.close()


def requests(count: int, seed: int) -> list[tuple[Pictures, NDArray[np.float32]]]:
    """Pictures with a camera's statistics (smooth, some noise), and a unique state per request."""
    rng = np.random.default_rng(seed)
    along = np.arange(SIDE_PX, dtype=np.float32)
    found = []
    for _ in range(count):
        pictures = {}
        for camera in ("front", "wrist"):
            phase_3 = rng.uniform(0, 6, 3).astype(np.float32)
            columns = 120 + 60 * np.sin(along[None, :, None] / 40 + phase_3)
            rows = 40 * np.cos(along[:, None, None] / 30 - phase_3)
            noise = 2.5 * rng.standard_normal((SIDE_PX, SIDE_PX, 3), np.float32)
            pictures[camera] = np.ascontiguousarray((columns + rows + noise).clip(0, 255), np.uint8)
        found.append((pictures, rng.standard_normal(NUM_PROPRIO).astype(np.float32)))
    return found


def _through_jpeg(pictures: Pictures) -> Pictures:
    packed = images.pack(pictures, m.ImageCodec.JPEG)
    return {image.camera: images.unpack(image) for image in packed}


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _run(contestants: list[Contestant], rounds: int, calls: int, hz: int | None) -> list[Row]:
    for contestant in contestants:
        contestant.forget()
    for index in range(rounds):
        turn = index % len(contestants)
        for contestant in contestants[turn:] + contestants[:turn]:
            contestant.measure(calls, index, hz)
    baseline_ms = float(np.percentile(contestants[0].took_ms, 50))
    return [contestant.row(baseline_ms) for contestant in contestants]


_NO_COGNITION: NDArray[np.float32] = np.zeros((0, 0), np.float32)


def main(argv: list[str] | None = None) -> int:
    options = parse(BusOptions, argv, prog="bus-latency")
    report = Report(
        name="bus_latency",
        question="How long does a policy call take when the policy costs nothing? Numpy arrays to numpy chunk.",
        config=options,
        warm_up=f"the first {options.warm_up_calls} calls of each way.",
    )
    with contest() as contestants:
        for contestant in contestants:
            contestant.measure(options.warm_up_calls, 10_000, None)
        rows = _run(contestants, options.rounds, options.calls, None)
        report.add_table("Back to back", rows)
        rows = _run(contestants, options.paced_rounds, options.paced_calls, options.paced_hz)
        report.add_table(f"At {options.paced_hz} Hz, as an episode pays it (cold caches, sleeping cores)", rows)
    report.notes += [
        f"One call: two {SIDE_PX} x {SIDE_PX} RGB pictures and {NUM_PROPRIO} joint values to {HORIZON} x {ACTION_DIM} "
        "float32; the server reads both pictures. Every answer was checked against its request.",
        "openpi row: the real openpi-client package against a server of ours that does on the wire what openpi's does "
        "(websockets, compression off). CPU times are of the whole processes, transport threads included.",
        "Each client and each server is a process of its own, as its users run it. Our bus sets glibc's allocator to "
        "keep freed memory (protocol/memory.py); the second row lends openpi's client the same setting.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
