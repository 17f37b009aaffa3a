"""Pure readings of the physics that subtasks are judged by, with upstream's thresholds (evaluation environment)."""

from __future__ import annotations

from ponderpounce.tasks.physics import Physics

_PICKED_Z_M = 0.05
_DROPPED_Z_M = 0.035  # upstream's data-recording wrapper is laxer (0.2); evaluation, and we, use this one
_PRESSED_M = 0.005


def is_picked(physics: Physics, cube: str) -> bool:
    """The cube's centre is more than 5 cm above the table and both fingers hold it."""
    return physics.position_m(cube)[2] > _PICKED_Z_M and physics.is_grasped(cube)


def is_dropped(physics: Physics, cube: str) -> bool:
    """The cube's centre is at most 3.5 cm above the table and the fingers do not hold it."""
    return physics.position_m(cube)[2] <= _DROPPED_Z_M and not physics.is_grasped(cube)


def is_pressed(physics: Physics, button: str) -> bool:
    """The button's cap is more than 5 mm down at this instant."""
    return -physics.travel_m(f"{button}/cap") > _PRESSED_M
