"""Both ways of a mapping: what is asked, and rows that mean the same in both worlds."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from protocol.peers.mapping import Camera, Key, Kind, Numbers, PolicyMapping, Prompt
from protocol.peers.translation import WrongAnswer, answer_of, fitted, nested, picked, request_of, rows_of, state_of

NUMBERS = st.floats(-2, 2, width=32)
ACTIONS: Key = ("actions",)


def mapping_of(kind: Kind = "position", **changes: Any) -> PolicyMapping:
    """Two joints in degrees and a gripper that is 1 closed, of a robot with -1 closed."""
    scale = math.pi / 180
    values: dict[str, Any] = {
        "name": "test", "rate_hz": 10, "play_hz": 10, "horizon": 4, "num_proprio": 3, "num_commands": 3,
        "prompt": Prompt(key=("prompt",)),
        "cameras": (Camera(camera="front", key=("images", "front")), Camera(camera="side", key=None)),
        "state": (
            Numbers(key=("joints",), columns=(1, 0), dims=(0, 1), scale=scale),
            Numbers(key=("gripper",), columns=(0,), dims=(2,), scale=-0.04, offset=0.04),
        ),
        "actions": (
            Numbers(key=ACTIONS, columns=(0, 1), dims=(1, 0), scale=scale, kind=kind,
                    measured=() if kind == "position" else (1, 0)),
            Numbers(key=ACTIONS, columns=(2,), dims=(2,), scale=-2.0, offset=1.0, kind="gripper"),
        ),
    }  # fmt: skip
    return PolicyMapping(**(values | changes))


@given(proprio=hnp.arrays(np.float32, 3, elements=NUMBERS))
def test_a_client_that_sends_what_we_ask_with_is_understood(proprio: np.ndarray) -> None:
    mapping = mapping_of()
    values = request_of(mapping, {"front": np.zeros((4, 4, 3), np.uint8)}, proprio, "go")
    np.testing.assert_allclose(state_of(mapping, values), proprio, atol=1e-5)


@given(rows=hnp.arrays(np.float32, (4, 3), elements=NUMBERS))
def test_rows_come_back_from_a_policy_that_answers_them(rows: np.ndarray) -> None:
    mapping = mapping_of()
    back = rows_of(mapping, answer_of(mapping, rows), np.zeros(3, np.float32))
    np.testing.assert_allclose(back, rows, atol=1e-5)


@given(
    steps=hnp.arrays(np.float32, (4, 3), elements=NUMBERS),
    proprio=hnp.arrays(np.float32, 3, elements=NUMBERS),
    kind=st.sampled_from(["velocity", "delta"]),
)
def test_velocities_and_deltas_start_at_the_measured_state(steps: np.ndarray, proprio: np.ndarray, kind: Kind) -> None:
    mapping = mapping_of(kind)
    rows = rows_of(mapping, {ACTIONS: steps}, proprio)
    per_row = steps[:, :2] * math.pi / 180 / (mapping.rate_hz if kind == "velocity" else 1)
    gone = np.diff(np.concatenate([proprio[None], rows]), axis=0)[:, [1, 0]]
    np.testing.assert_allclose(gone, per_row, atol=1e-5)


def test_an_offset_is_from_the_measured_state_in_every_row() -> None:
    rows = rows_of(mapping_of("offset"), {ACTIONS: np.full((4, 3), 180.0)}, np.array([1, 2, 0], np.float32))
    np.testing.assert_allclose(rows[:, :2], np.tile([1 + math.pi, 2 + math.pi], (4, 1)), rtol=1e-6)


@given(
    rows=hnp.arrays(np.float32, (6, 3), elements=NUMBERS),
    rates=st.sampled_from([(10, 20), (15, 20), (20, 15), (50, 20)]),
)
def test_rows_of_another_rate_are_between_their_neighbours(rows: np.ndarray, rates: tuple[int, int]) -> None:
    mapping = mapping_of(horizon=6, rate_hz=rates[0], play_hz=rates[1])
    played = rows_of(mapping, answer_of(mapping, rows), np.zeros(3, np.float32))
    assert len(played) == mapping.num_rows
    for index, row in enumerate(played):
        at = index * rates[0] / rates[1]
        before, after = rows[int(at + 1e-9)], rows[min(math.ceil(at - 1e-9), 5)]
        assert (row >= np.minimum(before, after) - 1e-5).all()
        assert (row <= np.maximum(before, after) + 1e-5).all()
        assert abs(row[2] - before[2]) < 1e-5  # a gripper's rows are its own


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({}, "answers with nothing; test expects actions"),
        ({("action",): np.zeros((4, 3))}, "answers with action;"),
        ({ACTIONS: np.zeros((5, 3))}, r"is \(5, 3\) float64; test expects \(4, 3\)"),
        ({ACTIONS: np.zeros((4, 8))}, r"is \(4, 8\)"),
        ({ACTIONS: np.zeros(3)}, r"is \(3,\)"),
        ({ACTIONS: "left"}, "'actions' is"),
        ({ACTIONS: np.zeros((4, 3), bool)}, "bool"),
        ({ACTIONS: np.full((4, 3), np.nan)}, "has nan in row 0, column 0"),
        ({ACTIONS: np.array([[0, 0, 0]] * 3 + [[0, np.inf, 0]])}, "has inf in row 3, column 1"),
    ],
)
def test_another_answer_is_never_rows(answer: dict[Key, Any], said: str) -> None:
    with pytest.raises(WrongAnswer, match=said):
        rows_of(mapping_of(), answer, np.zeros(3, np.float32))


PLAIN = st.none() | st.booleans() | st.integers(-5, 5) | st.floats() | st.text(max_size=3) | st.binary(max_size=3)
ARRAYS = hnp.arrays(st.sampled_from([np.float32, np.int64, np.bool_]), hnp.array_shapes(max_dims=3, max_side=5))
ANYTHING = st.recursive(PLAIN | ARRAYS, lambda inner: st.lists(inner, max_size=4))


@given(answer=st.dictionaries(st.sampled_from([ACTIONS, ("x",)]), ANYTHING))
def test_whatever_a_policy_answers_is_finite_rows_or_is_refused(answer: dict[Key, Any]) -> None:
    with contextlib.suppress(ValueError):
        rows = rows_of(mapping_of(), answer, np.zeros(3, np.float32))
        assert rows.shape == (4, 3)
        assert np.isfinite(rows).all()


@pytest.mark.parametrize(("fit", "black"), [("stretch", 0), ("pad", 4 * 8)])
def test_a_picture_has_the_size_that_is_wanted(fit: Any, black: int) -> None:
    camera = Camera(camera="front", key=("f",), size_px=(8, 8), fit=fit, layout="chw")
    found = fitted(np.full((4, 8, 3), 255, np.uint8), camera)
    assert (found.shape, int((found[0] == 0).sum())) == ((3, 8, 8), black)


def test_a_picture_that_fits_is_not_touched() -> None:
    frame = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    assert (fitted(frame, Camera(camera="front", key=("f",))) == frame).all()


def test_a_missing_picture_is_named() -> None:
    with pytest.raises(ValueError, match="no picture of the front camera"):
        request_of(mapping_of(), {"side": np.zeros((4, 4, 3), np.uint8)}, np.zeros(3, np.float32), "go")


def test_values_are_nested_and_found_again() -> None:
    values = {("a", "b"): 1, ("a", "c"): 2, ("d",): 3}
    assert nested(values) == {"a": {"b": 1, "c": 2}, "d": 3}
    assert picked(nested(values), [*values, ("a", "b", "e"), ("f",)]) == values


def test_constants_are_in_every_request() -> None:
    mapping = dataclasses.replace(mapping_of(), constants=((("embodiment",), "droid"),))
    values = request_of(mapping, {"front": np.zeros((4, 4, 3), np.uint8)}, np.zeros(3, np.float32), "go")
    assert (values["embodiment",], values["prompt",]) == ("droid", "go")
