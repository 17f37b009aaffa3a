"""When to be where on a joint path: the fastest timing under speed and acceleration limits.

Reachability analysis after Pham and Pham, "A new approach to time-optimal path parameterization" (TOPP-RA), 2018.
Along a path q(s) the unknowns are x = (ds/dt)^2 and u = d2s/dt2. Joint accelerations q'u + q''x are linear in both,
and x moves linearly with u from one grid point to the next, so a backward pass of small linear programs finds the
largest x from which the end can still be reached, and a forward pass takes the largest u that stays below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dual_system.tasks.geometry import Array

_MOVING = 1e-6  # slopes below this are a joint at rest
_SHORT = 1e-3  # [rad] a path of this travel has no shape worth timing: its bends are the solver's noise


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """How the fraction of a path that lies behind grows from 0 to 1, with constant acceleration between grid points."""

    times_s: Array  # (n,), when each of n evenly spaced fractions is reached
    speeds_hz: Array  # (n,), fractions per second there

    @property
    def duration_s(self) -> float:
        """The time of the last point."""
        return float(self.times_s[-1])

    def fraction(self, at_s: Array) -> Array:
        """Returns the fraction (m,) of the path that lies behind at times (m,) in seconds."""
        cell = np.clip(np.searchsorted(self.times_s, at_s, side="right") - 1, 0, len(self.times_s) - 2)
        since_s = at_s - self.times_s[cell]
        acceleration = np.diff(self.speeds_hz)[cell] / np.diff(self.times_s)[cell]
        fraction = cell / (len(self.times_s) - 1) + since_s * (self.speeds_hz[cell] + since_s * acceleration / 2)
        return np.clip(fraction, 0.0, 1.0)


def fastest(path: Array, *, max_speed: float, max_acceleration: float) -> Timing:
    """Returns the quickest timing of a joint path (n, joints) from rest to rest; n points evenly spaced along it.

    Limits hold for every joint, in units of the path per second and per second squared. A path that goes nowhere takes
    no time.
    """
    n = len(path)
    ds = 1.0 / (n - 1)
    slope = np.gradient(path, ds, axis=0, edge_order=2)
    bend = np.gradient(slope, ds, axis=0, edge_order=2)
    steepest = np.abs(slope).max(axis=1)
    if steepest.max() < 1e-9:
        return Timing(times_s=np.zeros(n), speeds_hz=np.zeros(n))
    if np.abs(np.diff(path, axis=0)).sum(axis=0).max() < _SHORT:
        fraction = np.linspace(0.0, 1.0, n)
        x_short = 2 * max_acceleration / steepest.max() * np.minimum(fraction, 1 - fraction)
        return _timed(x_short, ds)
    x_cap = np.square(max_speed / np.maximum(steepest, 1e-9))
    # A joint that is just turning round bounds x alone; the bounds on u below leave it out.
    turning = np.where(np.abs(slope) > _MOVING, 0.0, np.abs(bend)).max(axis=1)
    x_cap = np.minimum(x_cap, max_acceleration / np.maximum(turning, 1e-9))
    x_cap[[0, -1]] = 0.0
    # Limits are kept at both ends of a cell: at its far end x has become x + 2 u ds.
    slope = np.concatenate([slope[:-1], slope[1:] + 2 * ds * bend[1:]], axis=1)
    bend = np.concatenate([bend[:-1], bend[1:]], axis=1)

    x_max = np.zeros(n)
    for i in range(n - 2, -1, -1):
        x_max[i] = _largest_x(slope[i], bend[i], max_acceleration, x_next_max=x_max[i + 1], ds=ds, x_cap=x_cap[i])
    x = np.zeros(n)
    for i in range(n - 1):
        _, (offset, rate) = _acceleration_bounds(slope[i], bend[i], max_acceleration)
        x[i + 1] = min(x_max[i + 1], x[i] + 2 * ds * float(np.min(offset + rate * x[i], initial=np.inf)))
    return _timed(x, ds)


def _timed(x: Array, ds: float) -> Timing:
    """The timing that has the squared speeds (n,) at the grid points."""
    speeds_hz = np.sqrt(np.maximum(x, 0.0))
    cell_s = 2 * ds / np.maximum(speeds_hz[:-1] + speeds_hz[1:], 1e-9)  # exact for constant u within a cell
    return Timing(times_s=np.concatenate([[0.0], np.cumsum(cell_s)]), speeds_hz=speeds_hz)


def sample(path: Array, timing: Timing, period_s: float) -> Array:
    """Returns a path's points (m, joints) at even times about ``period_s`` apart, both ends included.

    Rounding the number of samples down is upstream's habit: consecutive targets may differ a little faster than the
    limit.
    """
    if timing.duration_s == 0.0:
        return path[[0, -1]]
    num_samples = max(2, int(timing.duration_s / period_s))
    fractions = timing.fraction(np.linspace(0.0, timing.duration_s, num_samples))
    grid = np.linspace(0.0, 1.0, len(path))
    return np.stack([np.interp(fractions, grid, joint) for joint in path.T], axis=1)


def _acceleration_bounds(slope: Array, bend: Array, limit: float) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Lower and upper bounds on u per moving joint, each as (offset, rate): offset + rate x."""
    moving = np.abs(slope) > _MOVING
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
