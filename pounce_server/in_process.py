"""POUNCE in the caller's process and thread: the same server on an in-process bus."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.models.ponder.demo_sampling import DemoSampling
from pounce_server.__main__ import build_engine, build_remote
from pounce_server.config import PathName, PounceOptions, RemoteOptions, SpeedOptions
from pounce_server.contract import EngineSpec, Episodic, PounceEngine, Request, check_robot
from pounce_server.node import PounceNode
from pounce_server.serve import PounceServer
from protocol.bus import Bus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.messages import ActionChunk, DemoFrame, EpisodeInfo, Invocation, Observation
from protocol.process import host_clock_id
from protocol.version import version


def build(
    bus: Bus,
    robot: str,
    checkpoint: Path | None,
    *,
    path: PathName = "eager",
    **options: Any,
) -> Callable[[], bool]:
    """Returns the step function of a warm server.

    ``path``: see `SpeedOptions`; ``options``: further ones of `PounceOptions`.
    """
    link = Link(bus, robot=robot, proc="pounce")
    heartbeat = Heartbeat(link, version(), host_clock_id())
    engine = build_engine(PounceOptions(checkpoint=checkpoint, speed=SpeedOptions(path=path), **options))
    server = PounceServer(link, engine, heartbeat, version())
    server.warm_up()
    server.ready()
    return server.step


Floats = NDArray[np.float32]
Act = Callable[..., Floats]
"""(instruction, frames, proprioception, cognition (None: null), its age [ns], noise seed, subgoal="") -> chunk."""


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
        subgoal: str = "",
    ) -> Floats:
        return engine.invoke(
            Request(
                instruction=instruction,
                frames=tuple(frames)[: engine.spec.num_cameras],  # some models read no camera
                proprio=proprio,
                cognition=cognition,
                age_ns=age_ns,
                seed=seed,
                subgoal=subgoal,
            )
        )

    return act, engine.spec


@dataclass(frozen=True, slots=True)
class Answerer:
    """A POUNCE for a recorded episode: the server's own node and engine."""

    spec: EngineSpec
    _engine: PounceEngine
    _node: PounceNode

    def answer(self, invocation: Invocation, observations: Iterable[Observation]) -> ActionChunk:
        """The chunk for an invocation.

        Args:
            observations: those of the log up to the invocation's tick that no call had before: a window needs the past.

        Raises:
            ValueError: the observation that it names was never given, or the engine cannot read it.
        """
        for each in observations:
            self._node.on_observation(each)
        self._node.on_invocation(invocation)
        work = self._node.next_work()
        if work is None:
            raise ValueError(f"the log has nothing that was seen at tick {invocation.tick}; record with cameras")
        return self._node.answer(work, self._engine.invoke(work.request), infer_ns=0)


def build_answerer(
    info: EpisodeInfo,
    checkpoint: Path | None,
    remote: RemoteOptions,
    demonstration: Callable[[DemoSampling], Sequence[DemoFrame]],
    **options: Any,
) -> Answerer:
    """Raises OSError, ValueError: there is no such checkpoint or policy server, or it is for another robot.

    ``demonstration`` gives the episode's, for an engine whose memory reads it; ``options``: further ones of
    `PounceOptions`.
    """
    chosen = PounceOptions(checkpoint=checkpoint, remote=remote, **options)
    engine = build_engine(chosen) if chosen.backend == "own" else build_remote(chosen)
    check_robot(info.robot, engine.spec)
    if isinstance(engine, Episodic):
        engine.begin(info)
    node = PounceNode(engine.spec)
    past = engine.spec.past
    node.open(info, demonstration(past.demonstrations) if past is not None and info.has_demo else ())
    return Answerer(engine.spec, engine, node)
