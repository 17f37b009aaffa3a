"""The conditioning video: what happens before the robot may act, kept as states and rendered on demand.

A frame is kept as the physics' state and its text, some kilobytes. PONDER reads one a second, and rendering all of them
would take longer than the whole episode.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from dual_system.tasks import captions
from dual_system.tasks.captions import Caption
from dual_system.tasks.geometry import Array
from dual_system.tasks.oracle import Motions
from dual_system.tasks.physics import Physics, PhysicsState
from dual_system.tasks.task import Task

Look = Callable[[Sequence[str]], list[captions.Pixel] | None]
"""Returns the bodies' pixels in the front camera, in order; None if one of them is hidden."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One frame of the video, 50 ms after the previous one unless something unrecorded lies between."""

    physics: PhysicsState
    caption: Caption


def perform(task: Task[Any, Any], layout: Any, physics: Physics, look: Look) -> tuple[tuple[Row, ...], Array | None]:
    """Performs a demonstration in a freshly arranged scene.

    Returns its frames and the last action (8,), which is still in force, or None without a demonstration. A frame is
    the state after an action, with the text of the part that the action belongs to: texts change when a motion ends,
    not, as later, one step after a predicate.
    """
    rows: list[Row] = []
    memory: Any = None
    caption: Caption | None = None
    action: Array | None = None
    motions = Motions(physics)
    for index, part in enumerate(task.demonstration(layout)):
        for target in part.motion(motions):
            action = target.astype(np.float64)
            physics.advance(action)
            task.stage(physics, layout, memory, physics.elapsed_steps() - 1)
            memory = task.remember(memory, physics, layout)
            if part.is_recorded:
                caption = captions.follow(caption, index, part.text, partial(look, part.grounds))
                rows.append(Row(physics=physics.save(), caption=caption))
        if part.afterwards is not None:
            part.afterwards(physics)
            physics.refresh()
    return tuple(rows), action
