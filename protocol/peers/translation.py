"""The arithmetic of a mapping, both ways: our observation as a policy reads it, its answer as our rows, and back.

Pure. A peer's values are a dict by `mapping.Key`; each wire nests or flattens them as it spells names.
"""

# H rows of an answer, N rows played, P measured numbers, A commands

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from protocol.errors import ProtocolError
from protocol.messages import Floats
from protocol.peers.mapping import Camera, Key, PolicyMapping

Pixels = NDArray[np.uint8]
Values = dict[Key, Any]


class WrongAnswer(ProtocolError):
    """A policy's answer that is not what the mapping file says; it is never played."""


def request_of(
    mapping: PolicyMapping, frames: Mapping[str, Pixels], proprio_P: Floats, instruction: str, subgoal: str = ""
) -> Values:
    """The values of one request: pictures uint8, vectors float32, a text, and the file's constants.

    Raises:
        ValueError: a picture is missing, or the state has another length.
    """
    if proprio_P.shape != (mapping.num_proprio,):
        raise ValueError(f"state: expected {mapping.num_proprio} numbers (num_proprio), came {proprio_P.shape}")
    values: Values = dict(mapping.constants)
    for camera in mapping.cameras:
        if camera.key is None:
            continue
        if camera.camera not in frames:
            raise ValueError(f"no picture of the {camera.camera} camera, which the policy reads")
        values[camera.key] = fitted(frames[camera.camera], camera)
    values |= _vectors(mapping, proprio_P)
    values[mapping.prompt.key] = mapping.prompt.said(instruction, subgoal)
    return values


def windows_of(
    mapping: PolicyMapping,
    frames: Mapping[str, Sequence[Pixels]],
    states_TP: Floats,
    is_video_padded_T: NDArray[np.bool_],
    is_state_padded_T: NDArray[np.bool_],
) -> Values:
    """What a mapping's window adds to `request_of`: pictures and vectors with an axis of time in front, and its masks.

    A modality of one instant, the present, has no such axis, as without a window. ``frames``: T pictures by camera.

    Raises:
        ValueError: pictures of one camera have different sizes.
    """
    values: Values = {}
    for camera in mapping.cameras:
        if camera.key is not None and len(is_video_padded_T) > 1:
            values[camera.key] = np.stack([fitted(frame, camera) for frame in frames[camera.camera]])
    if len(states_TP) > 1:
        vectors = [_vectors(mapping, state_P) for state_P in states_TP]
        values |= {key: np.stack([each[key] for each in vectors]) for key in mapping.state_keys()}
    for key, mask_T in ((mapping.video_pad, is_video_padded_T), (mapping.state_pad, is_state_padded_T)):
        if key is not None:
            values[key] = mask_T
    return values


def _vectors(mapping: PolicyMapping, proprio_P: Floats) -> Values:
    values: Values = {key: np.zeros(width, np.float32) for key, width in mapping.state_keys().items()}
    for each in mapping.state:
        values[each.key][list(each.columns)] = (proprio_P[list(each.dims)] - each.offset) / each.scale
    return values


def fitted(frame: Pixels, camera: Camera) -> Pixels:
    """The picture in the policy's size and layout; bilinear, padded with black."""
    height, width = camera.size_px or frame.shape[:2]
    if frame.shape[:2] != (height, width):
        scale_h, scale_w = height / frame.shape[0], width / frame.shape[1]
        if camera.fit == "pad":
            scale_h = scale_w = min(scale_h, scale_w)
        inner = max(1, round(frame.shape[0] * scale_h)), max(1, round(frame.shape[1] * scale_w))
        resized = np.asarray(Image.fromarray(frame).resize((inner[1], inner[0]), Image.Resampling.BILINEAR))
        frame = np.zeros((height, width, 3), np.uint8)
        top, left = (height - inner[0]) // 2, (width - inner[1]) // 2
        frame[top : top + inner[0], left : left + inner[1]] = resized
    return np.ascontiguousarray(frame.transpose(2, 0, 1) if camera.layout == "chw" else frame)


