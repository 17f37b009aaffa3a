"""PONDER in the caller's process and thread: the same server on an in-process bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ponder_server.__main__ import build_engine
from ponder_server.config import PonderOptions
from ponder_server.contract import EngineSpec, Frame, Opening
from ponder_server.serve import PonderServer
from protocol.bus import Bus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.process import host_clock_id
from protocol.version import version

_OFFLINE = "offline"


def build(bus: Bus, robot: str, checkpoint: Path | None, **options: Any) -> Callable[[], bool]:
    """Returns the step function of a warm server. ``options``: further ones of `PonderOptions`, by name."""
    link = Link(bus, robot=robot, proc="ponder")
    heartbeat = Heartbeat(link, version(), host_clock_id())
    server = PonderServer(link, build_engine(PonderOptions(checkpoint=checkpoint, **options)), heartbeat, version())
    server.warm_up()
    server.ready()
    return server.step


Views = Sequence[Frame]
"""Frames of one instant, in camera order."""
Read = Callable[[str, Sequence[Views], Sequence[Views], NDArray[np.float32]], NDArray[np.float32]]


def build_reader(checkpoint: Path | None, **options: Any) -> tuple[Read, EngineSpec]:
    """Builds a PONDER outside of any episode, for offline measurements. ``options``: as in `build`.

    Returns the engine's spec, and a function from an instruction, the demonstration's instants and the T observations
    since with the robot's states (T, 8), to every one's cognition (T, K, H) as in serving, with PONDER's own texts.
    """
    engine = build_engine(PonderOptions(checkpoint=checkpoint, **options))

    def read(
        instruction: str, demo: Sequence[Views], seen: Sequence[Views], state_T8: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        engine.open(_OFFLINE, Opening(instruction=instruction, demo_frames=tuple(tuple(views) for views in demo)))
        try:
            fires = [
                engine.fire(_OFFLINE, tuple(views), proprio=state) for views, state in zip(seen, state_T8, strict=True)
            ]
            return np.stack([fire.cognition for fire in fires])
        finally:
            engine.close(_OFFLINE)

    return read, engine.spec
