"""PONDER's stand-in that knows the task: what does the hand alone make of perfect cognition?

Every query is answered with the simulator's own subgoal of that instant, as the numbers that a POUNCE trained by itself
has learned to act from (`dual_system.training.stand_in`, stage ``motor`` of the recipe ``small``). To any other POUNCE
they mean nothing. Told places can be made as wrong as a PONDER's are: the hand then misses as it would with one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from dual_system.training.countdown import is_waiting, stood_at, told_until
from dual_system.training.places import misplaced
from dual_system.training.stand_in import stand_in

from protocol import messages as m
from protocol import topics
from protocol.link import Link, is_of_episode
from sim_client.puppet import Answer, PuppetPonder

HELD_QUERIES = 4


class ToldPonder(PuppetPonder):
    """Answers with the stand-in of the task's grounded subgoal in the observation that is asked about.

    Args:
        num_carriers, hidden_size: K and H of what POUNCE reads.
        noise_px: standard deviation of the error of every told coordinate; it stays for `HELD_QUERIES` queries.
        onward: says where the next subgoal will be (`Environment.onward`); None: POUNCE is not told.
        due_step: says when what is waited for is to begin (`Environment.due_step`); it is then told how long there is
            to wait, as examples tell it (`countdown`).
        waits_longer: control steps that are added to it.
    """

    def __init__(
        self,
        link: Link,
        num_carriers: int,
        hidden_size: int,
        noise_px: float = 0.0,
        onward: Callable[[], str] | None = None,
        due_step: Callable[[], int | None] | None = None,
        waits_longer: int = 0,
    ) -> None:
        self._onward = onward
        self._due_step = due_step
        self._waits_longer = waits_longer
        self._noise_px = noise_px
        self._shape = num_carriers, hidden_size
        self._subgoals = link.subscribe(topics.SUBGOAL)
        self._heard: list[tuple[int, str]] = []
        self._begun: list[int] = []
        super().__init__(link)

    def answer(self, query: m.Query) -> Answer:
        for subgoal in self._subgoals.drain():
            if not is_of_episode(self.link, subgoal.header):
                continue
            if subgoal.kind == m.SubgoalKind.TASK_GROUNDED:
                self._heard.append((subgoal.tick, subgoal.text))
            else:
                self._begun.append(subgoal.tick)  # the plain text is said when a subgoal begins, and at no other time
        # it answers when a cognition is due, and has heard by then what the picture that is asked about does not show
        is_new = any(tick <= query.tick for tick in self._begun)
        self._begun = [tick for tick in self._begun if tick > query.tick]
        text, onward = self._told(query)
        num_carriers, size = self._shape
        vector = np.repeat(stand_in(text, size, self.instruction, onward)[None], num_carriers, axis=0)
        return Answer(vector=vector, is_transition=is_new, norm=float(np.linalg.norm(vector)))

    def _told(self, query: m.Query) -> tuple[str, str]:
        """The subgoal in force, and a second place."""
        due = None if self._due_step is None else self._due_step()
        left = 0 if due is None else due + self._waits_longer - query.tick
        heard = [text for tick, text in self._heard if tick <= query.tick and (left <= 0 or is_waiting(text))]
        text = heard[-1] if heard else ""
        stood = stood_at(heard)[-1] if heard else ""
        second = stood or ("" if self._onward is None else self._onward())
        if self._noise_px:
            draw = query.query // HELD_QUERIES
            text, second = (mistold(each, self._noise_px, draw) for each in (text, second))
        return told_until(text, second, left) if left > 0 else (text, second)

    def shape(self) -> tuple[int, int]:
        return self._shape

    def end(self) -> None:
        self._heard.clear()
        self._begun.clear()

    @property
    def model_hash(self) -> str:
        return f"stand-in {hashlib.blake2b(repr(self._shape).encode(), digest_size=4).hexdigest()}"

    @property
    def is_fake(self) -> bool:
        return True


def mistold(text: str, noise_px: float, draw: int) -> str:
    """Returns the text with an error in each of its coordinates, which the text and the number of the draw decide."""
    digest = hashlib.blake2b(f"{draw} {text}".encode(), digest_size=8).digest()
    return misplaced(text, noise_px, np.random.default_rng(int.from_bytes(digest, "big")))


def cognition_shape(pounce: Path) -> tuple[int, int]:
    """Returns (K, H) that a POUNCE folder reads. Raises ValueError if it is none of ours."""
    path = pounce / "config.json"
    try:
        cognition = json.loads(path.read_text())["config"]["cognition"]
        return int(cognition["num_carriers"]), int(cognition["cognition_size"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} does not say what cognition it reads ({error}); give a folder of pp-train") from None
