"""The server's side of LeRobot's remote inference: what a deployment says of itself, who is admitted, and a session.

Pure: envelopes in; envelopes, steps and errors out. An error answer to an observation ends its client's run and drives
the arm to where it began, so whatever rung of the ladder holds is answered with rows. LeRobot plays the rows on its
own timer; row 0 is the command of the tick in which the observation came. A reset ends the episode, and the next
observation begins another one, as does another task; other ends of a generation leave the episode as it is.
"""

from __future__ import annotations

import hashlib
import math
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from protocol.messages import Level, Mode
from protocol.peers.lerobot import CODEC_LIMITS, Code, Envelope, WireError, is_name
from protocol.peers.mapping import PolicyMapping
from protocol.peers.translation import answer_of, named, state_of
from sim_client.gateway.exchange import Answer, Step, Terms

ALIGNED = "chunk_alignment_v2"
IDLE_S = 10.0
"""Time for which an absent client keeps its seat."""
_ALIGNED_SETTINGS = {"chunk_merge": "aligned"}
_APPENDED_SETTINGS = {"chunk_merge": "append"}
_ACTION_DEADLINE_S, _LANGUAGE_DEADLINE_S = 5.0, 60.0
_MAX_INPUT_CHARS, _MAX_OUTPUT_CHARS = 4096, 8192
_ECHOED = ("artifact_identity", "observation_id", "capture_time", "task", "task_version")
_CURSORS = ("observation_cursor", "cursor")
_MAX_KEPT_TEXTS = 64


def check_mapping(mapping: PolicyMapping, cameras: tuple[str, ...]) -> None:
    """Raises ValueError for what no client of LeRobot can be told or answered with."""
    for each in mapping.actions:
        if each.kind not in ("position", "gripper"):
            raise ValueError(
                f"{mapping.name}: actions of kind {each.kind}; the gateway answers with positions and grippers"
            )
    if len(mapping.action_keys()) != 1:
        raise ValueError(f"{mapping.name}: expected all of [[action]] under one key, LeRobot's action")
    for key in (*mapping.state_keys(), *mapping.action_keys()):
        if key not in mapping.names:
            raise ValueError(f"[names] has no {named(key)}: LeRobot compares the names of joints, as shoulder_pan.pos")
    mapped = {each.camera for each in mapping.cameras if each.key is not None}
    if missing := sorted(set(cameras) - mapped):
        raise ValueError(f"[cameras.{missing[0]}] is missing: the robot has it, and the models read it")
    for each_camera in (each for each in mapping.cameras if each.key is not None):
        if each_camera.size_px is None or each_camera.layout != "hwc":
            raise ValueError(f"[cameras.{each_camera.camera}]: expected size_px, as LeRobot's camera has it, and hwc")


def capabilities(terms: Terms) -> dict[str, Any]:
    """What clients are told, and compare with their robot."""
    mapping = _mapping(terms)
    features = [_feature(mapping, key, (width,)) for key, width in mapping.state_keys().items()]
    for camera in mapping.cameras:
        if camera.key is not None and camera.size_px is not None:
            features.append(_feature(mapping, camera.key, (*camera.size_px, 3), kind="rgb", dtype="uint8"))
    ((action_key, width),) = mapping.action_keys().items()
    return {
        "modes": ["chunk"],
        "prediction_steps": terms.rows,
        "execution_steps": terms.rows,
        "action_interval": 1 / terms.control_hz,
        "features": features,
        "action_feature": _feature(mapping, action_key, (width,)),
        "language": terms.has_ponder and terms.mode == Mode.REALTIME,
        "training_max_delay": 0,
        "rtc_horizon": 0,
        "current_observation_only": True,
        "retains_session_state": True,
        "action_representation": "canonical",
    }


def _mapping(terms: Terms) -> PolicyMapping:
    assert terms.mapping is not None, "the options see to it"
    return terms.mapping


def _feature(
    mapping: PolicyMapping, key: tuple[str, ...], shape: tuple[int, ...], kind: str = "tensor", dtype: str = "float32"
) -> dict[str, Any]:
    return {
        "name": named(key),
        "shape": list(shape),
        "dtype": dtype,
        "kind": kind,
        "names": list(mapping.names.get(key, ())),
        "semantics": mapping.name,
    }


