"""A PONDER that answers with another episode's cognition: what does POUNCE take from the vectors themselves?

Query t of this episode is answered with the vector, and the gate, that PONDER gave at query t of a recorded *donor*: an
episode of the same task and difficulty, in another scene. Everything else is this episode's own: pictures, instruction,
schedule, and the age, counted from this episode's query. Beyond the donor's last query its last vector is repeated.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from protocol import files
from protocol import messages as m
from protocol.errors import ProtocolError
from protocol.link import Link
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.ponder_double import Answer, PonderDouble

Key = tuple[str, int, int]  # task, run, seed


class DonorError(ValueError):
    """There is no cognition to answer with; the message says what is missing, and the way out."""


class SwappedPonder(PonderDouble):
    """Answers with recorded cognition."""

    def __init__(self, link: Link) -> None:
        self._donor: list[m.Cognition] = []
        super().__init__(link)

    def load(self, path: Path) -> None:
        """Loads the donor of the next episode.

        Raises:
            DonorError: the log cannot be read, or there is no cognition in it.
        """
        try:
            record = read_log(path)
        except (OSError, ProtocolError) as error:
            raise DonorError(f"{path}: not the log of a donor: {error}") from error
        self.take(record, str(path))

    def take(self, record: EpisodeRecord, name: str) -> None:
        """Like `load`, from a log that is already read."""
        self._donor = sorted(record.cognitions, key=lambda cognition: cognition.query)
        if not self._donor:
            raise DonorError(f"{name}: no cognition in it; donors are logs of the real PONDER, of pp-eval --record")

    def answer(self, query: m.Query) -> Answer:
        has_ended = query.query >= len(self._donor)
        given = self._donor[-1 if has_ended else query.query]
        return Answer(
            vector=given.vector,
            is_transition=given.is_transition and not has_ended,
            norm=given.norm,
            text=given.text or "",
            text_age_ns=given.source_ns - given.text_source_ns if given.text else 0,
            gate_score=None if has_ended else given.gate_score,
        )

    def end(self) -> None:
        """Keeps the donor: it may be queried again."""

    def shape(self) -> tuple[int, int]:
        if not self._donor:
            raise DonorError("no donor was taken for this episode")
        num_carriers, hidden_size = self._donor[0].vector.shape
        return num_carriers, hidden_size

    @property
    def model_hash(self) -> str:
        return f"{self._donor[0].model_hash} in {self._donor[0].header.episode}"

    @property
    def is_fake(self) -> bool:
        return self._donor[0].is_fake


def donors_in(folder: Path, keys: Iterable[Key]) -> dict[Key, Path]:
    """Chooses for each episode the log of another one: the next seed of its task, run and difficulty, cyclically.

    Args:
        folder: of a recorded evaluation over the same scenes.

    Raises:
        OSError, FileError: the folder's results cannot be read.
        DonorError: there are none, an episode is not in it or was not recorded, or there is no other one.
    """
    path = folder / "results.json"
    kind = "results file of pp-eval --record"
    if not path.exists():
        raise DonorError(f"{path} is not there; --donors takes the --out of pp-eval --record")
    found = files.read_json(path, kind)
    with files.reading(path, kind):
        recorded = {
            (line["task"], line.get("run", 0), line["seed"]): (line["difficulty"], str(line["mcap"] or ""))
            for line in found["episodes"]
        }
    chosen: dict[Key, Path] = {}
    for task, run, seed in keys:
        if (task, run, seed) not in recorded:
            raise DonorError(f"{path} has no {task} seed {seed} run {run}: record the same scenes and runs there first")
        difficulty, _ = recorded[task, run, seed]
        alike = [(t, r, s) for t, r, s in recorded if (t, r) == (task, run) and s != seed]
        alike = [key for key in alike if recorded[key][0] == difficulty]
        if not alike:
            raise DonorError(f"{path} has no other {difficulty} episode of {task}, run {run}: --episodes more")
        _, log = recorded[min(alike, key=lambda key: (key[2] <= seed, key[2]))]
        if not log:
            raise DonorError(f"{path} was not recorded; --donors takes the --out of pp-eval --record")
        chosen[task, run, seed] = folder / log
    return chosen
