"""A PONDER for episodes in which POUNCE reads none of it: it keeps the schedule and needs no model.

The episode is the same as with a real PONDER, tick for tick.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from protocol import messages as m
from protocol.files import read_object
from protocol.link import Link
from sim_client.ponder_double import Answer, PonderDouble


class NullPonder(PonderDouble):
    """Answers every query at once, with zeros.

    Args:
        num_carriers, hidden_size: K and H of what POUNCE would read.
    """

    def __init__(self, link: Link, num_carriers: int, hidden_size: int) -> None:
        self._vector = np.zeros((num_carriers, hidden_size), np.float32)
        super().__init__(link)

    @property
    def model_hash(self) -> str:
        return "null"

    @property
    def is_fake(self) -> bool:
        return False  # POUNCE receives none of its vectors, so there is nothing to warn of

    def shape(self) -> tuple[int, int]:
        num_carriers, hidden_size = self._vector.shape
        return num_carriers, hidden_size

    def answer(self, query: m.Query) -> Answer:
        return Answer(vector=self._vector, is_transition=False, norm=0.0)

    def end(self) -> None:
        pass


def hears_ponder(pounce: Path) -> bool:
    """Whether a POUNCE folder's network reads cognition or text. Raises ValueError if the folder is none of ours."""
    num_carriers, _ = cognition_shape(pounce)
    return num_carriers > 0 or bool(read_object(pounce / "config.json")["config"].get("reads_subgoal", False))


def cognition_shape(pounce: Path) -> tuple[int, int]:
    """Returns (K, H) of the cognition that a POUNCE folder reads. Raises ValueError if it is none of ours."""
    path = pounce / "config.json"
    try:
        cognition = json.loads(path.read_text())["config"]["cognition"]
        return int(cognition["num_carriers"]), int(cognition["cognition_size"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} does not say what cognition it reads ({error}); give a folder of pp-train") from None
