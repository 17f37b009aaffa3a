"""When to be where on a joint path: the fastest timing under speed and acceleration limits.

Reachability analysis after Pham and Pham, "A new approach to time-optimal path parameterization" (TOPP-RA), 2018.
Along a path q(s) the unknowns are x = (ds/dt)^2 and u = d2s/dt2. Joint accelerations q'u + q''x are linear in both,
and x moves linearly with u from one grid point to the next, so a backward pass of small linear programs finds the
largest x from which the end can still be reached, and a forward pass takes the largest u that stays below.
"""

from __future__ import annotations

import numpy as np

from ponderpounce.tasks.geometry import Array


def fastest(path: Array, *, max_speed: float, max_acceleration: float) -> Array:
    """Returns the times (n,) in seconds at which the points of a joint path (n, joints) are passed, from rest to rest.

    Limits hold for every joint, in units of the path per second and per second squared.
    """
    n = len(path)
    ds = 1.0 / (n - 1)
    slope = np.gradient(path, ds, axis=0, edge_order=2)
    bend = np.gradient(slope, ds, axis=0, edge_order=2)
    steepest = np.abs(slope).max(axis=1)
    if steepest.max() < 1e-9:
        return np.zeros(n)
    x_cap = np.square(max_speed / np.maximum(steepest, 1e-9))
    x_cap[[0, -1]] = 0.0

    x_max = np.zeros(n)
    for i in range(n - 2, -1, -1):
        x_max[i] = _largest_x(slope[i], bend[i], max_acceleration, x_next_max=x_max[i + 1], ds=ds, x_cap=x_cap[i])
    x = np.zeros(n)
    for i in range(n - 1):
        _, (offset, rate) = _acceleration_bounds(slope[i], bend[i], max_acceleration)
        x[i + 1] = min(x_max[i + 1], x[i] + 2 * ds * float(np.min(offset + rate * x[i])))
    speed = np.sqrt(np.maximum(x, 0.0))
    # Exact for constant u between grid points; the first and last segments start or end at rest.
    return np.concatenate([[0.0], np.cumsum(2 * ds / np.maximum(speed[:-1] + speed[1:], 1e-9))])


def sample(path: Array, times_s: Array, period_s: float) -> Array:
    """Returns the path's points at even times (m, joints), both ends included, about ``period_s`` apart.

    Rounding the number of samples down is upstream's habit: consecutive targets may differ a little faster than the
    limit.
    """
    num_samples = max(2, int(times_s[-1] / period_s))
    even_s = np.linspace(0.0, times_s[-1], num_samples)
    return np.stack([np.interp(even_s, times_s, joint) for joint in path.T], axis=1)


def _acceleration_bounds(slope: Array, bend: Array, limit: float) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Lower and upper bounds on u per moving joint, each as (offset, rate): offset + rate x."""
    moving = np.abs(slope) > 1e-6
    slope, bend = slope[moving], bend[moving]
    offset, rate = limit / np.abs(slope), -bend / slope
    return (-offset, rate), (offset, rate)


def _largest_x(slope: Array, bend: Array, limit: float, *, x_next_max: float, ds: float, x_cap: float) -> float:
    """The largest x from which some allowed u leads into [0, x_next_max] within one grid step.

    Eliminating u leaves one inequality per (lower, upper) pair of bounds on it.
    """
    (low_offset, low_rate), (high_offset, high_rate) = _acceleration_bounds(slope, bend, limit)
    low_offset, low_rate = np.append(low_offset, 0.0), np.append(low_rate, -0.5 / ds)
    high_offset, high_rate = np.append(high_offset, x_next_max / (2 * ds)), np.append(high_rate, -0.5 / ds)
    steeper = low_rate[:, None] - high_rate[None, :]
    room = high_offset[None, :] - low_offset[:, None]
    limits = room[steeper > 1e-12] / steeper[steeper > 1e-12]
    return float(min(x_cap, limits.min(initial=np.inf)))
