"""GR00T's policy server over ZMQ: N1.6's and N1.7's nested observations, or N1.5's flat ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import zmq

from pounce_server.remote.peer import Patience, PeerError
from protocol.messages import ObservationWindow
from protocol.peers.arrays import NotAMessage, pack, unpack
from protocol.peers.mapping import Key, PolicyMapping
from protocol.peers.translation import Values, named

_MODALITIES = ("video", "state", "action", "language")
_MAX_BYTES = 64 << 20
_MAX_ERROR = 500


class GrootPeer:
    """A server of ``gr00t/eval/run_gr00t_server.py`` (N1.6, N1.7) or ``inference_service.py`` (N1.5, ``is_flat``).

    Its modality configuration is compared with the mapping file: keys, the window, the horizon. A request
    without an answer costs the socket: ZMQ's REQ cannot send again, and the late answer must not be the next one's.
    """

    def __init__(self, url: str, mapping: PolicyMapping, *, is_flat: bool, api_token: str = "") -> None:
        """Raises ValueError: the mapping has a mask, for which this wire has no field."""
        if mapping.video_pad or mapping.state_pad:
            raise ValueError(f"{mapping.name}: GR00T's observations have no masks; leave video_pad and state_pad out")
        self._url, self._mapping, self._is_flat, self._token = url, mapping, is_flat, api_token
        self._socket: zmq.Socket[bytes] | None = None

    def facts(self, patience: Patience) -> str:
        self._call("ping", None, patience)
        config = self._call("get_modality_config", None, patience)
        self._compare(config)
        return ", ".join(f"{name}: {' '.join(config[name]['modality_keys'])}" for name in _MODALITIES)

    def begin(self, patience: Patience) -> None:
        """N1.5's server knows no reset: its policy keeps nothing between two calls."""
        if not self._is_flat:
            self._call("reset", {"options": None}, patience)

    def infer(self, values: Values, patience: Patience) -> dict[Key, Any]:
        observation = self._flat(values) if self._is_flat else self._nested(values)
        data = observation if self._is_flat else {"observation": observation, "options": None}
        answer = self._call("get_action", data, patience)
        if not self._is_flat:
            answer = answer[0] if isinstance(answer, list | tuple) and answer else None
        if not isinstance(answer, Mapping):
            raise PeerError(f"expected actions by key, came {type(answer).__name__}")
        return {(str(name).removeprefix("action."),): self._unbatched(array) for name, array in answer.items()}

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close(linger=0)
            self._socket = None

    def _nested(self, values: Values) -> dict[str, Any]:
        """Arrays (batch 1, time, ...), the prompt [[text]]."""
        flat = self._timed(values)
        return {
            "video": {named(c.key): flat[c.key][None] for c in self._mapping.cameras if c.key is not None},
            "state": {named(key): flat[key][None] for key in self._mapping.state_keys()},
            "language": {named(self._mapping.prompt.key): [[values[self._mapping.prompt.key]]]},
        }

    def _timed(self, values: Values) -> Values:
        """The arrays (time, ...), as a window of several instants has them already."""
        keys = {camera.key: 3 for camera in self._mapping.cameras if camera.key is not None}
        keys |= dict.fromkeys(self._mapping.state_keys(), 1)
        return {key: values[key] if values[key].ndim > ndim else values[key][None] for key, ndim in keys.items()}

    def _flat(self, values: Values) -> dict[str, Any]:
        """Arrays (time, ...), the prompt [text]."""
        flat = self._timed(values)
        pictures = {f"video.{named(c.key)}": flat[c.key] for c in self._mapping.cameras if c.key is not None}
        states = {f"state.{named(key)}": flat[key] for key in self._mapping.state_keys()}
        return {**pictures, **states, named(self._mapping.prompt.key): [values[self._mapping.prompt.key]]}

    def _unbatched(self, array: Any) -> Any:
        """(H, width) of N1.6's (1, H, width); N1.5 answers (H,) for a single column."""
        found = np.asarray(array)
        if not self._is_flat and found.ndim == 3 and len(found) == 1:
            return found[0]
        return found[:, None] if self._is_flat and found.ndim == 1 else found

    def _compare(self, config: Any) -> None:
        """Raises PeerError: the server's modalities are not the mapping file's."""
        expected = {
            "video": {named(camera.key) for camera in self._mapping.cameras if camera.key is not None},
            "state": {named(key) for key in self._mapping.state_keys()},
            "action": {named(key) for key in self._mapping.action_keys()},
            "language": {named(self._mapping.prompt.key)},
        }
        for name, keys in expected.items():
            each = _plain(config, name)
            theirs = {str(key).removeprefix(f"{name}.") for key in each["modality_keys"]}
            if theirs != keys:
                raise PeerError(
                    f"its {name} keys are {', '.join(sorted(theirs))}; {self._mapping.name} has "
                    f"{', '.join(sorted(keys)) or 'none'}"
                )
            indices = each["delta_indices"]
            if name == "action" and len(indices) != self._mapping.horizon:
                raise PeerError(f"its action has {len(indices)} steps, expected {self._mapping.horizon} (horizon)")
            if name == "language" and len(indices) != 1:
                raise PeerError(f"its language has {len(indices)} steps, expected 1")
            if name in ("video", "state") and len(keys) and (why_not := self._other_window(name, indices)):
                raise PeerError(f"its {name} has the steps {indices}, {self._mapping.name} {why_not}")

    def _other_window(self, name: str, indices: list[Any]) -> str:
        """What the mapping file has instead of a modality's steps, which are the policy's rows; "" if they agree."""
        mapping, window = self._mapping, self._mapping.window or ObservationWindow()
        ours = window.video_ticks if name == "video" else window.state_ticks
        theirs = [each * mapping.play_hz for each in indices if isinstance(each, int)]
        if theirs == [offset * mapping.rate_hz for offset in ours]:
            return ""
        ticks = "" if mapping.play_hz == mapping.rate_hz else f" ticks at {mapping.play_hz} Hz"
        return f"looks at {list(ours)}{ticks}; say so in [window] {name}"

    def _call(self, endpoint: str, data: Any, patience: Patience) -> Any:
        """Raises PeerError: no answer in time, an error, or bytes that are none of theirs."""
        if self._socket is None:
            self._socket = zmq.Context.instance().socket(zmq.REQ)
            self._socket.setsockopt(zmq.LINGER, 0)
            self._socket.setsockopt(zmq.MAXMSGSIZE, _MAX_BYTES)
            try:
                self._socket.connect(self._url)
            except zmq.ZMQError as error:
                self.close()
                raise PeerError(f"no address: {error}; expected tcp://HOST:PORT") from error
        request: dict[str, Any] = {"endpoint": endpoint}
        if data is not None:
            request["data"] = data
        if self._token:
            request["api_token"] = self._token
        try:
            self._socket.send(pack(request, "groot"), zmq.NOBLOCK)
            while not self._socket.poll(round(patience.look_s() * 1e3)):
                pass
            packet = self._socket.recv()
        except zmq.ZMQError as error:
            self.close()
            raise PeerError(f"connection lost: {error}") from error
        except PeerError:
            self.close()
            raise
        try:
            answer = unpack(packet)
        except NotAMessage as error:
            raise PeerError(f"expected GR00T's msgpack, came {error}") from None
        if isinstance(answer, Mapping) and "error" in answer:
            raise PeerError(f"it says: {str(answer['error'])[:_MAX_ERROR]}")
        return answer


def _plain(config: Any, name: str) -> Mapping[str, Any]:
    """One modality of a configuration. Raises PeerError for what is none."""
    each = config.get(name) if isinstance(config, Mapping) else None
    if not isinstance(each, Mapping) or not all(
        isinstance(each.get(k), list) for k in ("modality_keys", "delta_indices")
    ):
        raise PeerError(f"expected a modality configuration with {name}, came {str(config)[:_MAX_ERROR]}")
    return each
