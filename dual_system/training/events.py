"""Event-weighted sampling: more invocations from before the moments that decide an episode than from the way there.

Most of a second's chunks move a hand through free space. What success hangs on is where another subgoal begins and
where the gripper opens or closes, a few rows of hundreds. Off by default (`ExampleConfig.event_weight`): what is drawn
more often also weighs more in the loss.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

EVENT_ROWS = 20
"""A chunk's: an invocation whose rows reach into an event is near it."""

Ticks = NDArray[np.intp]


def event_ticks(action_T8: NDArray[np.floating], transition_ticks: Collection[int]) -> Ticks:
    """Ticks at which another subgoal begins, or the gripper's command (the last of 8) changes between open and closed.

    Sorted, each once. The first tick is one only if a subgoal begins there.
    """
    is_open_T = action_T8[:, -1] > 0
    turns = np.flatnonzero(is_open_T[1:] != is_open_T[:-1]) + 1
    return np.union1d(turns, np.array(sorted(transition_ticks), np.intp)).astype(np.intp)


def draw_near(
    ticks: Sequence[int], events: Ticks, count: int, weight: float, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Draws ``count`` different places of ``ticks``, in order; those near an event are ``weight`` times as likely.

    An invocation at tick k is near an event at k to k + 19. With weight 1 it draws what a plain choice would.
    """
    if not count:
        return np.empty(0, np.intp)
    if weight == 1.0:
        return np.sort(rng.choice(len(ticks), size=count, replace=False))
    next_event = np.searchsorted(events, ticks)
    gap = np.append(events, np.iinfo(np.intp).max)[next_event] - np.asarray(ticks)
    weights = np.where(gap < EVENT_ROWS, weight, 1.0)
    return np.sort(rng.choice(len(ticks), size=count, replace=False, p=weights / weights.sum()))
