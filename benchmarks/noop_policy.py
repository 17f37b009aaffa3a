"""A policy without a model, as a server on four wires, to measure the cost of a call alone.

    python -m benchmarks.noop_policy openpi --port 7001      websocket and msgpack-numpy, as openpi's server speaks them
    python -m benchmarks.noop_policy observation --port ...  our Link: an observation is answered by a chunk
    python -m benchmarks.noop_policy bytes --port ...        our bus alone: no messages, checks or identity
    python -m benchmarks.noop_policy pounce --port ...       the whole of pounce-serve, its engine doing nothing

Each decodes both pictures into arrays, reads them, and answers with a chunk that is unique to the request.
"""

from __future__ import annotations

import asyncio
import os
import signal
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from pounce_server.contract import EngineSpec, Progress, Request, no_progress
from pounce_server.serve import PounceServer
from protocol import images, topics
from protocol import messages as m
from protocol.command_line import parse
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.logs import set_up_logging
from protocol.process import host_clock_id, run
from protocol.sockets import endpoint
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, ZenohBus

HORIZON, ACTION_DIM, NUM_PROPRIO, SIDE_PX = 20, 8, 8, 256
ROBOT, EPISODE = "bench", "noop"
INSTRUCTION = "press the button, pick all cubes that were highlighted, then press it again to stop"
_CACHE_LINE_BYTES = 64

REQUEST_KEY, ANSWER_KEY = "bench/request", "bench/answer"  # keys of the wire "bytes"

Wire = Literal["openpi", "observation", "bytes", "pounce"]


def endpoint_at(port: int, *, unix: bool) -> str:
    """Where a server of zenoh listens: a port, or the socket that has its number."""
    return endpoint(f"bench-{port}") if unix else f"tcp/127.0.0.1:{port}"


def answer(front: NDArray[np.uint8], wrist: NDArray[np.uint8], state: NDArray[np.float32]) -> NDArray[np.float32]:
    """Chunk (20, 8) of the state and the pictures' brightness; reads every cache line of both pictures."""
    rows = np.tile(np.asarray(state, np.float32), (HORIZON, 1))
    brightness = sum(int(frame.reshape(-1)[::_CACHE_LINE_BYTES].sum()) for frame in (front, wrist))
    rows[0, 0] = np.float32(brightness)
    return rows


def serve_openpi(port: int) -> None:
    """Speaks openpi's websocket_policy_server protocol: metadata first, then one answer per request."""
    import websockets.asyncio.server as websockets
    from openpi_client import msgpack_numpy
    from websockets.exceptions import ConnectionClosed

    async def talk(socket: websockets.ServerConnection) -> None:
        packer = msgpack_numpy.Packer()
        await socket.send(packer.pack({}))
        previous_ms: float | None = None
        try:
            while True:
                start_ns = time.monotonic_ns()
                request = msgpack_numpy.unpackb(await socket.recv())
                infer_ns = time.monotonic_ns()
                rows = answer(
                    request["observation/image"], request["observation/wrist_image"], request["observation/state"]
                )
                timing = {"infer_ms": (time.monotonic_ns() - infer_ns) / 1e6}
                if previous_ms is not None:
                    timing["prev_total_ms"] = previous_ms
                await socket.send(packer.pack({"actions": rows, "server_timing": timing}))
                previous_ms = (time.monotonic_ns() - start_ns) / 1e6
        except ConnectionClosed:
            return

    async def serve() -> None:
        async with websockets.serve(talk, "127.0.0.1", port, compression=None, max_size=None):
            _say_ready()
            await asyncio.get_running_loop().create_future()

    asyncio.run(serve())


def serve_observation(bus: ZenohBus) -> None:
    """One message in, one message out, like openpi's, through the same code as pounce-serve."""
    link = Link(bus, robot=ROBOT, proc="pounce")
    link.enter_episode("bench", EPISODE, 1)
    observations = link.subscribe(topics.OBSERVATION)

    def step() -> bool:
        received = observations.drain()
        for observation in received:
            front, wrist = (images.unpack(image) for image in observation.images)
            rows = answer(front, wrist, observation.proprio)
            link.publish(topics.CHUNK, chunk_of(observation, rows), at_ns=observation.source_ns)
        return bool(received)

    _say_ready()
    run(bus, step, lambda: False)


def serve_bytes(bus: ZenohBus) -> None:
    """The floor of our rows: the same bytes on the same bus, as bare arrays."""
    received = bus.subscribe(REQUEST_KEY, keep=1)
    state_bytes, picture_bytes = 4 * NUM_PROPRIO, SIDE_PX * SIDE_PX * 3

    def step() -> bool:
        samples = received.drain()
        for sample in samples:
            state = np.frombuffer(sample.payload, np.float32, NUM_PROPRIO)
            front, wrist = np.frombuffer(sample.payload, np.uint8, 2 * picture_bytes, state_bytes).reshape(2, -1)
            rows = answer(front, wrist, state)
            bus.publish(ANSWER_KEY, rows.tobytes(), encoding="", attachment=b"", priority=Priority.REAL_TIME)
        return bool(samples)

    _say_ready()
    run(bus, step, lambda: False)


def serve_pounce(bus: ZenohBus) -> None:
    """The real pounce-serve, with heartbeat, phases and rendezvous, around a no-op engine."""
    link = Link(bus, robot=ROBOT, proc="pounce")
    server = PounceServer(link, NoopEngine(), Heartbeat(link, "0+bench", host_clock_id()), "0+bench")
    server.warm_up()
    server.ready()
    _say_ready()
    run(bus, server.step, lambda: False)


def chunk_of(observation: m.Observation, rows_NA: NDArray[np.float32]) -> m.ActionChunk:
    """Builds a chunk like ``PounceNode.answer``."""
    return m.ActionChunk(
        invocation=observation.tick,
        t_row0=observation.tick,
        horizon=HORIZON,
        action_dim=ACTION_DIM,
        dt_ns=50_000_000,
        rows=np.ascontiguousarray(rows_NA, np.float32).ravel(),
        source_ns=observation.source_ns,
        ref_query=None,
        age_ns=0,
        reference_state=observation.proprio,
    )


class NoopEngine:
    """A ``PounceEngine`` without a model."""

    spec = EngineSpec(
        horizon=HORIZON,
        action_dim=ACTION_DIM,
        proprio_dim=NUM_PROPRIO,
        num_carriers=0,
        cognition_size=0,
        image_px=256,
        num_steps=1,
        num_cameras=2,
        model_hash="noop",
        is_random=True,
        has_fresh_prefix=False,
        dtype="float32",
    )

    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        front, wrist = request.frames
        assert front is not None
        assert wrist is not None
        progress()
        return answer(front, wrist, request.proprio)

    def warm_up(self) -> list[int]:
        return [1] * 20


def _say_ready() -> None:
    print("READY", flush=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoopOptions:
    """A policy server without a model, to measure its wire."""

    wire: tyro.conf.Positional[Wire]
    port: int
    shared_memory: bool = False
    unix: bool = False


def main(argv: list[str] | None = None) -> int:
    options = parse(NoopOptions, argv, prog="noop-policy")
    set_up_logging("ERROR")
    signal.signal(signal.SIGTERM, lambda number, frame: os._exit(0))
    if options.wire == "openpi":
        serve_openpi(options.port)
        return 0
    at = endpoint_at(options.port, unix=options.unix)
    bus = ZenohBus(Endpoints(listen=(at,), shared_memory=options.shared_memory))
    if options.wire == "bytes":
        serve_bytes(bus)
    elif options.wire == "observation":
        serve_observation(bus)
    else:
        serve_pounce(bus)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
