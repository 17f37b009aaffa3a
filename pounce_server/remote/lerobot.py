"""LeRobot's policy server (``lerobot-policy-server``, after 0.6.1): MessagePack over zenoh, one client per process.

Written from the public source files of October 2026, none of which is a release: see docs/policies.md. Chunks are asked
for without alignment, because our clock places them by the tick of their observation. An error closes the session, and
the next invocation opens another one: our ladder holds the robot meanwhile.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Mapping
from concurrent.futures import wait
from typing import Any

import numpy as np

from clock.timebase import NS_PER_S
from pounce_server.remote.peer import Lost, Patience, PeerError
from protocol.bus import Bus
from protocol.errors import CallFailed, TransportError
from protocol.peers.lerobot import (
    Envelope,
    WireError,
    deployment_key,
    instance_key,
    is_name,
    pack,
    session_key,
    unpack,
)
from protocol.peers.mapping import Key, PolicyMapping
from protocol.peers.translation import Values, named
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, ZenohBus

ACTION = ("action",)
_CALL_S = 5.0
_LEAVE_NS = 300_000_000
_KEEP_ANSWERS = 4
_MAX_ERROR = 500


class LerobotPeer:
    """``url``: zenoh's endpoint and the deployment, ``tcp/127.0.0.1:7447#DEPLOYMENT``."""

    def __init__(self, url: str, mapping: PolicyMapping) -> None:
        """Raises ValueError: no deployment, an endpoint that other hosts can read, or a mapping with a window."""
        endpoint, _, self._deployment = url.partition("#")
        if not self._deployment or "/" not in endpoint:
            raise ValueError(f"--url {url}: expected tcp/HOST:PORT#DEPLOYMENT")
        try:
            self._endpoints = Endpoints(connect=(endpoint,))
        except TransportError as error:
            raise ValueError(f"--url {url}: {error} LeRobot's server has no TLS of its own: use a tunnel") from None
        if mapping.window is not None:
            raise ValueError(f"{mapping.name}: LeRobot's server reads the current observation only; leave [window] out")
        self._mapping = mapping
        self._bus: Bus | None = None
        self._descriptor: Mapping[str, Any] = {}
        self._session = ""
        self._answers: Any = None
        self._generation = self._sequence = self._task_version = 0
        self._task = ""

    def facts(self, patience: Patience) -> str:
        self._connect(patience)
        found = self._descriptor
        return f"deployment={self._deployment} artifact={found['artifact_identity']} semantics={found['semantics']}"

    def begin(self, patience: Patience) -> None:
        """An episode's edge: the server drops what is under way."""
        self._connect(patience)
        self._generation += 1
        self._control("reset", patience)

    def infer(self, values: Values, patience: Patience) -> dict[Key, Any]:
        self._connect(patience)
        task = str(values[self._mapping.prompt.key])
        self._task_version += task != self._task
        self._task = task
        self._sequence += 1
        request = secrets.token_hex(16)
        body = {
            "sequence": self._sequence,
            "artifact_identity": self._descriptor["artifact_identity"],
            "observation_id": f"{self._generation}-{self._sequence}",
            "capture_time": time.monotonic_ns() / NS_PER_S,
            "task": task,
            "task_version": self._task_version,
            "features": {named(key): value for key, value in values.items() if key != self._mapping.prompt.key},
            "delay": 0,
            "model_continuation": None,
            "canonical_continuation": None,
            "cursor": 0,
        }
        packet = self._enveloped("observation", request, body)
        bus = self._opened()
        bus.publish(f"{self._session}/obs", packet, encoding="", attachment=b"", priority=Priority.DATA)
        answer = self._answered(request, patience)
        return {ACTION: np.asarray(answer.get("canonical_actions"))}

    def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            if self._session:  # without it the server keeps the seat until its grace is over
                packet = self._enveloped("control", secrets.token_hex(16), {"operation": "close"})
                wait([bus.ask(f"{self._session}/control", packet, timeout_ns=_LEAVE_NS)], _LEAVE_NS / NS_PER_S)
            bus.close()

    def _opened(self) -> Bus:
        assert self._bus is not None, "connect first"
        return self._bus

    def _connect(self, patience: Patience) -> None:
        """Describes, compares, takes the only seat, and begins generation 0. Raises PeerError, Lost."""
        if self._bus is not None:
            return
        self._bus = ZenohBus(self._endpoints)
        self._session, self._generation, self._sequence = "", 0, 0
        try:
            key = f"{deployment_key(self._deployment)}/describe"
            descriptor = self._call(key, "describe", {}, "descriptor", patience).body
            self._compare(descriptor)
            if self._descriptor and descriptor["artifact_identity"] != self._descriptor["artifact_identity"]:
                raise PeerError("it serves another artifact than at first; start pounce-serve again")
            self._descriptor = descriptor
            self._open(patience)
        except BaseException:
            self.close()
            raise

    def _open(self, patience: Patience) -> None:
        found = self._descriptor
        capabilities = found["capabilities"]
        instance = instance_key(self._deployment, found["instance_id"])
        body = {
            "expected_artifact": found["artifact_identity"],
            "features": capabilities["features"],
            "action_feature": capabilities["action_feature"],
            "semantics": found["semantics"],
            "action_interval": capabilities["action_interval"],
            "mode": "chunk",
            "encoding": "raw",
        }
        envelope = self._call(f"{instance}/open", "open", body, "accepted", patience)
        self._session = session_key(self._deployment, found["instance_id"], envelope.session_id)
        bus = self._opened()
        self._answers = bus.subscribe(f"{self._session}/act", keep=_KEEP_ANSWERS)
        bus.subscribe(f"{self._session}/language/result", keep=1)  # the server waits for it, also without language
        bus.declare_alive(f"{self._session}/alive")
        self._control("reset", patience)

    def _compare(self, found: Mapping[str, Any]) -> None:
        """Raises PeerError unless the deployment reads and answers what the mapping file says."""
        mapping, capabilities = self._mapping, found.get("capabilities")
        if not isinstance(capabilities, Mapping) or not isinstance(capabilities.get("features"), list):
            raise PeerError(f"expected a descriptor with capabilities, came {str(found)[:_MAX_ERROR]}")
        if not is_name(found.get("instance_id")):
            raise PeerError(f"instance_id {str(found.get('instance_id'))[:80]!r}: expected a name")
        texts = {name: found.get(name) for name in ("artifact_identity", "semantics")}
        if not all(isinstance(text, str) for text in texts.values()) or "action_feature" not in capabilities:
            raise PeerError(f"expected texts and an action_feature in its descriptor, came {str(found)[:_MAX_ERROR]}")
        features = {str(each.get("name")): each for each in capabilities["features"] if isinstance(each, Mapping)}
        ours = {named(camera.key): "rgb" for camera in mapping.cameras if camera.key is not None}
        ours |= {named(key): "tensor" for key in mapping.state_keys()}
        theirs = {name: each.get("kind") for name, each in features.items()}
        if theirs != ours:
            raise PeerError(f"its features are {theirs}; {mapping.name} has {ours}")
        for key, width in mapping.state_keys().items():
            if features[named(key)].get("shape") != [width]:
                raise PeerError(
                    f"its {named(key)} is {features[named(key)].get('shape')}; {mapping.name} has ({width},)"
                )
        for key, names in mapping.names.items():
            feature: Any = features.get(named(key)) or capabilities.get("action_feature")
            told = feature.get("names") if isinstance(feature, Mapping) else None
            if told and told != list(names):
                raise PeerError(f"its {named(key)} is {told}; {mapping.name} has {list(names)}")
        if capabilities.get("current_observation_only") is False:
            raise PeerError("its policy reads earlier observations too, for which LeRobot's wire has no field")
        modes, interval_s = capabilities.get("modes"), capabilities.get("action_interval")
        if not isinstance(modes, list) or "chunk" not in modes:
            raise PeerError(f"its modes are {modes}, expected chunk among them")
        if not isinstance(interval_s, (int, float)) or not interval_s > 0:
            raise PeerError(f"its action_interval is {interval_s!r}, expected seconds")
        rows, rate_hz = capabilities.get("execution_steps"), 1 / interval_s
        if rows != mapping.horizon or abs(rate_hz - mapping.rate_hz) > 1e-3:
            raise PeerError(
                f"it answers {rows} rows at {rate_hz:.4g} Hz; {mapping.name} has horizon {mapping.horizon} at "
                f"{mapping.rate_hz} Hz"
            )
        if not found.get("ready"):
            raise Lost(f"it is not ready: {found.get('failure') or found.get('session_status')}")

    def _control(self, operation: str, patience: Patience) -> None:
        ack = self._call(f"{self._session}/control", "control", {"operation": operation}, "ack", patience).body
        if ack.get("applied_generation") != self._generation:
            self.close()
            raise PeerError(
                f"{operation}: expected generation {self._generation}, came {ack.get('applied_generation')}"
            )

    def _call(self, key: str, kind: str, body: Mapping[str, Any], expected: str, patience: Patience) -> Envelope:
        """The reply. Raises Lost: nobody serves it; PeerError: an error, or no answer in time."""
        request = secrets.token_hex(16)
        asked = self._opened().ask(key, self._enveloped(kind, request, body), timeout_ns=round(_CALL_S * NS_PER_S))
        try:
            while not asked.done():
                wait([asked], patience.look_s())
            return self._read(asked.result(), expected, request)
        except CallFailed as error:
            self.close()
            raise Lost(str(error)) from error
        except PeerError:
            self.close()
            raise

    def _answered(self, request: str, patience: Patience) -> Mapping[str, Any]:
        """The action for a request. Late ones, of requests that were given up, are dropped."""
        try:
            while True:
                for sample in self._answers.drain():
                    packet = sample.payload
                    if request.encode() in packet:
                        return self._read(packet, "action", request).body
                self._opened().wait(round(patience.look_s() * NS_PER_S))
        except PeerError:
            self.close()
            raise

    def _enveloped(self, kind: str, request: str, body: Mapping[str, Any]) -> bytes:
        return pack(
            Envelope(
                kind=kind,
                body=body,
                instance_id=self._descriptor.get("instance_id", "") if kind != "describe" else "",
                session_id=self._session.rpartition("/")[2],
                request_id=request,
                generation=self._generation,
            )
        )

    def _read(self, packet: bytes, expected: str, request: str) -> Envelope:
        """Raises PeerError for an error, and for what is no reply to this request."""
        try:
            envelope = unpack(packet)
        except WireError as error:
            raise PeerError(f"expected LeRobot's messages, came {error}") from None
        if envelope.kind == "error":
            raise PeerError(f"it says: {envelope.body.get('code')}: {str(envelope.body.get('message'))[:_MAX_ERROR]}")
        if envelope.kind != expected or envelope.request_id != request:
            raise PeerError(f"expected {expected}, came {envelope.kind}")
        return envelope
