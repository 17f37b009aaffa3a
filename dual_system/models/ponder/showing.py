"""How a demonstration is shown to a PONDER: what it has learned from, so part of its checkpoint.

The robot's side shows it, and asks the checkpoint how (`declared`); torch is not needed for that.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from dual_system.models.config_json import from_json

OWN_NAME = "ponder.json"
_FIELD = "demonstrations"
_FASTEST_HZ = 20  # of the videos


@dataclass(frozen=True, slots=True, kw_only=True)
class Showing:
    """How a demonstration is shown; by default as the paper does (B.1)."""

    hz: int = 1
    """Frames a second, from the first one on; a divisor of 20."""
    to_its_end: bool = False
    """The last frame, too, whenever it is: a movement often ends between two looks."""

    def __post_init__(self) -> None:
        if self.hz < 1 or _FASTEST_HZ % self.hz:
            raise ValueError(f"hz must divide {_FASTEST_HZ}, came {self.hz}")

    def looks(self, num_frames: int, video_hz: int = _FASTEST_HZ) -> list[int]:
        """Which frames of a video of so many are shown; ``hz`` divides ``video_hz``."""
        every, last = video_hz // self.hz, num_frames - 1
        looks = [*range(0, num_frames, every)]
        return [*looks, last] if self.to_its_end and looks and looks[-1] != last else looks


AS_IN_THE_PAPER = Showing()


def declared(directory: Path | None) -> Showing:
    """What the PONDER of a checkpoint folder has learned from; the paper's way without one, and where it does not say.

    Raises ValueError if its ponder.json says nothing that can be read.
    """
    path = None if directory is None else directory / OWN_NAME
    if path is None or not path.is_file():
        return AS_IN_THE_PAPER
    try:
        values = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is no JSON: {error}") from error
    said = values.get(_FIELD) if isinstance(values, dict) else None
    return AS_IN_THE_PAPER if said is None else from_json(Showing, said, f"{path}: {_FIELD}")
