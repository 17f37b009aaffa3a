"""Which frames of a demonstration PONDER reads: as in its training, so its checkpoint declares them.

PONDER's contract carries the declaration, and the robot's side samples the video accordingly.
"""

from __future__ import annotations

from dataclasses import dataclass

FASTEST_HZ = 20
"""Frame rate of demonstration videos."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoSampling:
    """Sampling of a demonstration; the default is the paper's (B.1).

    Raises:
        ValueError: ``hz`` does not divide 20, or no view is left.
    """

    hz: int = 1
    """Frames per second, from the first one on; a divisor of 20."""
    to_its_end: bool = False
    """Also sample the last frame: a movement often ends between two samples."""
    num_views: int | None = None
    """Views of each instant that PONDER reads, the first of the robot's cameras (1: front only); None: all."""

    def __post_init__(self) -> None:
        if self.hz < 1 or FASTEST_HZ % self.hz:
            raise ValueError(f"hz must divide {FASTEST_HZ}, came {self.hz}")
        if self.num_views is not None and self.num_views < 1:
            raise ValueError(f"num_views must be at least 1, or None for all; came {self.num_views}")

    def indices(self, num_frames: int, video_hz: int = FASTEST_HZ) -> list[int]:
        """Indices of the sampled frames of a video of ``num_frames``, each the first that is not before its instant."""
        last = num_frames - 1
        sampled = list(dict.fromkeys(-(-at * video_hz // self.hz) for at in range(last * self.hz // video_hz + 1)))
        return [*sampled, last] if self.to_its_end and sampled and sampled[-1] != last else sampled


PAPER_SAMPLING = DemoSampling()
