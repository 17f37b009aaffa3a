"""Objects that change places in view, two at a time, each in its own lane.

Where everything stands is a function of the time since the first swap began: nothing accumulates, and a restored
episode needs no memory of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dual_system.tasks.geometry import Spot, smoothstep

SWAP_STEPS = 50  # control steps that one swap takes; the next begins when it ends

Swap = tuple[int, int]  # indices of the two that change places


def nearest(spots: Sequence[Spot], index: int) -> int:
    """Returns the index of the other spot closest to that of ``index``."""
    others = [i for i in range(len(spots)) if i != index]
    return min(others, key=lambda i: float(np.hypot(*np.subtract(spots[i].xy_m, spots[index].xy_m))))


def spots_after(spots: Sequence[Spot], swaps: Sequence[Swap], elapsed_steps: float, lane_m: float) -> tuple[Spot, ...]:
    """Returns all places ``elapsed_steps`` after the first swap began; ``lane_m`` is a lane's widest bulge.

    Swaps that are over, in progress and yet to come are all accounted for.
    """
    now = list(spots)
    for nth, (first, second) in enumerate(swaps):
        progress = smoothstep(min(max(elapsed_steps / SWAP_STEPS - nth, 0.0), 1.0))
        a, b = now[first], now[second]
        now[first], now[second] = _on_the_way(a, b, progress, lane_m), _on_the_way(b, a, progress, lane_m)
    return tuple(now)


def _on_the_way(start: Spot, end: Spot, progress: float, lane_m: float) -> Spot:
    """A place between two spots: along the line, bulging to its left, and turning the short way round."""
    way = np.subtract(end.xy_m, start.xy_m)
    left = np.array([-way[1], way[0]]) / np.linalg.norm(way)
    x_m, y_m = start.xy_m + progress * way + lane_m * np.sin(np.pi * progress) * left
    turn_rad = (end.yaw_rad - start.yaw_rad + np.pi) % (2 * np.pi) - np.pi
    return Spot(x_m=float(x_m), y_m=float(y_m), yaw_rad=start.yaw_rad + progress * turn_rad)
