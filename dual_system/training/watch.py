"""Monitoring of a run: a log, samples of PONDER's predicted texts beside their targets, and optionally TensorBoard."""

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
from protocol import files

LOG_FILE, SAMPLES_FILE, BOARD_FOLDER = "log.jsonl", "samples.jsonl", "tensorboard"
_KIND = "log of pp-train"
_TAGS = {
    "loss/total": "total",
    "loss/flow_matching": "flow_matching",
    "loss/grounding": "grounding",
    "gradient/norm": "gradient_norm",
    "batch/supervised_tokens": "num_supervised",
    "batch/null_invocations": "num_null",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """A supervised span of a row as text, with control tokens by name."""

    target: str
    """The targets."""
    predicted: str
    """The most likely token at each position under teacher forcing; free decoding could differ."""


class Watch:
    """Writes a run's log and samples. Lines from ``first_step`` on, which a resumed run repeats, are removed first."""

    def __init__(self, out: Path, *, first_step: int, sample_every: int, tensorboard: bool) -> None:
        """Raises ValueError if ``tensorboard`` is True and TensorBoard is not installed."""
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
        """Logs one update; call it after every update."""
        facts = asdict(report)
        self._log.write(json.dumps(facts) + "\n")
        if self._board is not None:
            for tag, name in _TAGS.items():
                self._board.add_scalar(tag, facts[name], report.step)
        if report.step % self._sample_every == 0:
            self._show(report.step, trainer)

    def flush(self) -> None:
        """Flushes the files; call it before a checkpoint, so that the log covers all its steps."""
        for file in (self._log, self._samples):
            file.flush()

    def _show(self, step: int, trainer: Trainer) -> None:
        episodes, predicted_N = trainer.latest
        if not episodes.rows:  # PONDER is not run
            return
        row, frames = episodes.rows[0], episodes.frames[0]
        samples = samples_of(row, predicted_N, trainer.model.ponder.format.vocabulary)
        for sample in samples:
            self._samples.write(json.dumps({"step": step} | asdict(sample), ensure_ascii=False) + "\n")
        if self._board is None:
            return
        text = "\n\n".join(f"target: {sample.target}\n\npredicted: {sample.predicted}" for sample in samples)
        self._board.add_text("ponder/text", text, step)
        if frames is not None:
            self._board.add_image("ponder/last_picture", frames[-1].cpu().numpy(), step, dataformats="HWC")


def samples_of(row: Row, predicted_N: Tensor, vocabulary: Vocabulary) -> list[Sample]:
    """The row's distinct supervised spans. ``predicted_N``: see `JointLoss`; this row's positions come first."""
    targets = [target for target in row.targets if target != IGNORE]
    predicted = predicted_N[: len(targets)].tolist()
    found: dict[Sample, None] = {}
    for start, stop in supervised_spans(row) if predicted else ():
        target = vocabulary.decode(targets[start:stop])
        found[Sample(target=target, predicted=vocabulary.decode(predicted[start:stop]))] = None
    return list(found)


def supervised_spans(row: Row) -> list[tuple[int, int]]:
    """Where each run of neighbouring targets begins and ends, among the row's supervised tokens."""
    places = row.supervised_index
    return [*pairwise([0, *(np.flatnonzero(np.diff(places) > 1) + 1).tolist(), len(places)])] if len(places) else []


def _cut(path: Path, step: int) -> TextIO:
    """Opens the file for appending, with only the lines of earlier steps kept."""
    if path.exists():
        lines: Sequence[str] = files.read_text(path, _KIND).splitlines(keepends=True)
        with files.reading(path, _KIND):
            kept = "".join(line for line in lines if line.endswith("\n") and json.loads(line)["step"] < step)
        with files.writing(path):
            path.write_text(kept, encoding="utf-8")
    return path.open("a", encoding="utf-8")


def _board(folder: Path, first_step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError("--tensorboard needs TensorBoard: pip install tensorboard (extra `train`)") from error
    return SummaryWriter(str(folder), purge_step=first_step)
