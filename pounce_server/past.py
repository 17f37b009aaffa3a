"""The observations behind a policy's window: exactly those of its ticks, or another tick's, marked as padding. Pure.

One of these belongs to one robot's episode; another episode has another one.
"""

# T instants of a window, P measured numbers

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from model_server.rendezvous import KEEP_OBSERVATIONS
from pounce_server.contract import Window
from protocol import images
from protocol.errors import MalformedMessage
from protocol.messages import Floats, Observation, ObservationWindow

V = TypeVar("V")
Pictures = tuple[NDArray[np.uint8], ...]


class Past:
    """The newest observations of an episode by tick, as many as a window reaches back."""

    def __init__(self, window: ObservationWindow) -> None:
        self._window = window
        self._keep = window.reach_ticks + KEEP_OBSERVATIONS
        self._states: OrderedDict[int, Floats] = OrderedDict()
        self._pictures: OrderedDict[int, Observation] = OrderedDict()

    def on_observation(self, observation: Observation) -> None:
        """Keeps its state, and its pictures if it has some: a tick may have been shown without them."""
        _put(self._states, observation.tick, observation.proprio, self._keep)
        if observation.images:
            _put(self._pictures, observation.tick, observation, self._keep)

    def window_at(self, tick: int) -> Window:
        """The window whose present is ``tick``, an observation that is here.

        A tick that was never captured, or whose observation was lost, is the newest one before it; if there is none,
        as before an episode's first tick, the first one after it. Both are marked.

        Raises:
            MalformedMessage: the present has a frame that is no picture.
        """
        views_T: list[Pictures] = []
        is_video_padded_T = []
        if self._pictures:
            opened = {tick: _opened(self._pictures[tick])}
            for offset in self._window.video_ticks:
                wanted = tick + offset
                found = next(each for each in _nearest(self._pictures, wanted, tick) if self._is_open(each, opened))
                views_T.append(opened[found])
                is_video_padded_T.append(found != wanted)
        states_T, is_state_padded_T = [], []
        for offset in self._window.state_ticks:
            found = next(iter(_nearest(self._states, tick + offset, tick)))
            states_T.append(self._states[found])
            is_state_padded_T.append(found != tick + offset)
        return Window(
            frames=tuple(zip(*views_T, strict=True)),
            states_TP=np.stack(states_T),
            is_video_padded_T=np.array(is_video_padded_T, np.bool_),
            is_state_padded_T=np.array(is_state_padded_T, np.bool_),
        )

    def _is_open(self, tick: int, opened: dict[int, Pictures]) -> bool:
        """Whether ``opened`` has the pictures of ``tick`` afterwards: those of the past that are none count as lost."""
        if tick not in opened:
            try:
                opened[tick] = _opened(self._pictures[tick])
            except MalformedMessage:
                return False
        return True


def _put(kept: OrderedDict[int, V], tick: int, value: V, keep: int) -> None:
    kept[tick] = value
    while len(kept) > keep:
        kept.popitem(last=False)


def _nearest(kept: Mapping[int, object], wanted: int, present: int) -> Sequence[int]:
    """The kept ticks up to the present: ``wanted``, then those before it, newest first, then those after it."""
    ticks = sorted(tick for tick in kept if tick <= present)
    return [tick for tick in reversed(ticks) if tick <= wanted] + [tick for tick in ticks if tick > wanted]


def _opened(observation: Observation) -> Pictures:
    return tuple(images.unpack(image) for image in observation.images)
