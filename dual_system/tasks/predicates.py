"""Pure readings of the physics that subtasks are judged by, with upstream's thresholds (evaluation environment)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.physics import Physics

_PICKED_Z_M = 0.05
_DROPPED_Z_M = 0.035  # upstream's data-recording wrapper is laxer (0.2); evaluation, and we, use this one
_PRESSED_M = 0.005
_ONTO_M = 0.05
_PUSHED_ONTO_M = 0.048
_END_LIFTED_Z_M, _INSERTED_M = 0.1, 0.05
_HOVER_M, _HOVER_Z_M = 0.03, 0.2
_AWAY_M = _OPEN_M = 0.02
_STILL_RAD_S = 0.2
_CONTAINER_LIFTED_Z_M, _CONTAINER_DOWN_Z_M, _TOOL_CLEAR_Z_M = 0.15, 0.07, 0.05


def is_picked(physics: Physics, cube: str) -> bool:
    """The cube's centre is more than 5 cm above the table and both fingers hold it."""
    return physics.position_m(cube)[2] > _PICKED_Z_M and physics.is_grasped(cube)


def is_dropped(physics: Physics, cube: str) -> bool:
    """The cube's centre is at most 3.5 cm above the table and the fingers do not hold it."""
    return physics.position_m(cube)[2] <= _DROPPED_Z_M and not physics.is_grasped(cube)


def is_pressed(physics: Physics, button: str) -> bool:
    """The button's cap is more than 5 mm down at this instant."""
    return -physics.travel_m(f"{button}/cap") > _PRESSED_M


def first_picked(physics: Physics, cubes: Iterable[str]) -> str | None:
    """The first of the cubes that is picked at this instant, or None."""
    return next((cube for cube in cubes if is_picked(physics, cube)), None)


def is_near(physics: Physics, body: str, place: str, within_m: float) -> bool:
    """Seen from above, the centres of two bodies are at most ``within_m`` apart."""
    return _distance_on_table_m(physics.position_m(body), physics.position_m(place)) <= within_m


def is_over(physics: Physics, body: str, place: str, *, within_m: float, below_z_m: float) -> bool:
    """The body's centre is near the place seen from above, and lower than ``below_z_m``."""
    return is_near(physics, body, place, within_m) and bool(physics.position_m(body)[2] < below_z_m)


def is_dropped_onto(physics: Physics, cube: str, place: str) -> bool:
    """The cube is dropped, at most 5 cm from the place's centre."""
    return is_near(physics, cube, place, _ONTO_M) and is_dropped(physics, cube)


def is_let_go(physics: Physics, body: str) -> bool:
    """Both fingers are open by more than 2 cm and the tool point is more than 2 cm away from the body's centre."""
    away_m = np.linalg.norm(physics.tcp_transform()[:3, 3] - physics.position_m(body))
    return is_gripper_open(physics) and bool(away_m > _AWAY_M)


def is_pushed_onto(physics: Physics, body: str, place: str) -> bool:
    """Seen from above, the body's centre is at most 4.8 cm from the place's."""
    return is_near(physics, body, place, _PUSHED_ONTO_M)


def is_gripper_open(physics: Physics) -> bool:
    """Both fingers are open by more than 2 cm."""
    return bool(physics.finger_openings_m().min() > _OPEN_M)


def is_lifted_by(physics: Physics, end: str, other_end: str) -> bool:
    """An end of a bar is more than 10 cm above the table and nearer to the tool point than the other one."""
    tool_m, end_m = physics.tcp_transform()[:3, 3], physics.position_m(end)
    is_nearer = np.linalg.norm(end_m - tool_m) < np.linalg.norm(physics.position_m(other_end) - tool_m)
    return bool(end_m[2] > _END_LIFTED_Z_M and is_nearer)


def is_inserted(physics: Physics, end: str, other_end: str, box: str) -> bool:
    """An end of a bar is less than 5 cm from a box's centre, and nearer to it than the other end."""
    box_m = physics.position_m(box)
    inside_m, outside_m = (float(np.linalg.norm(physics.position_m(name) - box_m)) for name in (end, other_end))
    return inside_m < min(_INSERTED_M, outside_m)


def is_hovering(physics: Physics, button: str) -> bool:
    """The tool point is within 3 cm of the button seen from above, and lower than 20 cm."""
    return is_tool_over(physics, button, within_m=_HOVER_M, below_z_m=_HOVER_Z_M)


def is_tool_over(physics: Physics, place: str, *, within_m: float, below_z_m: float) -> bool:
    """The tool point is near the place seen from above, and lower than ``below_z_m``."""
    tool_m = physics.tcp_transform()[:3, 3]
    return _distance_on_table_m(tool_m, physics.position_m(place)) <= within_m and bool(tool_m[2] < below_z_m)


def is_still(physics: Physics) -> bool:
    """Every joint of the arm turns by at most 0.2 rad/s."""
    return bool(np.abs(physics.arm_qvel()).max() <= _STILL_RAD_S)


def is_container_lifted(physics: Physics, container: str) -> bool:
    """The container's origin is more than 15 cm above the table, whatever holds it there."""
    return bool(physics.position_m(container)[2] > _CONTAINER_LIFTED_Z_M)


def is_container_put_down(physics: Physics, container: str) -> bool:
    """The container's origin is at most 7 cm above the table, not held, and the tool is clear of the table."""
    is_low = physics.position_m(container)[2] <= _CONTAINER_DOWN_Z_M
    is_tool_clear = physics.tcp_transform()[2, 3] > _TOOL_CLEAR_Z_M
    return bool(is_low and is_tool_clear and not physics.is_grasped(container))


def _distance_on_table_m(a_m: Array, b_m: Array) -> float:
    return float(np.hypot(*(a_m - b_m)[:2]))