@dataclass(slots=True)
class Deployment:
    """One process's deployment and its sessions, as many at a time as there are seats.

    Its name, and the semantics that a client has to name, are the mapping file's name.
    """

    terms: Terms
    num_seats: int = 1
    instance_id: str = field(default_factory=lambda: secrets.token_hex(16))
    sessions: dict[str, Session] = field(default_factory=dict)
    name: str = field(init=False)
    _capabilities: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        self.name = re.sub(r"[^A-Za-z0-9_.-]+", "-", _mapping(self.terms).name).strip("-._") or "ponderpounce"
        self._capabilities = capabilities(self.terms)

    def described(self, asked: Envelope, unready: str, models: tuple[str, ...]) -> Envelope:
        """The descriptor. ``unready``: why no episode could begin, or ""; ``models``: the models' hashes."""
        return Envelope(
            kind="descriptor",
            instance_id=self.instance_id,
            request_id=asked.request_id,
            body=self._descriptor(unready, models),
        )

    def admitted(self, asked: Envelope, unready: str, models: tuple[str, ...], now_ns: int) -> Envelope:
        """Opens a session, with a new id in the reply. Raises WireError: busy, or another robot than the file's."""
        self._check_instance(asked)
        artifact, body = self._artifact(models), asked.body
        if unready:
            raise WireError(Code.EXECUTION, unready)
        if len(self.sessions) >= self.num_seats:
            raise WireError(Code.BUSY, f"all {self.num_seats} seats are taken; see --seats", self._blocker(now_ns))
        self._check_robot(body, artifact)
        settings = body.get("chunk_settings", _APPENDED_SETTINGS)
        is_aligned = settings == _ALIGNED_SETTINGS
        if not is_aligned and settings != _APPENDED_SETTINGS:
            raise WireError(Code.INCOMPATIBLE, f"chunk_settings {str(settings)[:200]}: expected chunk_merge alone")
        required = body.get("required_capabilities", [])
        if required != ([ALIGNED] if is_aligned else []) or (is_aligned and ALIGNED not in self._contracts):
            came = f"{str(required)[:200]} with {settings}"
            raise WireError(Code.UNSUPPORTED, f"required_capabilities {came}: served are {self._contracts}")
        session = Session(self.terms, artifact, is_aligned, absent_since_ns=now_ns)
        self.sessions[session.id] = session
        return Envelope(
            kind="accepted",
            instance_id=self.instance_id,
            session_id=session.id,
            request_id=asked.request_id,
            body={**self._descriptor(unready, models), "mode": "chunk", "chunk_settings": settings},
        )

    def session(self, asked: Envelope) -> Session:
        """The session that a message is for. Raises WireError if there is none."""
        self._check_instance(asked)
        if asked.session_id not in self.sessions:
            raise WireError(Code.STALE, "no such session: it was closed, or its client was absent for too long")
        return self.sessions[asked.session_id]

    def _check_instance(self, asked: Envelope) -> None:
        if asked.instance_id != self.instance_id:
            raise WireError(Code.STALE, "this is another instance: the gateway was started again")

    @property
    def semantics(self) -> str:
        """What a client has to say that it speaks: the mapping file's name."""
        return _mapping(self.terms).name

    @property
    def _contracts(self) -> list[str]:
        """In lockstep an answer's rows are a promise, and cutting the first ones would break it."""
        return [ALIGNED] if self.terms.mode == Mode.REALTIME else []

    def _artifact(self, models: tuple[str, ...]) -> str:
        terms = self.terms
        facts = (models, _mapping(terms), terms.robot, terms.mode, terms.rows, terms.control_hz)
        return "sha256:" + hashlib.sha256(repr(facts).encode()).hexdigest()

    def _blocker(self, now_ns: int) -> dict[str, Any]:
        absent = [each for each in self.sessions.values() if each.absent_since_ns is not None]
        if not absent:
            return {"admission_blocker": "active_session", "absence_grace_remaining_s": None}
        first = min(absent, key=lambda each: each.absent_since_ns or 0)
        blocker = "absence_grace" if first.was_present else "awaiting_initial_presence"
        return {"admission_blocker": blocker, "absence_grace_remaining_s": first.grace_s(now_ns)}

    def _check_robot(self, body: Mapping[str, Any], artifact: str) -> None:
        ours = self._capabilities
        if body.get("expected_artifact") not in (None, artifact):
            raise WireError(Code.INCOMPATIBLE, f"this is artifact {artifact}")
        if body.get("semantics") != self.semantics:
            came = str(body.get("semantics"))[:80]
            raise WireError(
                Code.INCOMPATIBLE, f"semantics {came!r}: expected {self.semantics!r}, the mapping file's name"
            )
        if body.get("mode") not in ours["modes"]:
            raise WireError(Code.UNSUPPORTED, f"mode {str(body.get('mode'))[:80]!r}: expected chunk")
        if body.get("encoding") not in ("raw", "jpeg"):
            raise WireError(Code.UNSUPPORTED, f"encoding {str(body.get('encoding'))[:80]!r}: expected raw or jpeg")
        interval = body.get("action_interval")
        if type(interval) is not float or not math.isclose(interval, ours["action_interval"], rel_tol=1e-6):
            came = str(interval)[:80]
            raise WireError(Code.INCOMPATIBLE, f"action_interval {came}: expected --fps={self.terms.control_hz}")
        features = body.get("features")
        if not isinstance(features, list) or len(features) != len(ours["features"]):
            names = ", ".join(feature["name"] for feature in ours["features"])
            raise WireError(Code.INCOMPATIBLE, f"features: expected {names}")
        expected = [*ours["features"], ours["action_feature"]]
        for came, feature in zip([*features, body.get("action_feature")], expected, strict=True):
            if came != feature:
                raise WireError(Code.INCOMPATIBLE, f"feature {feature['name']}: expected {feature}, came {came}"[:2000])

    def _descriptor(self, unready: str, models: tuple[str, ...]) -> dict[str, Any]:
        is_free = len(self.sessions) < self.num_seats
        return {
            "deployment": self.name,
            "instance_id": self.instance_id,
            "artifact_identity": self._artifact(models),
            "software": {"name": "ponderpounce", "version": self.terms.version},
            "semantics": self.semantics,
            "capabilities": self._capabilities,
            "execution_contracts": self._contracts,
            "ready": not unready,
            "available": not unready and is_free,
            "failure": unready or None,
            "session": {
                "owner": next(iter(self.sessions), None),
                "client_present": any(each.absent_since_ns is None for each in self.sessions.values()),
                "absence_grace_remaining_s": None,
                "cleanup_pending": False,
                "cleanup_reason": None,
                "inference_pending": False,
                "admission_blocker": None if is_free else "active_session",
            },
            "session_status": "unhealthy" if unready else "active" if self.sessions else "idle",
            "limits": {
                "action_deadline_s": _ACTION_DEADLINE_S,
                "language_deadline_s": _LANGUAGE_DEADLINE_S,
                "idle_timeout_s": IDLE_S,
                "max_input_chars": _MAX_INPUT_CHARS,
                "max_output_chars": _MAX_OUTPUT_CHARS,
                "codec": dict(CODEC_LIMITS),
                "inflight_inference": 1,
            },
        }


