"""A policy of velocities on a robot of positions, of velocities, and on one that it does not fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pounce_server.remote.dimensions import fitting_dims
from protocol import messages as m
from protocol.errors import EpisodeRefused
from protocol.peers.mapping import Kind, Numbers, PolicyMapping
from protocol.peers.translation import rows_of


def mapped(mapping: PolicyMapping, kind: Kind, **changes: Any) -> PolicyMapping:
    each = Numbers(key=("actions",), columns=(0, 1, 2), dims=(0, 1, 2), kind=kind, measured=(0, 1, 2))
    return dataclasses.replace(mapping, actions=(each,), **changes)


def robot_of(robot_with: Callable[..., m.Robot], kind: m.DimensionKind, first: int = 0) -> m.Robot:
    dimensions = tuple(
        m.Dimension(name=f"joint {index}", kind=kind, state_index=first + index, at_stop=m.AtStop.HOLD)
        for index in range(3)
    )
    return robot_with(dimensions=dimensions)


@pytest.mark.parametrize("kind", [m.DimensionKind.VELOCITY, m.DimensionKind.POSITION])
def test_velocities_stay_what_they_are_on_a_robot_that_takes_them(
    mapping: PolicyMapping, robot_with: Callable[..., m.Robot], kind: m.DimensionKind
) -> None:
    velocities = mapped(mapping, "velocity")
    as_they_are = fitting_dims(velocities, robot_of(robot_with, kind))
    rows = rows_of(velocities, {("actions",): np.ones((20, 3))}, np.zeros(3, np.float32), as_they_are)
    expected = np.ones(20) if kind == m.DimensionKind.VELOCITY else 0.05 * np.arange(1, 21)
    np.testing.assert_allclose(rows[:, 1], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "dimension", "said"),
    [
        ("position", m.DimensionKind.VELOCITY, "position cannot be .* a velocity; expected velocity"),
        ("velocity", m.DimensionKind.GRIPPER, "velocity cannot be .* a gripper; expected gripper or position"),
        ("delta", m.DimensionKind.VELOCITY, "expected velocity"),
    ],
)
def test_a_number_that_is_no_command_of_the_robot_is_refused(
    mapping: PolicyMapping, robot_with: Callable[..., m.Robot], kind: Kind, dimension: m.DimensionKind, said: str
) -> None:
    with pytest.raises(EpisodeRefused, match=said):
        fitting_dims(mapped(mapping, kind), robot_of(robot_with, dimension))


def test_the_measured_number_is_the_robots_own(mapping: PolicyMapping, robot_with: Callable[..., m.Robot]) -> None:
    with pytest.raises(EpisodeRefused, match=r"starts from measured number 0, .* measures it in 1"):
        fitting_dims(mapped(mapping, "delta"), robot_of(robot_with, m.DimensionKind.POSITION, first=1))


def test_deltas_that_the_robot_takes_are_not_resampled(
    mapping: PolicyMapping, robot_with: Callable[..., m.Robot]
) -> None:
    with pytest.raises(EpisodeRefused, match="not resampled"):
        fitting_dims(mapped(mapping, "delta", rate_hz=10), robot_of(robot_with, m.DimensionKind.DELTA))


def test_a_robot_without_dimensions_takes_positions(mapping: PolicyMapping, robot_with: Callable[..., m.Robot]) -> None:
    assert fitting_dims(mapped(mapping, "velocity"), robot_with()) == frozenset()
