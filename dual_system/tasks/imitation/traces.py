"""Traces of the stick: targets that it touched are red for two seconds, and white dots mark the path of its tip.

Source: RoboMME's PatternLock and RouteStick at 598e3b4, rules restated. A touch is visible in the next observation, as
upstream; a dot is visible immediately, upstream one observation later.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from dual_system.tasks.geometry import pose
from dual_system.tasks.physics import Physics
from dual_system.tasks.props import GRAY, NUM_RINGS, RED, add_dot, add_rings, add_target
from dual_system.tasks.scene import RGBA, WHITE

TARGET_Z_M = 0.01  # of a target's centre
RED_STEPS = 40  # a target stays red for so long after the last touch
TRAIL_STEPS = 41  # as long is a dot seen
LOW_Z_M = 0.1  # a tip that is higher leaves no dots


_RADIUS_M, _HALF_HEIGHT_M = 0.02, 0.005
_RED_RADIUS_M, _RED_HALF_HEIGHT_M, _RED_BELOW_M = 0.02 * 1.002, 0.02 * 1.002, 0.01
_DOT_RADIUS_M, _DOT_Z_M = 0.005, 0.01
_FACETS = (16, 8)  # around and along; the targets are small in the picture
_UNSEEN: RGBA = (0, 0, 0, 0)  # neither camera nor coordinates meet a geom without opacity

Touches = tuple[int | None, ...]  # steps since each target was last touched, 0 while it is, None before it ever was


def add_traces(spec: mujoco.MjSpec, targets: Sequence[str]) -> None:
    """Adds grey targets that can turn red, their origins the grey ones' centres, and the dots.

    Red is a second, taller set of rings on the same body, so that a red target has coordinates too.
    """
    for target in targets:
        add_target(spec, target, GRAY, radius_m=_RADIUS_M, half_height_m=_HALF_HEIGHT_M)
        add_rings(spec.body(target), _red(target), RED, _RED_RADIUS_M, _RED_HALF_HEIGHT_M, z_m=-_RED_BELOW_M)
        for ring in range(NUM_RINGS):
            spec.geom(f"{_red(target)}/{ring}").rgba = _UNSEEN
    for index in range(TRAIL_STEPS):
        add_dot(spec, _dot(index), _DOT_RADIUS_M)
    # Fewer facets than MuJoCo's 28 and 16: twenty-five targets of five rings would treble the cost of a frame.
    spec.visual.quality.numslices, spec.visual.quality.numstacks = _FACETS


def followed(before: Touches | None, is_touched: Sequence[bool]) -> Touches:
    """Returns the touches after one more observation."""
    since = before or (None,) * len(is_touched)
    return tuple(0 if now else None if then is None else then + 1 for now, then in zip(is_touched, since, strict=True))


def show_touches(physics: Physics, targets: Sequence[str], touches: Touches) -> None:
    """Paints the targets that were touched red, and the others grey."""
    for target, since in zip(targets, touches, strict=True):
        is_red = _is_red(since)
        for ring in range(NUM_RINGS):
            shown = WHITE if ring % 2 else RED
            physics.paint(f"{_red(target)}/{ring}", shown if is_red else _UNSEEN)


def leave_dot(physics: Physics, step: int) -> None:
    """Moves the oldest dot to the tip, or out of sight if the tip is too high. Call it once per step."""
    x_m, y_m, z_m = physics.tcp_transform()[:3, 3]
    dot = _dot(step % TRAIL_STEPS)
    if z_m < LOW_Z_M:
        physics.place(dot, pose(x_m, y_m, _DOT_Z_M))
    else:
        physics.park(dot)


def _is_red(since: int | None) -> bool:
    return since is not None and since <= RED_STEPS


def _red(target: str) -> str:
    return f"{target}/red"


def _dot(index: int) -> str:
    return f"dot_{index}"
