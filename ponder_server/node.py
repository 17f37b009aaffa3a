"""Decides when PONDER fires, and on which observation. Pure: messages in, work and messages out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dual_system.models.action_space import ROBOT_DIM
from model_server import cameras
from model_server.rendezvous import Rendezvous
from ponder_server.contract import EngineSpec, Fire, Frame, Proprio
from protocol import images
from protocol import messages as m
from protocol.errors import EpisodeRefused, MalformedMessage

KEEP_QUERIES = 8
"""Largest number of queries kept; none may be skipped, because that would leave a gap in the context."""

_KINDS = {"subgoal": m.SubgoalKind.SUBGOAL, "demo_reasoning": m.SubgoalKind.DEMO_REASONING}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Work:
    """One fire to run: a query, and the frames and the robot's state of its observation."""

    query: m.Query
    frames: tuple[Frame, ...]
    proprio: Proprio


class PonderNode:
    """Answers every query of the current episode once, in order."""

    def __init__(self, spec: EngineSpec) -> None:
        self._spec = spec
        self._rendezvous: Rendezvous[m.Query] = Rendezvous(keep_requests=KEEP_QUERIES)
        self.next_query = 0
        self._next_asked = 0
        self._subgoal, self._subgoal_source_ns = "", 0

    @property
    def num_superseded(self) -> int:
        return self._rendezvous.num_superseded

    def open(self, next_query: int = 0, *, is_live: bool = False) -> None:
        """Starts an episode; after a rebuild, queries before ``next_query`` are in the context already.

        ``is_live``: in real time, where nobody waits for an overtaken query.
        """
        self._rendezvous.clear()
        self._rendezvous.keep_requests = 1 if is_live and self._spec.answers_newest else KEEP_QUERIES
        self.next_query = self._next_asked = next_query
        self._subgoal, self._subgoal_source_ns = "", 0

    def on_observation(self, observation: m.Observation) -> None:
        """Keeps an observation for queries; without pictures it is ignored, as no query names it (`will_look`).

        Raises:
            MalformedMessage: the engine cannot read these cameras; the observation displaces no other.
        """
        if not observation.images:
            return
        check_pictures(observation, self._spec)
        self._rendezvous.on_observation(observation)

    def on_query(self, query: m.Query) -> None:
        """Keeps a query until its observation is there; one that was taken before is ignored."""
        if query.query >= self._next_asked:
            self._next_asked = query.query + 1
            self._rendezvous.on_request(query)

    def next_work(self) -> Work | None:
        """The oldest query whose observation is there.

        Raises:
            MalformedMessage: a frame is no picture; the query is then dropped.
        """
        pair = self._rendezvous.next_pair()
        if pair is None:
            return None
        return _work(*pair)

    def replay(self, query: m.Query, observation: m.Observation) -> Work:
        """A past query and its observation, from the journal.

        Raises:
            MalformedMessage: the engine cannot read the observation.
        """
        check_pictures(observation, self._spec)
        return _work(query, observation)

    def missed(self) -> list[m.Query]:
        """Queries whose observation was lost in transit."""
        return list(self._rendezvous.give_up())

    def keep(self, query: m.Query, fire: Fire) -> None:
        """Takes the subgoal that a fire wrote: it is in force until the next one, and goes with every answer.

        A PONDER without memory writes anew at every query, and nothing older stays in force.
        """
        if not self._spec.remembers:
            self._subgoal, self._subgoal_source_ns = "", 0
        for text in fire.texts:
            if text.kind == "subgoal":
                self._subgoal, self._subgoal_source_ns = text.text, query.source_ns if text.text else 0

    def answer(self, work: Work, fire: Fire, *, ready_ns: int, infer_ns: int) -> tuple[m.Cognition, list[m.Subgoal]]:
        """Messages to publish: the cognition, and PONDER's generated texts."""
        query = work.query
        self.next_query = query.query + 1
        earlier = self._subgoal
        self.keep(query, fire)
        is_new = self._spec.remembers or self._subgoal != earlier  # without memory it writes the same text again
        vector = np.ascontiguousarray(fire.cognition, np.float32)
        cognition = m.Cognition(
            query=query.query,
            tick=query.tick,
            source_ns=query.source_ns,
            ready_ns=ready_ns,
            vector=vector,
            is_transition=fire.is_transition and is_new,
            context_tokens=fire.context_tokens,
            infer_ns=infer_ns,
            norm=float(np.linalg.norm(vector)),
            model_hash=self._spec.model_hash,
            is_fake=self._spec.is_random,
            text=self._subgoal if self._spec.gives_text else None,
            text_source_ns=self._subgoal_source_ns,
            gate_score=fire.gate_score,
        )
        texts = [
            m.Subgoal(
                kind=_KINDS[text.kind],
                text=text.text,
                tick=query.tick,
                query=query.query,
                token_ids=text.token_ids,
                is_truncated=text.truncated,
            )
            for text in fire.texts
        ]
        return cognition, texts


def _work(query: m.Query, observation: m.Observation) -> Work:
    frames = tuple(images.unpack(image) for image in observation.images)
    return Work(query=query, frames=frames, proprio=observation.proprio)


def check_robot(robot: m.Robot, spec: EngineSpec) -> None:
    """Raises EpisodeRefused unless the engine can read this robot's cameras and state."""
    if spec.num_cameras is not None and len(robot.cameras) != spec.num_cameras:
        raise EpisodeRefused(
            m.Refusal.CAMERAS,
            f"robot {robot.name!r} has {len(robot.cameras)} cameras {list(robot.cameras)}; PONDER expects "
            f"{spec.num_cameras}",
        )
    cameras.check_names("PONDER", spec.cameras, robot)
    if spec.reader.state_rows and robot.num_proprio != ROBOT_DIM:
        raise EpisodeRefused(
            m.Refusal.ROBOT,
            f"robot {robot.name!r} has a state of {robot.num_proprio} numbers; this PONDER reads {ROBOT_DIM}, the "
            "Panda's joints and a finger",
        )
    size = (robot.image_height, robot.image_width)
    found = spec.reader.unreadable([size] * len(robot.cameras), spec.image_px)
    if found is not None:
        camera, wanted = found
        raise EpisodeRefused(
            m.Refusal.CAMERAS,
            f"robot {robot.name!r}: camera {robot.cameras[camera]!r} gives {size[0]} x {size[1]} px; "
            f"PONDER reads {wanted}",
        )


def check_pictures(observation: m.Observation, spec: EngineSpec) -> None:
    """Raises MalformedMessage unless the images have the number and sizes that the engine can read."""
    if spec.num_cameras is not None and len(observation.images) != spec.num_cameras:
        raise MalformedMessage("Observation", "images", f"{spec.num_cameras} cameras", f"{len(observation.images)}")
    found = spec.reader.unreadable([(image.height, image.width) for image in observation.images], spec.image_px)
    if found is not None:
        image = observation.images[found[0]]
        raise MalformedMessage("Image", image.camera, found[1], f"{image.height} x {image.width} px")