@dataclass(slots=True)
class Session:
    """One client. ``absent_since_ns``: since when its token is not there; None while it is."""

    terms: Terms
    artifact: str
    is_aligned: bool
    id: str = field(default_factory=lambda: secrets.token_hex(16))
    generation: int = 0
    absent_since_ns: int | None = None
    was_present: bool = False
    has_begun: bool = False
    """Whether an observation came since the last reset, so that there is an episode to end."""
    _sequence: int = -1
    _task: str | None = None
    _told: dict[str, None] = field(
        default_factory=dict
    )  # subgoals of ours: their autosteering sends them back as tasks

    def grace_s(self, now_ns: int) -> float | None:
        """Seconds for which an absent client keeps its seat; None: it is there."""
        if self.absent_since_ns is None:
            return None
        return max(0.0, IDLE_S - (now_ns - self.absent_since_ns) / 1e9)

    def controlled(self, asked: Envelope) -> tuple[str, Envelope]:
        """What a control message asks for, applied to the generation, and its acknowledgement. Raises WireError."""
        operation = asked.body.get("operation")
        if operation not in ("reset", "invalidate", "close", "status"):
            raise WireError(
                Code.MALFORMED, f"operation {str(operation)[:80]!r}: expected reset, invalidate, close, status"
            )
        if operation != "close" and asked.generation < self.generation:
            raise WireError(Code.STALE, f"generation {asked.generation}: it is {self.generation} by now")
        if operation == "status" and asked.generation != self.generation:
            raise WireError(Code.STALE, f"generation {asked.generation}: it is {self.generation}")
        if operation != "status":
            self.generation = asked.generation
        body: dict[str, Any] = {"operation": operation, "applied_generation": self.generation}
        if operation == "status":
            body["session"] = {"owner": self.id, "client_present": self.absent_since_ns is None}
        return operation, asked.reply("ack", body)

    def reset(self) -> None:
        self.has_begun, self._task = False, None

    def observed(self, asked: Envelope) -> Step:
        """An observation, or the one that a language request brings. Raises WireError if it cannot be used."""
        body, mapping = asked.body, _mapping(self.terms)
        self._check(asked)
        features = body.get("features")
        expected = {each["name"]: each for each in capabilities(self.terms)["features"]}
        if not isinstance(features, Mapping) or features.keys() != expected.keys():
            came = ", ".join(map(str, features))[:500] if isinstance(features, Mapping) else type(features).__name__
            raise WireError(Code.INCOMPATIBLE, f"features: expected {', '.join(expected)}, came {came}")
        for name, feature in expected.items():
            value = features[name]
            is_it = isinstance(value, np.ndarray) and value.dtype.name == feature["dtype"]
            if not is_it or list(value.shape) != feature["shape"]:
                raise WireError(Code.INCOMPATIBLE, f"{name}: expected {feature['dtype']} {feature['shape']}")
        task = body["task"]
        step = Step(
            instruction=task if task not in self._told or self._task is None else self._task,
            frames={each.camera: features[named(each.key)] for each in mapping.cameras if each.key is not None},
            state=state_of(mapping, {key: features[named(key)] for key in mapping.state_keys()}),
            begins=self._task not in (None, task) and task not in self._told,
            may_begin=True,
        )
        self._sequence, self._task, self.has_begun = body["sequence"], step.instruction, True
        return step

    def answered(self, asked: Envelope, answer: Answer) -> Envelope:
        """The rows in the client's units, or the newest subgoal. Raises WireError: there is none yet."""
        body, behind = asked.body, answer.behind
        echo = {key: body[key] for key in _ECHOED}
        if asked.kind == "language_request":
            if not behind.subgoal:
                raise WireError(Code.EXECUTION, "PONDER has written no subgoal yet")
            self._told[behind.subgoal] = None
            while len(self._told) > _MAX_KEPT_TEXTS:
                del self._told[next(iter(self._told))]
            return asked.reply(
                "language_result",
                {
                    **echo,
                    "answer": behind.subgoal[:_MAX_OUTPUT_CHARS],
                    "kind": body["kind"],
                    "intent_generation": body["intent_generation"],
                    "duration_s": 0.0,  # what was known is told, and nothing is computed for it
                    "age_s": behind.subgoal_age_ns / 1e9,
                },
            )
        (rows_NA,) = answer_of(_mapping(self.terms), answer.rows_NA).values()
        return asked.reply(
            "action",
            {
                **echo,
                **({key: body[key] for key in _CURSORS} if self.is_aligned else {}),
                "canonical_actions": rows_NA,
                "model_actions": None,
                "execution_steps": len(rows_NA),
                "server_durations": {
                    "pounce": behind.pounce_ns / 1e9,
                    "ponder": behind.ponder_ns / 1e9,
                    "cognition_age": behind.cognition_age_ns / 1e9,
                },
                "tick": answer.tick,
                "gate_score": behind.gate_score,
                "levels": [Level(level).name for level in answer.levels],
            },
        )

    def _check(self, asked: Envelope) -> None:
        """Raises WireError for an observation out of order, or without what every one has."""
        body, is_language = asked.body, asked.kind == "language_request"
        if asked.generation != self.generation:
            raise WireError(Code.STALE, f"generation {asked.generation}: it is {self.generation}")
        for name in ("sequence", "task_version", *(("intent_generation",) if is_language else ())):
            _whole(body, name)
        if body["sequence"] <= self._sequence:
            raise WireError(Code.STALE, f"sequence {body['sequence']} after {self._sequence}")
        if body.get("artifact_identity") != self.artifact:
            raise WireError(Code.INCOMPATIBLE, f"artifact_identity: this session's is {self.artifact}")
        for name in ("task", "observation_id", *(("text", "kind") if is_language else ())):
            text = body.get(name)
            if not isinstance(text, str) or len(text) > _MAX_INPUT_CHARS:
                raise WireError(Code.MALFORMED, f"{name}: expected a text of at most {_MAX_INPUT_CHARS} characters")
        if not body["task"].strip():
            raise WireError(Code.INCOMPATIBLE, "task is blank: expected --task, a sentence that says what to do")
        if not is_name(body["observation_id"]):
            raise WireError(Code.MALFORMED, "observation_id: expected a name")
        if type(body.get("capture_time")) not in (int, float):
            raise WireError(Code.MALFORMED, "capture_time: expected a number")
        if is_language:
            self._check_language(body)
        elif self.is_aligned and _whole(body, "cursor") < _whole(body, "observation_cursor"):
            raise WireError(Code.MALFORMED, "cursor is before observation_cursor")

    def _check_language(self, body: Mapping[str, Any]) -> None:
        if not capabilities(self.terms)["language"]:
            raise WireError(Code.UNSUPPORTED, "text is served in real time, and with a PONDER")
        if body["kind"] != "next_subtask":
            raise WireError(Code.UNSUPPORTED, f"kind {body['kind'][:80]!r}: expected next_subtask")


def _whole(body: Mapping[str, Any], name: str) -> int:
    value = body.get(name)
    if type(value) is not int or not 0 <= value < 1 << 63:
        raise WireError(Code.MALFORMED, f"{name} {str(value)[:80]!r}: expected a whole number from 0 on")
    return value
