"""The vision tower over as many pictures as queries bring, captured: its hundreds of small launches take a GPU's host
longer than a fire's forward takes the GPU. Openings bring other numbers, which are not captured.

# N pictures
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dual_system.models.gpu import send
from dual_system.models.graphs import Capture, Work
from dual_system.models.ponder.network import Ponder
from ponder_server.captured import check_captured


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """Static buffers of one number of pictures, and the replay over them."""

    pictures_NHW3: Tensor
    tokens: Tensor
    replay: Work


class Eyes:
    """The vision tower of one network."""

    def __init__(self, ponder: Ponder) -> None:
        self._ponder = ponder
        self._capture: Capture | None = None
        self._looks: dict[int, _Look] = {}

    def capture(self, capture: Capture) -> None:
        """Turns on capturing, by :meth:`prepare`. What is captured keeps its weights: replace none afterwards."""
        self._capture = capture

    def prepare(self, num_pictures: int, *, max_rows: int) -> None:
        """Captures the pictures of 1 to ``max_rows`` queries, each of ``num_pictures``; nothing without
        :meth:`capture`.

        Raises RuntimeError if a replay differs from the same work run directly.
        """
        if self._capture is None:
            return
        for num_rows in range(max_rows, 0, -1):  # the largest first: the others reuse its memory in the pool
            count = num_rows * num_pictures
            if count not in self._looks:
                self._looks[count] = self._look(count, self._capture)

    def __call__(self, pictures_NHW3: Tensor) -> Tensor:
        """Vision tokens of pictures on the host, as ``Ponder.image_features``; the next call may overwrite them."""
        look = self._looks.get(len(pictures_NHW3))
        if look is None:
            return self._ponder.image_features(pictures_NHW3.to(self._ponder.device))
        send(pictures_NHW3, look.pictures_NHW3)
        look.replay()
        return look.tokens

    def _look(self, count: int, capture: Capture) -> _Look:
        ponder = self._ponder
        noise = torch.randint(256, (count, *ponder.image_px, 3), generator=torch.Generator().manual_seed(0))
        pictures_NHW3 = noise.to(ponder.device, torch.uint8)
        tokens = torch.empty_like(ponder.image_features(pictures_NHW3))

        def work() -> None:
            tokens.copy_(ponder.image_features(pictures_NHW3))

        replay = capture(work)
        tokens.fill_(float("nan"))  # capturing may have run the work
        replay()
        replayed = tokens.clone()
        work()
        check_captured(replayed, tokens, "vision towers change their tokens")
        return _Look(pictures_NHW3, tokens, replay)
