"""vla-eval's model-server protocol: typed, numbered messages; episodes are announced, actions answer observations.

Written for the published package 0.8. Its harness drives LIBERO, RoboCasa, SimplerEnv, RoboMME and more, and sends a
conditioning video with the first observation. Its live runner announces itself when an episode starts, and then does
not wait for answers: each of its observations gets the current command.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from protocol.messages import Mode, TaskStatus
from sim_client.gateway import reading
from sim_client.gateway.arrays import pack
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Frames, Packet, Refused, Step, Terms

PROTOCOL_VERSION = 1
CAMERAS = {"front": "", "wrist": ""}  # by order: every benchmark names them after its own simulator
VIDEOS = {"front": "video_history", "wrist": "wrist_video_history"}
OBSERVATION_PARAMS = {"send_wrist_image": True, "send_state": True, "send_video_history": True}
"""Parameters that the harness sets in benchmarks that have them; others are unchanged."""
_SPECS = {  # vla-eval compares them with the benchmark's and warns; "raw" matches all
    "action_spec": {"action": {"name": "raw", "dims": 0, "format": "raw"}},
    "observation_spec": {"language": {"name": "language", "dims": 0, "format": "language"}},
}


class VlaEvalDialect:
    """A refused start is reported in the answers to observations, because the sync runner waits for nothing else."""

    def __init__(self, terms: Terms) -> None:
        self._terms = terms
        self._seq = 0
        self._begins = False
        self._in_episode = False
        self._task = ""
        self._objection = ""

    def greeting(self) -> None:
        return None

    def read(self, packet: Packet) -> ClientRequest:
        self._seq = 0
        message = reading.message(packet)
        kind, payload, seq = (message.get(key) for key in ("type", "payload", "seq"))
        if not isinstance(kind, str) or not isinstance(payload, Mapping) or type(seq) is not int:
            raise Refused("expected a message with type, payload and seq, as vla-eval 0.8 sends them")
        self._seq = seq
        if kind == "hello":
            return self._hello(payload)
        if kind == "episode_start":
            return self._start(payload)
        if kind == "observation":
            return ClientRequest(self._observation(payload), seq)
        if kind == "episode_end":
            finish = _outcome(payload)
            self._in_episode = False
            return ClientRequest(finish, seq)
        if kind == "error":
            return ClientRequest(None, seq)
        raise Refused(f"expected a message of vla-eval 0.8, came type {kind[:80]!r}")

    def answer(self, asked: ClientRequest, answer: Answer) -> bytes:
        payload = {"actions": answer.rows_NA[0], "level": answer.levels[0].name, **answer.told}
        return _message("action", payload, asked.seq)

    def refuse(self, sentence: str) -> bytes:
        return _message("error", {"error": sentence}, self._seq)

    def _hello(self, payload: Mapping[Any, Any]) -> ClientRequest:
        theirs = payload.get("protocol_version", PROTOCOL_VERSION)
        if type(theirs) is not int or theirs != PROTOCOL_VERSION:
            came = reading.shown(theirs)
            raise Refused(f"protocol_version: expected protocol version {PROTOCOL_VERSION} (vla-eval 0.8), came {came}")
        hello = {
            "harness_version": f"ponderpounce {self._terms.version}",
            "protocol_version": PROTOCOL_VERSION,
            "model_server": "pp-gateway",
            "capabilities": {},
            "observation_params": OBSERVATION_PARAMS,
            **_SPECS,
        }
        return ClientRequest(None, self._seq, reply=_message("hello", hello, self._seq))

    def _start(self, payload: Mapping[Any, Any]) -> ClientRequest:
        """Nothing opens yet: the instruction and the video come with the first observation."""
        task = payload.get("task")
        name = task.get("name") if isinstance(task, Mapping) else None
        self._objection = self._objection_to(payload.get("mode", "sync"))
        was_open, self._in_episode, self._begins = self._in_episode, True, True
        self._task = name if isinstance(name, str) else ""
        return ClientRequest(Finish() if was_open else None, self._seq)

    def _objection_to(self, mode: Any) -> str:
        """Why a harness that runs in this mode is not served; "" if it is."""
        ours = "live" if self._terms.mode == Mode.REALTIME else "sync"
        try:
            theirs = reading.word(mode, "mode", "sync or live")
        except Refused as error:
            return str(error)
        way_out = "realtime" if theirs == "live" else "lockstep"
        said = f"the harness runs {theirs[:80]}, this gateway {ours}: start pp-gateway with --mode {way_out}"
        return "" if theirs == ours else said

    def _observation(self, payload: Mapping[Any, Any]) -> Step:
        if not self._in_episode:
            raise Refused("an observation without an episode: expected episode_start before it")
        if self._objection:
            raise Refused(self._objection)
        pictures = reading.field(payload, "images", "pictures by camera")
        if not isinstance(pictures, Mapping):
            raise Refused(f"images: expected pictures by camera, came {type(pictures).__name__}")
        key = next((key for key in (self._terms.state_key, "states", "state") if key in payload), "states")
        state = reading.field(payload, key, "the measured joints; set send_state in the benchmark's params")
        step = Step(
            instruction=reading.text(payload, "task_description"),
            frames=reading.frames(pictures, self._terms.cameras),
            state=reading.numbers(state, key, self._terms.num_proprio),
            begins=self._begins,
            demo=self._demo(payload) if self._begins else (),
            task=self._task,
        )
        self._begins = False
        return step

    def _demo(self, payload: Mapping[Any, Any]) -> Any:
        """The conditioning video. A benchmark that films it with one camera shows that picture to every other."""
        if payload.get(VIDEOS["front"]) is None:
            no_frames: tuple[Frames, ...] = ()
            return no_frames
        keys = {name: VIDEOS.get(name, "") for name in self._terms.cameras}
        found = {name: key if key in payload else VIDEOS["front"] for name, key in keys.items()}
        return reading.videos({name: reading.listed(payload[key], key) for name, key in found.items()})


def _outcome(payload: Mapping[Any, Any]) -> Finish:
    metrics = payload.get("metrics")
    success = metrics.get("success") if isinstance(metrics, Mapping) else None
    if success is None:
        return Finish()
    status = TaskStatus.SUCCESS if reading.truth(success, "metrics.success") else TaskStatus.FAIL
    steps = reading.shown(payload["steps"]) if "steps" in payload else "unknown"
    return Finish(status=status, reason=f"says the harness, after {steps} steps")


def _message(kind: str, payload: Mapping[str, Any], seq: int) -> bytes:
    stamp_s = time.time_ns() / 1e9  # vla-eval requires a wall-clock time and reads it nowhere
    return pack({"type": kind, "payload": payload, "seq": seq, "timestamp": stamp_s}, "vla-eval")
