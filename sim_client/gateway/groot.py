"""GR00T's policy protocol: endpoints by name, arrays by modality; N1.6's and N1.7's nested form, or N1.5's flat one.

An episode begins with ``reset``, with another instruction, or with another client. Everything that a client is told of
the policy comes from a mapping file, and `translation` turns its arrays into our state and our rows into its arrays.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from protocol.peers.arrays import Spelling, pack
from protocol.peers.mapping import Key, PolicyMapping
from protocol.peers.translation import answer_of, named, state_of
from sim_client.gateway import reading
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Frames, Packet, Refused, Step, Terms

_ENDPOINTS = "ping, get_modality_config, reset, get_action"


class GrootDialect:
    """Works with N1.6's and N1.7's ``PolicyClient``: observations (1, 1, ...), answers [(1, H, width) by key, info]."""

    is_flat = False

    def __init__(self, terms: Terms, api_token: str = "") -> None:
        assert terms.mapping is not None, "the options see to it"
        self._terms, self._mapping, self._token = terms, terms.mapping, api_token
        self._instruction: str | None = None
        self._spelling: Spelling = "groot"

    def greeting(self) -> None:
        return None

    def read(self, packet: Packet) -> ClientRequest:
        self._spelling = _spelling_of(packet)
        message = reading.message(packet)
        if self._token and not reading.is_secret(message.get("api_token"), self._token):
            raise Refused("Unauthorized: expected the api_token that is in --api-key-file")
        endpoint = reading.word(message.get("endpoint", "get_action"), "endpoint", f"one of {_ENDPOINTS}")
        data = message.get("data")
        if endpoint == "ping":
            return ClientRequest(None, reply=self._packed({"status": "ok", "message": "Server is running"}))
        if endpoint == "get_modality_config":
            return ClientRequest(None, reply=self._packed(self._modalities()))
        if endpoint == "reset":
            self._instruction = None
            return ClientRequest(Finish(), reply=self._packed({}))
        if endpoint == "get_action":
            return ClientRequest(self._step(data if self.is_flat else self._within(data, "observation")))
        if endpoint == "kill":
            raise Refused("kill: a client does not end this server; stop pp-gateway where it was started")
        raise Refused(f"endpoint: expected one of {_ENDPOINTS}, came {reading.shown(endpoint)}")

    def answer(self, asked: ClientRequest, answer: Answer) -> bytes:
        num_commands = answer.rows_NA.shape[1]
        if num_commands != self._mapping.num_commands:
            raise Refused(
                f"{self._mapping.name} maps {self._mapping.num_commands} commands, the robot has {num_commands}"
            )
        arrays = answer_of(self._mapping, answer.rows_NA)
        if self.is_flat:
            return self._packed({f"action.{named(key)}": array for key, array in arrays.items()})
        info = {"levels": answer.level_names, **answer.told}
        return self._packed([{named(key): array[None] for key, array in arrays.items()}, info])

    def refuse(self, sentence: str) -> bytes:
        return self._packed({"error": sentence})

    def _packed(self, value: Any) -> bytes:
        return pack(value, self._spelling)

    def _step(self, observation: Any) -> Step:
        if not isinstance(observation, Mapping):
            raise Refused(f"get_action: expected an observation by key, came {type(observation).__name__}")
        instruction = self._text(observation)
        step = Step(
            instruction=instruction,
            frames=self._frames(observation),
            state=self._state(observation),
            begins=self._instruction not in (None, instruction),
            may_begin=True,
        )
        self._instruction = instruction
        return step

    def _frames(self, observation: Mapping[Any, Any]) -> Frames:
        frames = {}
        for camera in self._mapping.cameras:
            if camera.key is not None:
                name, array = self._entry(observation, "video", camera.key)
                frames[camera.camera] = reading.picture(self._current(array, name, 3), name)
        read = {named(camera.key) for camera in self._mapping.cameras if camera.key is not None}
        sent = observation if self.is_flat else self._within(observation, "video") if read else {}
        videos = (str(key) for key in sent if not self.is_flat or str(key).startswith("video."))
        reading.tell_unread(key for key in videos if key.removeprefix("video.") not in read)
        return frames

    def _state(self, observation: Mapping[Any, Any]) -> Any:
        values: dict[Key, Any] = {}
        for key in self._mapping.state_keys():
            name, array = self._entry(observation, "state", key)
            values[key] = self._current(array, name, 1)
        try:
            state = state_of(self._mapping, values)
        except (TypeError, ValueError) as error:
            raise Refused(f"state: {error}") from None
        return reading.numbers(state, "state", self._terms.num_proprio)

    def _text(self, observation: Mapping[Any, Any]) -> str:
        key = named(self._mapping.prompt.key)
        value = reading.field(
            observation if self.is_flat else self._within(observation, "language"), key, "the instruction"
        )
        while isinstance(value, list) and len(value) == 1:
            value = value[0]
        if isinstance(value, list) and value:
            raise Refused(f"{key}: expected one instruction, came {len(value)}: one robot is driven at a time (B = 1)")
        return reading.text({key: value}, key)

    def _entry(self, observation: Mapping[Any, Any], modality: str, key: Key) -> tuple[str, Any]:
        name = f"{modality}.{named(key)}"
        if self.is_flat:
            return name, reading.field(observation, name, "see get_modality_config")
        return name, reading.field(self._within(observation, modality), named(key), f"{name}, see get_modality_config")

    def _current(self, array: Any, name: str, num_dims: int) -> Any:
        """The only observation of the only robot: what is behind the batch's and time's axes, each of length 1."""
        shape = array.shape if isinstance(array, np.ndarray) else ()
        axes = shape[: len(shape) - num_dims]
        expected = "(T, ...)" if self.is_flat else "(B, T, ...)"
        if len(axes) != (1 if self.is_flat else 2):
            raise Refused(f"{name}: expected {expected}, came {reading.shown(array)}")
        if not self.is_flat and axes[0] != 1:
            raise Refused(f"{name}: {axes[0]} robots in one request; this server drives one at a time (B = 1)")
        if axes[-1] != 1:
            raise Refused(f"{name}: {axes[-1]} instants in one request; expected the current one (T = 1)")
        return np.asarray(array)[(0,) * len(axes)]

    def _modalities(self) -> dict[str, Any]:
        mapping, now, rows = self._mapping, [0], list(range(self._terms.rows))
        keys = {
            "video": ([camera.key for camera in mapping.cameras if camera.key is not None], now),
            "state": (list(mapping.state_keys()), now),
            "action": (list(mapping.action_keys()), rows),
            "language": ([mapping.prompt.key], now),
        }
        return {modality: self._modality(modality, *each) for modality, each in keys.items() if each[0]}

    def _modality(self, modality: str, keys: list[Key], indices: list[int]) -> dict[str, Any]:
        prefix = f"{modality}." if self.is_flat and modality != "language" else ""
        config = {"delta_indices": indices, "modality_keys": [prefix + named(key) for key in keys]}
        if self.is_flat:  # its clients parse JSON
            return {"__ModalityConfig_class__": True, "as_json": json.dumps(config)}
        return {"__ModalityConfig_class__": True, "__ModalityConfig__": True, "as_json": config}

    @staticmethod
    def _within(values: Any, name: str) -> Mapping[Any, Any]:
        inner = values.get(name) if isinstance(values, Mapping) else None
        if not isinstance(inner, Mapping):
            raise Refused(f"get_action: expected {name}, a map by key, came {type(inner).__name__}")
        return inner


class GrootN15Dialect(GrootDialect):
    """Works with N1.5's clients: flat keys, observations (1, ...), an answer of (H, width) arrays by key."""

    is_flat = True


def check_mapping(mapping: PolicyMapping) -> None:
    """Raises ValueError for kinds of actions that a client could not be answered with."""
    for each in mapping.actions:
        if each.kind not in ("position", "gripper"):
            raise ValueError(
                f"{mapping.name}: actions of kind {each.kind}; the gateway answers with positions and grippers"
            )


def _spelling_of(packet: Packet) -> Spelling:
    """As the client spells arrays: N1.7's newest clients read ``msgpack-numpy`` alone."""
    if isinstance(packet, bytes) and b"__ndarray_class__" not in packet and b"\xc4\x02nd" in packet:
        return "msgpack-numpy"
    return "groot"