def rows_of(
    mapping: PolicyMapping, answer: Mapping[Key, Any], proprio_P: Floats, as_they_are: Collection[int] = ()
) -> Floats:
    """An answer's rows as commands of ours, (N, A) float32.

    Velocities, deltas and offsets become absolute targets, but in the commands ``as_they_are``, which the robot takes
    as velocities or deltas itself.

    Raises:
        WrongAnswer: other arrays, shapes or rows than the mapping file says, or a number that is not finite.
    """
    arrays = checked(mapping, answer)
    rows_HA = np.zeros((mapping.horizon, mapping.num_commands), np.float64)
    for each in mapping.actions:
        if each.kind == "ignored":
            continue
        theirs = absolute = arrays[each.key][:, list(each.columns)] * each.scale + each.offset
        if each.kind in ("velocity", "delta"):
            absolute = np.cumsum(theirs / (mapping.rate_hz if each.kind == "velocity" else 1), axis=0)
        if each.measured:
            absolute = absolute + proprio_P[list(each.measured)]
        is_theirs = np.isin(each.dims, list(as_they_are))
        rows_HA[:, list(each.dims)] = np.where(is_theirs, theirs, absolute)
    return _at_play_rate(mapping, rows_HA).astype(np.float32)


def checked(mapping: PolicyMapping, answer: Mapping[Key, Any]) -> dict[Key, NDArray[np.float64]]:
    """The answer's arrays, (H, width) each. Raises WrongAnswer, see `rows_of`."""
    widths = mapping.action_keys()
    if answer.keys() != widths.keys():
        expected, came = (", ".join(sorted(named(key) for key in keys)) or "nothing" for keys in (widths, answer))
        raise WrongAnswer(f"the policy answers with {came}; {mapping.name} expects {expected}")
    arrays = {}
    for key, width in widths.items():
        array = np.asarray(answer[key])
        if array.dtype.kind not in "fiu" or array.shape != (mapping.horizon, width):
            raise WrongAnswer(
                f"the policy's {named(key)!r} is {array.shape} {array.dtype}; {mapping.name} expects "
                f"({mapping.horizon}, {width}) numbers (horizon, columns)"
            )
        if not np.isfinite(array).all():
            row, column = np.argwhere(~np.isfinite(array))[0]
            raise WrongAnswer(f"the policy's {named(key)!r} has {array[row, column]} in row {row}, column {column}")
        arrays[key] = array.astype(np.float64)
    return arrays


def _at_play_rate(mapping: PolicyMapping, rows_HA: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rows at ``play_hz``: interpolated linearly, grippers as in the row before."""
    if mapping.play_hz == mapping.rate_hz:
        return rows_HA
    at_N = np.arange(mapping.num_rows) * mapping.rate_hz / mapping.play_hz
    before_N = np.floor(at_N + 1e-9).astype(int)
    after_N = np.minimum(before_N + 1, mapping.horizon - 1)
    share_N1 = (at_N - before_N)[:, None]
    rows_NA = rows_HA[before_N] * (1 - share_N1) + rows_HA[after_N] * share_N1
    grippers = [dim for each in mapping.actions if each.kind == "gripper" for dim in each.dims]
    rows_NA[:, grippers] = rows_HA[before_N][:, grippers]
    return rows_NA


def state_of(mapping: PolicyMapping, values: Mapping[Key, Any]) -> Floats:
    """Our measured numbers from a client's vectors, (P,) float32: `request_of` backwards.

    Raises:
        ValueError: a vector is missing or has another width.
    """
    proprio_P = np.zeros(mapping.num_proprio, np.float64)
    for key, width in mapping.state_keys().items():
        theirs = np.asarray(values[key], np.float64).ravel() if key in values else np.zeros(0)
        if theirs.shape != (width,):
            raise ValueError(f"{named(key)}: expected {width} numbers, came {len(theirs)}")
        for each in (each for each in mapping.state if each.key == key):
            proprio_P[list(each.dims)] = theirs[list(each.columns)] * each.scale + each.offset
    return proprio_P.astype(np.float32)


def answer_of(mapping: PolicyMapping, rows_NA: Floats) -> dict[Key, Floats]:
    """Our rows in a client's arrays, (N, width) float32: `rows_of` backwards, for positions and grippers."""
    arrays = {key: np.zeros((len(rows_NA), width), np.float32) for key, width in mapping.action_keys().items()}
    for each in mapping.actions:
        arrays[each.key][:, list(each.columns)] = (rows_NA[:, list(each.dims)] - each.offset) / each.scale
    return arrays


def nested(values: Mapping[Key, Any]) -> dict[str, Any]:
    """The values as maps within maps."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        inner = found
        for name in key[:-1]:
            inner = inner.setdefault(name, {})
        inner[key[-1]] = value
    return found


def picked(message: Any, keys: Sequence[Key]) -> Values:
    """The values at ``keys`` of maps within maps; those that are not there are left out."""
    found: Values = {}
    for key in keys:
        inner = message
        for name in key:
            inner = inner.get(name) if isinstance(inner, Mapping) else None
        if inner is not None:
            found[key] = inner
    return found


def named(key: Key) -> str:
    return ".".join(key)
