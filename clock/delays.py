"""Delays of answers: measured, fixed, or drawn as in training (paper, A.1).

Log-normal delays and intervals have arithmetic mean ``mean_ns`` and log-space standard deviation ``sigma``, clipped at
three sigma; ready times keep query order.
"""

from __future__ import annotations

import math

import numpy as np

from protocol.messages import Delay, DelayKind

CLIP_SIGMAS = 3.0


def log_normal_ns(rng: np.random.Generator, mean_ns: int, sigma: float) -> int:
    """Draws once. The log-space mean is ln(mean) - sigma^2/2, so that the *arithmetic* mean is ``mean_ns``."""
    z = float(np.clip(rng.standard_normal(), -CLIP_SIGMAS, CLIP_SIGMAS))
    return round(mean_ns * math.exp(sigma * z - sigma * sigma / 2))


def modelled_ns(delay: Delay, rng: np.random.Generator) -> int | None:
    """The delay of the next answer; None if it is measured."""
    if delay.kind == DelayKind.FIXED:
        return delay.mean_ns
    if delay.kind == DelayKind.LOG_NORMAL:
        return log_normal_ns(rng, delay.mean_ns, delay.sigma)
    return None


def in_order(ready_ns: int, previous_ready_ns: int | None) -> int:
    """Ready time of an answer, at least the previous one's: a later query is never ready before an earlier one."""
    return ready_ns if previous_ready_ns is None else max(ready_ns, previous_ready_ns)
