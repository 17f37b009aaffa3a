"""How a demonstration is sampled for PONDER: as it was in training, so a part of its checkpoint.

PONDER says it in its contract, and the robot's side samples the video so.
"""

from __future__ import annotations

from dataclasses import dataclass

FASTEST_HZ = 20
"""Frame rate of demonstration videos."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Showing:
    """Which frames of a demonstration are shown; the default is the paper's (B.1).

    Raises:
        ValueError: ``hz`` does not divide 20.
    """

    hz: int = 1
    """Frames a second, from the first one on; a divisor of 20."""
    to_its_end: bool = False
    """Also the last frame, whenever it is: a movement often ends between two samples."""

    def __post_init__(self) -> None:
        if self.hz < 1 or FASTEST_HZ % self.hz:
            raise ValueError(f"hz must divide {FASTEST_HZ}, came {self.hz}")

    def looks(self, num_frames: int, video_hz: int = FASTEST_HZ) -> list[int]:
        """Indices of the frames that are shown of a video of ``num_frames``; ``hz`` divides ``video_hz``."""
        every, last = video_hz // self.hz, num_frames - 1
        looks = [*range(0, num_frames, every)]
        return [*looks, last] if self.to_its_end and looks and looks[-1] != last else looks


AS_IN_THE_PAPER = Showing()


def declared(directory):  # type: ignore  # TEMPORARY until the contract says it
    import json

    from dual_system.models.config_json import from_json

    path = None if directory is None else directory / "ponder.json"
    if path is None or not path.is_file():
        return AS_IN_THE_PAPER
    return from_json(Showing, json.loads(path.read_text()).get("demonstrations", {}), str(path))
