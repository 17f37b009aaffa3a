"""A mapping file: a policy's names, units and rate for a robot's cameras, measured numbers and commands.

One format for every wire: `pounce-serve --backend` asks a policy server with it, `pp-gateway --dialect groot` answers a
policy's client with it. docs/policies.md explains the file field by field.
"""

from __future__ import annotations

import hashlib
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

from protocol import checks, files, window_checks
from protocol.messages import ObservationWindow

Key: TypeAlias = tuple[str, ...]
"""Where a value is in a peer's message: a name, or the names of nested maps from the outermost on."""
Kind: TypeAlias = Literal["position", "velocity", "delta", "offset", "gripper", "ignored"]
"""What a policy's numbers are. velocity: per second. delta: added to the row before, in the first row to the measured
state. offset: added to the measured state. gripper: a position that is never interpolated. ignored: not commanded."""
Fit: TypeAlias = Literal["stretch", "pad"]
Layout: TypeAlias = Literal["hwc", "chw"]

_UNITS: dict[str, float] = {
    "rad": 1.0, "deg": math.pi / 180, "m": 1.0, "mm": 1e-3, "": 1.0,
    "rad/s": 1.0, "deg/s": math.pi / 180, "m/s": 1.0, "mm/s": 1e-3,
}  # fmt: skip
"""Ours (rad, m, and seconds) in one of these; "" is any other, given by scale and offset."""
_KIND = "mapping file"
MIN_HZ, MAX_HZ = 1, 200
INSTRUCTION, SUBGOAL = "{instruction}", "{subgoal}"
_BLANK = re.compile(f"{re.escape(INSTRUCTION)}|{re.escape(SUBGOAL)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """A camera of ours under a policy's key. None as a key: the policy does not read it."""

    camera: str
    key: Key | None
    size_px: tuple[int, int] | None = None
    """(height, width) to which pictures are resized; None: as they come."""
    fit: Fit = "stretch"
    layout: Layout = "hwc"


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbers:
    """A policy's vector, or columns of it, and the dims of ours that they are.

    Ours are theirs times ``scale`` plus ``offset``; the unit is part of the scale.
    """

    key: Key
    columns: tuple[int, ...]
    dims: tuple[int, ...]
    scale: float = 1.0
    offset: float = 0.0
    kind: Kind = "position"
    measured: tuple[int, ...] = ()
    """Indices of the measured state to which a velocity, a delta or an offset is added."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Prompt:
    """Where the text goes and what it says."""

    key: Key
    text: str = INSTRUCTION

    @property
    def reads_subgoal(self) -> bool:
        return SUBGOAL in self.text

    def said(self, instruction: str, subgoal: str) -> str:
        """The prompt; the instruction alone while there is no subgoal."""
        if self.reads_subgoal and not subgoal:
            return instruction
        said = {INSTRUCTION: instruction, SUBGOAL: subgoal}
        return _BLANK.sub(lambda blank: said[blank[0]], self.text)


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyMapping:
    """A mapping file's contents, checked."""

    name: str
    rate_hz: int
    """Rate of the policy's rows."""
    play_hz: int
    """Rate at which they are played: of the robot. Rows are interpolated if it is another one."""
    horizon: int
    """Rows in an answer of the policy."""
    num_proprio: int
    num_commands: int
    prompt: Prompt
    cameras: tuple[Camera, ...]
    state: tuple[Numbers, ...]
    actions: tuple[Numbers, ...]
    window: ObservationWindow | None = None
    """The ticks, at ``play_hz``, at which the policy looks; None: the present alone."""
    video_pad: Key | None = None
    """Where a policy is told which of a window's pictures are padding; None: it is not told."""
    state_pad: Key | None = None
    constants: tuple[tuple[Key, Any], ...] = ()
    """Further values of every request, for peers that want them."""
    names: Mapping[Key, tuple[str, ...]] = field(default_factory=dict)
    """The components of vectors and arrays, for peers that compare them."""
    digest: str = ""

    @property
    def num_rows(self) -> int:
        """Rows of an answer at ``play_hz``."""
        return (self.horizon - 1) * self.play_hz // self.rate_hz + 1

    def action_keys(self) -> dict[Key, int]:
        """The keys of an answer's arrays, with their width."""
        widths: dict[Key, int] = {}
        for each in self.actions:
            widths[each.key] = max(widths.get(each.key, 0), max(each.columns) + 1)
        return widths

    def state_keys(self) -> dict[Key, int]:
        """The keys of a request's vectors, with their width."""
        widths: dict[Key, int] = {}
        for each in self.state:
            widths[each.key] = max(widths.get(each.key, 0), max(each.columns) + 1)
        return widths


def read_mapping(path: Path) -> PolicyMapping:
    """Reads a mapping file.

    Raises:
        OSError, FileError: it cannot be read, or does not map a policy to a robot; the message names the field.
    """
    text = files.read_text(path, _KIND)
    with files.reading(path, _KIND):
        digest = hashlib.sha256(text.encode()).hexdigest()[:12]
        return _mapping(tomllib.loads(text), path.stem, digest)


def _mapping(given: dict[str, Any], name: str, digest: str) -> PolicyMapping:
    known = {"rate_hz", "play_hz", "horizon", "num_proprio", "num_commands", "prompt", "cameras", "state", "action"}
    _only(given, known | {"constants", "names", "window"}, "the file")
    rate_hz = _integer(given, "rate_hz", MIN_HZ, MAX_HZ)
    found = PolicyMapping(
        name=name,
        rate_hz=rate_hz,
        play_hz=_integer(given, "play_hz", MIN_HZ, MAX_HZ) if "play_hz" in given else rate_hz,
        horizon=_integer(given, "horizon", 1, checks.MAX_HORIZON),
        num_proprio=_integer(given, "num_proprio", 1, checks.MAX_DIM),
        num_commands=_integer(given, "num_commands", 1, checks.MAX_DIM),
        prompt=_prompt(given["prompt"]),
        cameras=tuple(_camera(camera, each) for camera, each in given.get("cameras", {}).items()),
        state=tuple(_numbers(each, index, "state", "from") for index, each in enumerate(given.get("state", []))),
        actions=tuple(_numbers(each, index, "action", "to") for index, each in enumerate(given["action"])),
        **_window(given["window"]) if "window" in given else {},
        constants=tuple((_key(name, "constants"), value) for name, value in given.get("constants", {}).items()),
        digest=digest,
    )
    _check_dims(found)
    return replace(found, names=_names(given.get("names", {}), found))


def _names(given: Mapping[str, Any], found: PolicyMapping) -> dict[Key, tuple[str, ...]]:
    widths = {".".join(key): (key, width) for key, width in (found.state_keys() | found.action_keys()).items()}
    names = {}
    for key, components in given.items():
        if key not in widths:
            raise ValueError(f"[names] {key!r}: expected one of {', '.join(widths)}")
        is_list = isinstance(components, list) and all(isinstance(each, str) and each.strip() for each in components)
        if not is_list or len(set(components)) != len(components) or len(components) != widths[key][1]:
            raise ValueError(f"[names] {key!r} = {components!r}: expected {widths[key][1]} different names")
        names[widths[key][0]] = tuple(components)
    return names


def _window(given: Mapping[str, Any]) -> dict[str, Any]:
    """The window and where its masks go, by field of `PolicyMapping`."""
    _only(given, {"video", "state", "video_pad", "state_pad"}, "[window]")
    ticks = {}
    for modality in ("video", "state"):
        offsets = _integers(given.get(modality, [0]), f"[window] {modality}", -window_checks.MAX_REACH_TICKS, 0)
        if why_not := window_checks.no_window(offsets):
            raise ValueError(f"[window] {modality} = {why_not}")
        ticks[f"{modality}_ticks"] = offsets
    pads = {name: _key(given[name], f"[window] {name}") for name in ("video_pad", "state_pad") if name in given}
    return {"window": ObservationWindow(video_ticks=ticks["video_ticks"], state_ticks=ticks["state_ticks"]), **pads}


def _prompt(given: Mapping[str, Any]) -> Prompt:
    _only(given, {"key", "text"}, "[prompt]")
    text = str(given.get("text", INSTRUCTION))
    if INSTRUCTION not in text and SUBGOAL not in text:
        raise ValueError(f"[prompt] text {text!r}: expected {INSTRUCTION}, {SUBGOAL}, or both in it")
    return Prompt(key=_key(given["key"], "[prompt]"), text=text)


def _camera(camera: str, given: Mapping[str, Any]) -> Camera:
    where = f"[cameras.{camera}]"
    if given == {"ignored": True}:
        return Camera(camera=camera, key=None)
    _only(given, {each.name for each in fields(Camera)} - {"camera"}, where)
    fit, layout = given.get("fit", "stretch"), given.get("layout", "hwc")
    for name, value, options in (("fit", fit, get_args(Fit)), ("layout", layout, get_args(Layout))):
        if value not in options:
            raise ValueError(f"{where} {name} = {value!r}: expected {' or '.join(options)}")
    size = given.get("size_px")
    if size is not None:
        size = _integers(size, f"{where} size_px", 1, checks.MAX_IMAGE_SIDE_PX)
        if len(size) != 2:
            raise ValueError(f"{where} size_px: expected [height, width], came {len(size)} numbers")
    return Camera(camera=camera, key=_key(given["key"], where), size_px=size, fit=fit, layout=layout)


def _numbers(given: Mapping[str, Any], index: int, table: str, ours: str) -> Numbers:
    where = f"[[{table}]] number {index + 1}"
    kind: Kind = given.get("kind", "position" if table == "state" else "")
    if table == "state" and "kind" in given:
        raise ValueError(f"{where}: expected no kind, which actions have")
    if kind not in get_args(Kind):
        raise ValueError(f"{where} kind = {kind!r}: expected one of {', '.join(get_args(Kind))}")
    if kind == "ignored":
        _only(given, {"key", "kind", "columns"}, where)
        columns = _integers(given["columns"], f"{where} columns", 0, checks.MAX_DIM - 1)
        return Numbers(key=_key(given["key"], where), columns=columns, dims=(), kind=kind)
    _only(given, {"key", "kind", "columns", ours, "unit", "scale", "offset", "measured"}, where)
    dims = _integers(given[ours], f"{where} {ours}", 0, checks.MAX_DIM - 1)
    columns = _integers(given.get("columns", list(range(len(dims)))), f"{where} columns", 0, checks.MAX_DIM - 1)
    measured = _integers(given.get("measured", list(dims)), f"{where} measured", 0, checks.MAX_DIM - 1)
    if not len(columns) == len(dims) == len(measured):
        raise ValueError(f"{where}: expected as many columns as dims, came {len(columns)} and {len(dims)}")
    unit = str(given.get("unit", ""))
    if unit not in _UNITS:
        raise ValueError(f"{where} unit = {unit!r}: expected one of {', '.join(filter(None, _UNITS))}, or none")
    if unit and unit.endswith("/s") != (kind == "velocity"):
        raise ValueError(f"{where}: a {kind} in {unit}: only a velocity is per second")
    scale = _finite(given, "scale", 1.0, where) * _UNITS[unit]
    if scale == 0:
        raise ValueError(f"{where} scale = 0: expected another number")
    is_absolute = kind in ("position", "gripper")
    offset = _finite(given, "offset", 0.0, where)
    if offset and not is_absolute:
        raise ValueError(f"{where} offset = {offset}: expected none for a {kind}")
    return Numbers(
        key=_key(given["key"], where),
        columns=columns,
        dims=dims,
        scale=scale,
        offset=offset,
        kind=kind,
        measured=() if is_absolute else measured,
    )


def _check_dims(found: PolicyMapping) -> None:
    """Raises ValueError unless every command is written once, every column is read once, and no index is beyond."""
    written = [dim for each in found.actions for dim in each.dims]
    if sorted(written) != list(range(found.num_commands)):
        raise ValueError(f"[[action]]: expected each of the {found.num_commands} commands once, came {sorted(written)}")
    for table, slices in (("state", found.state), ("action", found.actions)):
        read = [(each.key, column) for each in slices for column in each.columns]
        widths = found.state_keys() if table == "state" else found.action_keys()
        if sorted(read) != sorted((key, column) for key, width in widths.items() for column in range(width)):
            raise ValueError(
                f"[[{table}]]: expected each column of a key once, came {sorted(read)}; "
                + ("a column that is not to be commanded has kind = 'ignored'" if table == "action" else "")
            )
    beyond = [dim for each in found.state for dim in each.dims] + [i for each in found.actions for i in each.measured]
    if beyond and max(beyond) >= found.num_proprio:
        raise ValueError(f"measured number {max(beyond)}: expected 0 to {found.num_proprio - 1} (num_proprio)")
    seen = {"video": any(camera.key for camera in found.cameras), "state": bool(found.state)}
    for modality, is_read in seen.items():
        if found.window is not None and not is_read and getattr(found.window, f"{modality}_ticks") != (0,):
            raise ValueError(f"[window] {modality}: the policy reads none")
    if not found.state and not any(camera.key for camera in found.cameras):
        raise ValueError("expected a camera or a [[state]]: this policy would see nothing")
    keys = [found.prompt.key, *(c.key for c in found.cameras if c.key), *found.state_keys()]
    keys += [key for key, _ in found.constants]
    keys += [key for key in (found.video_pad, found.state_pad) if key is not None]
    for key in keys:
        if sum(other[: len(key)] == key for other in keys) > 1:  # one map cannot hold both
            raise ValueError(f"key {'.'.join(key)}: expected another key for every value")


def _only(given: Mapping[str, Any], known: set[str], where: str) -> None:
    if unknown := sorted(given.keys() - known):
        raise ValueError(f"{where}: {', '.join(unknown)} is not known; expected {', '.join(sorted(known))}")


def _key(value: Any, where: str) -> Key:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"{where} key = {value!r}: expected a name, or a list of names for nested maps")
    return tuple(names)


def _integer(given: Mapping[str, Any], name: str, low: int, high: int) -> int:
    return _integers([given[name]], name, low, high)[0]


def _integers(values: Sequence[Any], what: str, low: int, high: int) -> tuple[int, ...]:
    if not isinstance(values, list) or not values or not all(type(v) is int and low <= v <= high for v in values):
        raise ValueError(f"{what} = {values!r}: expected whole numbers from {low} to {high}")
    return tuple(values)


def _finite(given: Mapping[str, Any], name: str, default: float, where: str) -> float:
    value = given.get(name, default)
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError(f"{where} {name} = {value!r}: expected a number")
    return float(value)
