"""POUNCE in the caller's process and thread: the same server on an in-process bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pounce_server.__main__ import build_engine
from pounce_server.config import PathName, PounceOptions, SpeedOptions
from pounce_server.contract import EngineSpec, Request, check_robot
from pounce_server.node import PounceNode
from pounce_server.serve import PounceServer
from pounce_server.subgoal_text import Source
from protocol.bus import Bus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.messages import EpisodeInfo, Invocation, Observation
from protocol.process import host_clock_id
from protocol.version import version


def build(
    bus: Bus,
    robot: str,
    checkpoint: Path | None,
    subgoals: Source | None = None,
    *,
    path: PathName = "eager",
    **options: Any,
) -> Callable[[], bool]:
    """Returns the step function of a warm server.

    ``subgoals``: see `subgoal_text`; ``path``: see `SpeedOptions`; ``options``: further ones of `PounceOptions`.
    """
    link = Link(bus, robot=robot, proc="pounce")
    heartbeat = Heartbeat(link, version(), host_clock_id())
    engine = build_engine(PounceOptions(checkpoint=checkpoint, speed=SpeedOptions(path=path), **options))
    server = PounceServer(link, engine, heartbeat, version(), subgoals)
    server.warm_up()
    server.ready()
    return server.step


Floats = NDArray[np.float32]
Act = Callable[[str, Sequence[NDArray[np.uint8]], Floats, Floats | None, int, int], Floats]
"""(instruction, frames, proprioception, cognition (None: null), its age [ns], noise seed) -> chunk."""


def build_actor(checkpoint: Path | None, *, path: PathName = "eager", **options: Any) -> tuple[Act, EngineSpec]:
    """Builds a POUNCE outside of any episode, for offline measurements: a function, and the engine's spec.

    ``path``, ``options``: as in `build`.
    """
    engine = build_engine(PounceOptions(checkpoint=checkpoint, speed=SpeedOptions(path=path), **options))

    def act(
        instruction: str,
        frames: Sequence[NDArray[np.uint8]],
        proprio: Floats,
        cognition: Floats | None,
        age_ns: int,
        seed: int,
    ) -> Floats:
        return engine.invoke(
            Request(
                instruction=instruction,
                frames=tuple(frames)[: engine.spec.num_cameras],  # some models read no camera
                proprio=proprio,
                cognition=cognition,
                age_ns=age_ns,
                seed=seed,
            )
        )

    return act, engine.spec


def build_answerer(
    checkpoint: Path, info: EpisodeInfo, **options: Any
) -> tuple[Callable[[Invocation, Observation], Floats], str, int]:
    """A POUNCE for a recorded episode: its answer to an invocation, the hash of its weights, and its cameras.

    The path is the server's: the same node, the same engine. ``options``: further ones of `PounceOptions`.
    """
    engine = build_engine(PounceOptions(checkpoint=checkpoint, **options))
    check_robot(info.robot, engine.spec)
    node = PounceNode(engine.spec)

    def answer(invocation: Invocation, observation: Observation) -> Floats:
        node.open(info)  # whatever came before it
        node.on_observation(observation)
        node.on_invocation(invocation)
        work = node.next_work()
        if work is None:
            raise ValueError(
                f"invocation {invocation.invocation} and the observation of tick {observation.tick} differ"
            )
        return engine.invoke(work.request)

    return answer, engine.spec.model_hash, engine.spec.num_cameras
