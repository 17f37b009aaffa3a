"""Named schedules: the paper's, and one that is feasible in real time."""

from __future__ import annotations

from dataclasses import replace

from clock.timebase import NS_PER_MS, NS_PER_S
from protocol.messages import Delay, DelayKind, Mode, Schedule, WaitKind

CONTROL_HZ = 20
"""Rate of the paper's robot and of our tasks'."""
HORIZON = 20
A_DAY_NS = 86_400 * NS_PER_S
MAX_S = 65  # RoboMME's limit of 1300 steps, as the paper uses it (B.1)

MEASURED = Delay(kind=DelayKind.MEASURED)
NONE = Delay(kind=DelayKind.FIXED, mean_ns=0)
FIXED_300_MS = Delay(kind=DelayKind.FIXED, mean_ns=300 * NS_PER_MS)
TRAINING_DELAY = Delay(kind=DelayKind.LOG_NORMAL, mean_ns=300 * NS_PER_MS, sigma=0.3)  # A.1


def paper(control_hz: int = CONTROL_HZ, horizon: int = HORIZON) -> Schedule:
    """The paper's evaluation (B.1): both models at 1 Hz, 300 ms of modelled delay, 20 rows of 20 played, lockstep.

    At another rate or with other chunks: all rows of a chunk are played, and what was a time stays that time.
    """
    return Schedule(
        mode=Mode.LOCKSTEP,
        control_hz=control_hz,
        horizon=horizon,
        query_period_ns=NS_PER_S,
        invoke_period_ticks=horizon,
        query_delay=FIXED_300_MS,
        invoke_delay=NONE,
        wait=WaitKind.STAND_STILL,
        max_age_ns=2 * NS_PER_S,  # a fire with text takes 0.87 s p95: an age of 1.9 s is normal at 1 Hz
        stale_limit_ns=10 * NS_PER_S,
        hold_limit_ticks=control_hz // 2,
        decelerate_ticks=control_hz // 2,
        max_ticks=MAX_S * control_hz,
    )


def realtime(control_hz: int = CONTROL_HZ, horizon: int = HORIZON) -> Schedule:
    """Feasible in real time: POUNCE every H / 2 ticks, so an invocation may take as long."""
    return replace(
        paper(control_hz, horizon),
        mode=Mode.REALTIME,
        invoke_period_ticks=max(1, horizon // 2),
        query_delay=MEASURED,
        invoke_delay=MEASURED,
    )


def once_an_episode(schedule: Schedule) -> Schedule:
    """PONDER is queried on the first observation alone, as by RoboCasa-DC's server; its cognition never is too old."""
    return replace(schedule, query_period_ns=A_DAY_NS, max_age_ns=A_DAY_NS, stale_limit_ns=A_DAY_NS)
