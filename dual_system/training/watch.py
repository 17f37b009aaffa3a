"""What a run shows while it goes: a log, what PONDER says beside what it should, and TensorBoard if asked for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import numpy as np
from torch import Tensor

from dual_system.models.ponder.context import IGNORE, Row
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.training.trainer import StepReport, Trainer

LOG_FILE, SAMPLES_FILE, BOARD_FOLDER = "log.jsonl", "samples.jsonl", "tensorboard"
_TAGS = {
    "loss/total": "total",
    "loss/flow_matching": "flow_matching",
    "loss/grounding": "grounding",
    "loss/alignment": "alignment",
    "loss/placing": "placing",
    "gradient/norm": "gradient_norm",
    "batch/supervised_tokens": "num_supervised",
    "batch/null_invocations": "num_null",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """A supervised stretch of a row, control tokens included by name."""

    wanted: str
    said: str
    """The likeliest token at each place, each after the right ones before it (teacher-forced): what the gradient sees,
    not what free decoding would have written."""


class Watch:
    """Writes the files of a run. Lines of steps that a resumed run will do again are dropped first."""

    def __init__(self, out: Path, *, first_step: int, sample_every: int, tensorboard: bool) -> None:
        """Raises ValueError if TensorBoard is asked for and not installed."""
        self._sample_every = sample_every
        self._board: Any = _board(out / BOARD_FOLDER, first_step) if tensorboard else None
        self._log = _cut(out / LOG_FILE, first_step)
        self._samples = _cut(out / SAMPLES_FILE, first_step)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._log.close()
        self._samples.close()
        if self._board is not None:
            self._board.close()

    def step(self, report: StepReport, trainer: Trainer) -> None:
        """After every update."""
        facts = asdict(report)
        self._log.write(json.dumps(facts) + "\n")
        if self._board is not None:
            for tag, name in _TAGS.items():
                self._board.add_scalar(tag, facts[name], report.step)
        if report.step % self._sample_every == 0:
            self._show(report.step, trainer)

    def flush(self) -> None:
        """Before a checkpoint: what it stands on is on disk."""
        for file in (self._log, self._samples):
            file.flush()

    def _show(self, step: int, trainer: Trainer) -> None:
        episodes, said_N = trainer.latest
        if not episodes.rows:  # a stage without PONDER
            return
        row, frames = episodes.rows[0], episodes.frames[0]
        samples = samples_of(row, said_N, trainer.model.ponder.format.vocabulary)
        for sample in samples:
            self._samples.write(json.dumps({"step": step} | asdict(sample), ensure_ascii=False) + "\n")
        if self._board is None:
            return
        text = "\n\n".join(f"wanted: {sample.wanted}\n\nsaid: {sample.said}" for sample in samples)
        self._board.add_text("ponder/said", text, step)
        if frames is not None:
            self._board.add_image("ponder/last_picture", frames[-1].cpu().numpy(), step, dataformats="HWC")


def samples_of(row: Row, said_N: Tensor, vocabulary: Vocabulary) -> list[Sample]:
    """The row's supervised stretches, each told once.

    Args:
        said_N: the likeliest ids at the batch's supervised places, this row's first (``JointLoss.said_N``).
    """
    places = np.flatnonzero(np.asarray(row.targets) != IGNORE)
    said = said_N[: len(places)].tolist()
    if not len(said):
        return []
    found: dict[Sample, None] = {}
    starts = [0, *(np.flatnonzero(np.diff(places) > 1) + 1).tolist(), len(places)]
    for start, stop in pairwise(starts):
        wanted = vocabulary.decode([row.targets[place] for place in places[start:stop].tolist()])
        found[Sample(wanted=wanted, said=vocabulary.decode(said[start:stop]))] = None
    return list(found)


def _cut(path: Path, step: int) -> TextIO:
    """The file, open at its end, with the lines of earlier steps only."""
    if path.exists():
        lines: Sequence[str] = path.read_text().splitlines(keepends=True)
        path.write_text("".join(line for line in lines if line.endswith("\n") and json.loads(line)["step"] < step))
    return path.open("a")


def _board(folder: Path, first_step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError("--tensorboard needs TensorBoard: pip install tensorboard (extra `train`)") from error
    return SummaryWriter(str(folder), purge_step=first_step)
