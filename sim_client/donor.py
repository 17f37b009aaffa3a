"""PONDER's stand-in that gives the cognition of another episode: what did POUNCE take from the vectors themselves?

Query t of this episode is answered with the vector, and the gate, that PONDER gave at query t of a recorded *donor*: an
episode of the same task and difficulty, in another scene. Everything else is this episode's own: pictures, instruction,
schedule, and the age, counted from this episode's query. Beyond the donor's last query its last vector is given again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from clock.membership import Membership
from protocol import messages as m
from protocol import topics
from protocol.errors import ProtocolError
from protocol.heartbeat import Heartbeat
from protocol.link import Link, is_of_episode
from protocol.mcap_log import EpisodeRecord, read_log
from protocol.process import host_clock_id
from protocol.version import version

Key = tuple[str, int, int]  # task, run, seed


class DonorError(ValueError):
    """There is no cognition to give: the message says what is missing and the way out."""


class DonorPonder:
    """A PONDER on a bus without a model. ``step`` answers what is asked and says whether anything was."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._heartbeat = Heartbeat(link, version(), host_clock_id())
        self._membership = Membership(link, self._heartbeat, self._open, lambda: None)
        self._queries = link.subscribe(topics.QUERY)
        self._donor: list[m.Cognition] = []
        self._heartbeat.set(state=m.ServingState.READY, progress=1.0)

    def load(self, path: Path) -> None:
        """Takes the donor of the next episode.

        Raises:
            DonorError: the log cannot be read, or there is no cognition in it.
        """
        try:
            record = read_log(path)
        except (OSError, ProtocolError) as error:
            raise DonorError(f"{path}: not the log of a donor: {error}") from error
        self.take(record, str(path))

    def take(self, record: EpisodeRecord, name: str) -> None:
        """As `load`, of a log that was read."""
        self._donor = sorted(record.cognitions, key=lambda cognition: cognition.query)
        if not self._donor:
            raise DonorError(f"{name}: no cognition in it; donors are logs of the real PONDER, of pp-eval --record")

    def step(self) -> bool:
        self._heartbeat.beat()
        worked = self._membership.step()
        for query in self._queries.drain():
            if is_of_episode(self._link, query.header):
                self._answer(query)
                worked = True
        return worked

    def _answer(self, query: m.Query) -> None:
        has_ended = query.query >= len(self._donor)
        given = self._donor[-1 if has_ended else query.query]
        now_ns = time.monotonic_ns()
        cognition = m.Cognition(
            query=query.query,
            tick=query.tick,
            source_ns=query.source_ns,
            ready_ns=now_ns,
            vector=given.vector,
            is_transition=given.is_transition and not has_ended,
            norm=given.norm,
            model_hash=self._hash,
            is_fake=given.is_fake,
        )
        self._link.publish(topics.COGNITION, cognition, at_ns=now_ns, clock_id=host_clock_id())

    def _open(self, request: m.OpenRequest) -> m.Contract:
        if not self._donor:
            raise DonorError("no donor was taken for this episode")
        num_carriers, hidden_size = self._donor[0].vector.shape
        return m.Contract(
            proc="ponder",
            num_carriers=num_carriers,
            hidden_size=hidden_size,
            model_hash=self._hash,
            is_fake=self._donor[0].is_fake,
            version=version(),
        )

    @property
    def _hash(self) -> str:
        """Says in every log whose vectors these were."""
        return f"{self._donor[0].model_hash} in {self._donor[0].header.episode}"


def donors_in(folder: Path, keys: Iterable[Key]) -> dict[Key, Path]:
    """Chooses for each episode the log of another one: the next seed of its task, run and difficulty, cyclically.

    Args:
        folder: of a recorded evaluation over the same scenes.

    Raises:
        DonorError: no such folder, an episode is not in it or was not recorded, or there is no other one.
    """
    path = folder / "results.json"
    try:
        lines: list[dict[str, Any]] = json.loads(path.read_text())["episodes"]
    except (OSError, ValueError, KeyError) as error:
        raise DonorError(f"{path} is no results file ({error}); --donors takes the --out of pp-eval --record") from None
    known = {(line["task"], line.get("run", 0), line["seed"]): line for line in lines}
    chosen: dict[Key, Path] = {}
    for task, run, seed in keys:
        own = known.get((task, run, seed))
        if own is None:
            raise DonorError(f"{path} has no {task} seed {seed} run {run}: record the same scenes and runs there first")
        alike = [(t, r, s) for t, r, s in known if (t, r) == (task, run) and s != seed]
        alike = [key for key in alike if known[key]["difficulty"] == own["difficulty"]]
        if not alike:
            raise DonorError(f"{path} has no other {own['difficulty']} episode of {task}, run {run}: --episodes more")
        donor = known[min(alike, key=lambda key: (key[2] <= seed, key[2]))]
        if not donor["mcap"]:
            raise DonorError(f"{path} was not recorded; --donors takes the --out of pp-eval --record")
        chosen[task, run, seed] = folder / donor["mcap"]
    return chosen
