"""A policy server as a `PounceEngine`: asked by a mapping file, compared with it before anything moves."""

from __future__ import annotations

import hashlib
import logging
import time

import numpy as np
from numpy.typing import NDArray

from pounce_server.contract import EngineSpec, Progress, Request, Window, check_request, no_progress
from pounce_server.remote.dimensions import fitting_dims
from pounce_server.remote.peer import Lost, Patience, Peer, PeerError
from protocol.errors import EpisodeRefused
from protocol.messages import EpisodeInfo, ObservationWindow, Refusal
from protocol.peers.mapping import PolicyMapping
from protocol.peers.translation import WrongAnswer, request_of, rows_of, windows_of

log = logging.getLogger(__name__)

PROBE_PX = (256, 256)
NUM_UNMEASURED, NUM_MEASURED = 3, 20
_START_AGAIN_S = 1.0


class RemoteEngine:
    """A ``PounceEngine``. Its noise is the server's own: equal requests need not give equal rows."""

    def __init__(self, peer: Peer, mapping: PolicyMapping, url: str, *, answer_s: float, start_s: float) -> None:
        """Waits for the server, asks it once, and compares its answer with the mapping file.

        Args:
            answer_s: longest time for an answer, in seconds.
            start_s: longest wait for the server and its first answer, in seconds: a policy may compile for minutes.

        Raises:
            ValueError: no server within ``start_s``, or its answer is not what the mapping file says.
        """
        self._peer, self._mapping, self._url, self._answer_s = peer, mapping, url, answer_s
        self._cameras = tuple(camera.camera for camera in mapping.cameras)
        self._as_they_are: frozenset[int] = frozenset()
        try:
            facts = self._first_answer(start_s)
        except ValueError:
            peer.close()
            raise
        log.info("policy url=%s mapping=%s says %s", url, mapping.name, facts)
        identity = hashlib.sha256(f"{url} {mapping.digest} {facts}".encode()).hexdigest()[:12]
        self.spec = EngineSpec(
            horizon=mapping.num_rows,
            control_hz=mapping.play_hz,
            action_dim=mapping.num_commands,
            proprio_dim=mapping.num_proprio,
            num_carriers=0,
            cognition_size=0,
            image_px=0,
            num_steps=1,
            num_cameras=len(mapping.cameras),
            model_hash=f"remote-{identity}",
            is_random=False,
            has_fresh_prefix=False,
            dtype="float32",
            reads_subgoal=mapping.prompt.reads_subgoal,
            window=mapping.window,
        )

    def begin(self, info: EpisodeInfo) -> None:
        """An episode opens. Raises EpisodeRefused: another robot or rate than the mapping file's, or no server."""
        robot, rate_hz = info.robot, info.schedule.control_hz
        if rate_hz != self._mapping.play_hz:
            raise EpisodeRefused(
                Refusal.SCHEDULE,
                f"the policy is mapped for {self._mapping.play_hz} rows a second, the episode plays {rate_hz}: give "
                f"play_hz = {rate_hz} in {self._mapping.name} to have its rows interpolated",
            )
        if set(robot.cameras) != {camera.camera for camera in self._mapping.cameras}:
            names = ", ".join(camera.camera for camera in self._mapping.cameras) or "none"
            raise EpisodeRefused(
                Refusal.CAMERAS,
                f"{self._mapping.name} maps the cameras {names}, the robot has {', '.join(robot.cameras) or 'none'}; "
                "one that the policy does not read is written as {ignored = true}",
            )
        self._as_they_are = fitting_dims(self._mapping, robot)
        self._cameras = robot.cameras
        try:
            self._peer.begin(Patience(self._answer_s))
        except (PeerError, OSError) as error:
            raise EpisodeRefused(Refusal.NOT_READY, self._sentence(error), try_again=True) from error

    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        """See ``PounceEngine.invoke``; ``progress`` is called while the server is awaited.

        Raises:
            ValueError: the request does not fit ``spec``, or the server is gone, late, or answers with something else.
        """
        check_request(request, self.spec)
        return self._answer(request, Patience(self._answer_s, progress))

    def warm_up(self) -> list[int]:
        """See ``PounceEngine.warm_up``."""
        durations_ns = []
        for _ in range(NUM_UNMEASURED + NUM_MEASURED):
            start_ns = time.perf_counter_ns()
            self._answer(self._example(), Patience(self._answer_s))
            durations_ns.append(time.perf_counter_ns() - start_ns)
        return durations_ns[NUM_UNMEASURED:]

    def _answer(self, request: Request, patience: Patience) -> NDArray[np.float32]:
        frames = {
            camera: frame
            for camera, frame in zip(self._cameras, request.frames, strict=True)
            if frame is not None
        }  # fmt: skip
        values = request_of(self._mapping, frames, request.proprio, request.instruction, request.subgoal)
        if (seen := request.window) is not None:
            pictures = dict(zip(self._cameras, seen.frames, strict=True))
            values |= windows_of(
                self._mapping, pictures, seen.states_TP, seen.is_video_padded_T, seen.is_state_padded_T
            )
        try:
            answer = self._peer.infer(values, patience)
            return rows_of(self._mapping, answer, request.proprio, self._as_they_are)
        except (PeerError, OSError) as error:
            raise PeerError(self._sentence(error)) from error

    def _first_answer(self, start_s: float) -> str:
        """What the server says of itself, once it is there and has answered as the mapping file says."""
        patience = Patience(start_s)
        facts = self._awaited(patience)
        try:
            self._answer(self._example(), patience)
        except WrongAnswer as error:
            raise WrongAnswer(f"{error}. Nothing has moved: mend the mapping file, or serve the other policy") from None
        return facts

    def _awaited(self, patience: Patience) -> str:
        """What the server says of itself, as soon as it is there."""
        absence: Exception | None = None
        while True:
            try:
                return self._peer.facts(patience)
            except (PeerError, OSError) as error:
                if isinstance(error, PeerError) and not isinstance(error, Lost) and not patience.is_over:
                    raise PeerError(self._sentence(error)) from error  # it is there, and another one
                if patience.is_over:
                    sentence = self._sentence(absence or error)
                    raise PeerError(f"{sentence}: start it, or wait longer with --start-s") from error
                absence = error
                log.info("waiting: %s", self._sentence(error))
                time.sleep(min(_START_AGAIN_S, patience.limit_s))

    def _example(self) -> Request:
        return Request(
            instruction="pick up the cube",
            frames=tuple(np.zeros((*PROBE_PX, 3), np.uint8) for _ in self._mapping.cameras),
            proprio=np.zeros(self._mapping.num_proprio, np.float32),
            cognition=None,
            age_ns=0,
            seed=0,
            window=None if self._mapping.window is None else self._example_window(self._mapping.window),
        )

    def _example_window(self, window: ObservationWindow) -> Window:
        num_video, num_state = len(window.video_ticks), len(window.state_ticks)
        black = np.zeros((*PROBE_PX, 3), np.uint8)
        return Window(
            frames=((black,) * num_video,) * len(self._cameras),
            states_TP=np.zeros((num_state, self._mapping.num_proprio), np.float32),
            is_video_padded_T=np.zeros(num_video, np.bool_),
            is_state_padded_T=np.zeros(num_state, np.bool_),
        )

    def _sentence(self, error: Exception) -> str:
        return f"policy server {self._url}: {error}"
