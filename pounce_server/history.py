"""An episode's past front pictures, for an engine with a frame memory: the demonstration's and the robot's. Pure.

One of these belongs to one robot's episode; another episode has another one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dual_system.models.frame_sampling import FrameSampling, PastFrame
from protocol import images
from protocol.errors import MalformedMessage
from protocol.messages import DemoFrame, Observation


class History:
    """The pictures on the grid of a `FrameSampling`, by their place in the history."""

    def __init__(self, sampling: FrameSampling, demo: Sequence[DemoFrame] = ()) -> None:
        """``demo``: the demonstration as ``sampling.demonstrations`` samples it.

        Raises:
            MalformedMessage: an instant of it has no front picture.
        """
        self._sampling = sampling
        self._num_demo = len(demo)
        self._frames: dict[int, NDArray[np.uint8]] = {}
        for index, instant in enumerate(demo):
            if not instant.images:
                raise MalformedMessage("DemoFrame", "images", "a front picture", f"none at instant {index}")
            self._frames[index] = images.unpack(instant.images[0])

    @property
    def is_delayed(self) -> bool:
        """Whether it is read as it was at the query whose cognition is given."""
        return self._sampling.until == "query"

    def on_observation(self, observation: Observation) -> None:
        """Keeps the front picture of a tick of the grid. One that is no picture counts as lost."""
        if not observation.images or observation.tick % self._sampling.stride_ticks:
            return
        try:
            frame = images.unpack(observation.images[0])
        except MalformedMessage:
            return
        self._frames[self._sampling.num_seen(self._num_demo, observation.tick) - 1] = frame

    def at(self, tick: int) -> tuple[PastFrame, ...]:
        """The pictures that an invocation on the observation of ``tick`` reads; those that never came are left out."""
        return self._sampling.read(self._frames, self._sampling.num_seen(self._num_demo, tick))

    def num_missing(self, tick: int) -> int:
        """Pictures that it should read and that never came."""
        return len(self._sampling.indices(self._sampling.num_seen(self._num_demo, tick))) - len(self.at(tick))
