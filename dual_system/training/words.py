"""``pp-diagnose words``: how well a PONDER's texts fit episodes that it was not trained on, before there is any POUNCE.

Its row has the recorded texts, so each token is predicted behind the right ones. A PONDER that has learned its training
scenes by heart has a loss near zero there and says wrong places here: every cognition of such a PONDER is lost work.
"""

# T tokens of a row, N of them supervised, V vocabulary

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from tqdm import tqdm

from dual_system.analysis.markdown import markdown
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.models.ponder.context import Row
from dual_system.models.ponder.coordinates import XY_1000
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.training.collate import collate_ponder
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.diagnose import EVERY_INVOCATION, in_turns
from dual_system.training.example import make_example
from dual_system.training.joint import encode_rows
from dual_system.training.watch import supervised_spans
from protocol import files
from protocol.command_line import On, command, parse

ABOUT = """\
Teacher-forced, once a second. *Told apart*: whether something new is to be said. *Right*: each token of a text is the
most likely one; *but for places*: each that is no place. *Places*: each that the episode's texts have not had before,
since one that was read can be copied. *Off*: a place's distance from the right one, in % of the picture's side."""

_NEAR = 40
"""Distance up to which a place counts as found, in thousandths of the picture's side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WordsOptions:
    """Measures a PONDER's texts on episodes that it was not trained on."""

    ponder: tuple[Path, ...]
    """PONDER checkpoints."""
    data: Path
    """Folder of pp-collect or pp-export, with other seeds than the training data's."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks to measure on. Empty: all of the data."""
    episodes: int = 80
    """Largest number of episodes, the tasks taking turns."""
    out: Path | None = None
    """Folder for words.md, which is printed in any case."""
    progress: On = True
    """Do not show a progress bar."""


@dataclass(slots=True)
class Found:
    """What one PONDER said of one task, over all its episodes."""

    loss: list[float] = field(default_factory=list)
    """Cross-entropy of every supervised token [nats]."""
    is_told_apart: list[bool] = field(default_factory=list)
    is_right: list[bool] = field(default_factory=list)
    is_right_but_places: list[bool] = field(default_factory=list)
    off: list[float] = field(default_factory=list)
    """Distance of every place that is new to its row, in thousandths of the picture's side."""

    def add(self, row: Row, logits_NV: torch.Tensor, vocabulary: Vocabulary) -> None:
        """Adds an episode: its row, and logits at the row's `supervised_index`."""
        targets_N = torch.from_numpy(np.asarray(row.targets)[row.supervised_index + 1])
        self.loss += F.cross_entropy(logits_NV.float(), targets_N, reduction="none").tolist()
        predicted = logits_NV.argmax(dim=-1).tolist()
        read: set[tuple[str, str]] = set()
        for begin, end in supervised_spans(row):
            wanted, said = targets_N[begin:end].tolist(), predicted[begin:end]
            self.is_told_apart.append(wanted[0] == said[0])
            if len(wanted) > 1:
                self.is_right.append(wanted == said)
                wanted_text, said_text = vocabulary.decode(wanted), vocabulary.decode(said)
                self.is_right_but_places.append(XY_1000.sub("", wanted_text) == XY_1000.sub("", said_text))
                for pair in zip(XY_1000.findall(wanted_text), XY_1000.findall(said_text), strict=False):
                    if pair[0] not in read:
                        read.add(pair[0])
                        self.off.append(float(np.hypot(*np.subtract(*np.array(pair, int)))))


@command("pp-diagnose words")
def main(argv: list[str] | None = None, prog: str = "pp-diagnose words") -> int:
    options = parse(WordsOptions, argv, prog=prog)
    rows = [
        [folder.resolve().parent.name, task, *_cells(found)]
        for folder in options.ponder
        for task, found in measure(folder, options).items()
    ]
    head = ["PONDER of", "task", "nats a token", "told apart, %", "texts", "right, %", "right but for places, %"]
    head += ["places", "off, %: median, p90", f"at most {_NEAR / 10:.0f} % off, %"]
    table = f"{ABOUT}\n\n{markdown(head, rows)}\n"
    if options.out is not None:
        with files.writing(options.out):
            files.folder(options.out)
            (options.out / "words.md").write_text(table)
    sys.stdout.write(table)
    return 0


@torch.inference_mode()
def measure(folder: Path, options: WordsOptions) -> dict[str, Found]:
    """Returns what was found, by task.

    Raises:
        DatasetError, FileNotFoundError, ValueError: the inputs do not fit together; the message says why.
    """
    ponder = load_ponder(folder)
    if not ponder.format.speaks:
        raise ValueError(f"{folder} was trained with w2 = 0: it has no words to measure")
    sizes = PictureSizes.of(ponder.format, None)
    data = TrainingSet(options.data, tasks=options.tasks, sizes=sizes, demo_hz=ponder.format.demonstrations.hz)
    found: dict[str, Found] = {}
    chosen = in_turns([task for task, _ in data.names], options.episodes)
    for number in tqdm(chosen, unit="episode", disable=not options.progress):
        example = make_example(data[number], ponder.format, EVERY_INVOCATION, np.random.default_rng(0))
        episode = collate_ponder([example])
        for row, hidden_TH in zip(episode.rows, encode_rows(ponder, episode), strict=True):
            if len(places := row.supervised_index):
                of_task = found.setdefault(data.names[number][0], Found())
                of_task.add(row, ponder.logits(hidden_TH[places]), ponder.format.vocabulary)
    return dict(sorted(found.items()))


def _cells(found: Found) -> Sequence[str]:
    def share(of: Sequence[bool]) -> str:
        return f"{100 * np.mean(of):.1f}" if of else ""

    off = " ".join(f"{each / 10:.1f}" for each in np.quantile(found.off, (0.5, 0.9))) if found.off else ""
    told = [f"{np.mean(found.loss):.3f}", share(found.is_told_apart), f"{len(found.is_right)}", share(found.is_right)]
    near = share([each <= _NEAR for each in found.off])
    return [*told, share(found.is_right_but_places), f"{len(found.off)}", off, near]


if __name__ == "__main__":
    sys.exit(main())
