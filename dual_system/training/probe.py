"""``pp-diagnose probe``: what a linear reader finds in C and in what a frame memory is read for.

PONDER reads recorded episodes as served, with its own texts, and its cognition is taken at every query, once a second.
A POUNCE with a frame memory acts at the same instants; what its layers' attention reads from the memory in the first
flow step is taken, averaged over the rows of the chunk. `dual_system.analysis.probe` probes both.
"""

# I instants of an episode, D features

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from clock.reference import Ready, Reference
from clock.sampling import SampledInvocation, SampledQuery, SampledSchedule
from dual_system.analysis.probe import ABOUT, Array, Instants, probe_table
from dual_system.data.dataset import Dataset, Entry
from dual_system.data.episode import Rows
from dual_system.data.video import FPS
from dual_system.models.pi05.pounce import Pounce, PounceInputs
from dual_system.models.ponder.coordinates import YX_PX
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle
from dual_system.models.pounce.family import sampling_of
from dual_system.training.collate import collate_pounce
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.diagnose import in_turns
from dual_system.training.example import Example
from protocol import files
from protocol.command_line import On, command, parse


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeOptions:
    """Probes what C and a frame memory's read-out hold, on episodes that nothing was trained on."""

    data: Path
    """Folder of pp-collect or pp-export, with other seeds than the training data's."""
    ponder: tuple[Path, ...] = ()
    """PONDER checkpoints, for their C."""
    pounce: tuple[Path, ...] = ()
    """POUNCE checkpoints with a frame memory, for its read-out."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks to probe on. Empty: all of the data."""
    episodes: int = 160
    """Largest number of episodes, the tasks taking turns."""
    out: Path | None = None
    """Folder for probe.md, which is printed in any case."""
    progress: On = True
    """Do not show a progress bar."""


@command("pp-diagnose probe")
def main(argv: list[str] | None = None, prog: str = "pp-diagnose probe") -> int:
    options = parse(ProbeOptions, argv, prog=prog)
    if not options.ponder and not options.pounce:
        raise ValueError("nothing to probe: give checkpoints with --ponder, --pounce, or both")
    table = f"{ABOUT}\n\n{probe_table(instants(options))}"
    if options.out is not None:
        with files.writing(options.out):
            files.folder(options.out)
            (options.out / "probe.md").write_text(table)
    sys.stdout.write(table)
    return 0


def instants(options: ProbeOptions) -> dict[str, Instants]:
    """What was to be done and what each model held, by task."""
    dataset = Dataset(options.data)
    entries = [each for each in dataset.episodes if each.is_success and each.task in (options.tasks or {each.task})]
    if not entries:
        raise ValueError(f"{options.data} has no successful episode of {', '.join(options.tasks) or 'any task'}")
    chosen = [entries[number] for number in in_turns([each.task for each in entries], options.episodes)]
    readers = {name: _cognition_of(folder) for name, folder in _named("C of", options.ponder).items()}
    readers |= {name: _read_out_of(folder, options) for name, folder in _named("memory of", options.pounce).items()}
    found: dict[str, list[tuple[Array, dict[str, Array]]]] = {}
    for entry in tqdm(chosen, unit="episode", disable=not options.progress):
        rows = dataset.rows(entry.index)
        held = {name: read(dataset, entry) for name, read in readers.items()}
        found.setdefault(entry.task, []).append((_wanted(rows, entry.num_demonstration_rows), held))
    return {task: _joined(each) for task, each in found.items()}


Read = Callable[[Dataset, Entry], Array]
"""Features (I, D) of an episode, once a second."""


def _named(what: str, folders: Sequence[Path]) -> Mapping[str, Path]:
    return {f"{what} {folder.resolve().parent.name}": folder for folder in folders}


def _joined(episodes: Sequence[tuple[Array, dict[str, Array]]]) -> Instants:
    wanted_N5 = np.concatenate([wanted for wanted, _ in episodes])
    lengths = [len(wanted) for wanted, _ in episodes]
    return Instants(
        episode_N=np.repeat(np.arange(len(episodes)), lengths),
        second_N=wanted_N5[:, 0].astype(np.int64),
        place_N2=wanted_N5[:, 1:3],
        stage_N=wanted_N5[:, 3].astype(np.int64),
        count_N=wanted_N5[:, 4].astype(np.int64),
        held={name: np.concatenate([held[name] for _, held in episodes]) for name in episodes[0][1]},
    )


def _wanted(rows: Rows, start: int) -> Array:
    """Second, place's y and x, stage and count, (I, 5), of the subgoal in force at each query."""
    texts, begins_T = rows.grounded_subgoal[start:], rows.is_transition[start:]
    begun: list[str] = []
    found = []
    for tick, (text, begins) in enumerate(zip(texts, begins_T.tolist(), strict=True)):
        if begins or not tick:
            begun.append(text.partition(" ")[0])
        if tick % FPS == 0:
            place = YX_PX.search(text)
            y_px, x_px = (np.nan, np.nan) if place is None else (int(place[1]), int(place[2]))
            found.append((tick // FPS, y_px, x_px, len(begun), begun[:-1].count(begun[-1])))
    return np.array(found, np.float64)


def _cognition_of(folder: Path) -> Read:
    # Servers stand above training, so only this command, when it runs, knows one.
    read, spec = importlib.import_module("ponder_server.in_process").build_reader(folder)
    sampling: DemoSampling = spec.demonstrations

    def cognition(dataset: Dataset, entry: Entry) -> Array:
        rows, start = dataset.rows(entry.index), entry.num_demonstration_rows
        demo, asked = sampling.indices(start, FPS), list(range(start, entry.num_rows, FPS))
        if not rows.is_rendered[demo].all():
            raise ValueError(
                f"{dataset.root}: {folder} reads demonstrations {sampling.hz} times a second, and that of "
                f"{entry.task} {entry.seed} was rendered less often; collect with --demonstration-hz {sampling.hz}"
            )
        views = list(dataset.views(entry, [*demo, *asked]))
        answers = read(entry.instruction, views[: len(demo)], views[len(demo) :], rows.state[asked])
        return np.stack(answers).reshape(len(asked), -1).astype(np.float64)

    return cognition


def _read_out_of(folder: Path, options: ProbeOptions) -> Read:
    bundle = load_bundle(folder)
    config = bundle.model.config
    if (sampling := sampling_of(config)) is None:
        raise ValueError(f"{folder} has no frame memory, so nothing is read from one; give PONDER's with --ponder")
    sizes, hz = PictureSizes.of(None, config), sampling.demonstrations.hz
    data = TrainingSet(options.data, tasks=options.tasks, sizes=sizes, demo_hz=hz)
    number = {name: place for place, name in enumerate(data.names)}

    def read_out(_: Dataset, entry: Entry) -> Array:
        episode = data[number[entry.task, entry.seed]]
        stamps = [Ready(query=query, source_ns=0, ready_ns=0) for query in range(-(-episode.num_ticks // FPS))]
        queries = tuple(SampledQuery(tick=each.query * FPS, stamp=each) for each in stamps)
        asked = tuple(
            SampledInvocation(tick=each.tick, now_ns=0, reference=Reference(query=each.stamp.query, age_ns=0))
            for each in queries
        )
        schedule = SampledSchedule(queries=queries, invocations=asked)
        example = Example(
            episode=episode,
            rows=(),
            images=None,
            schedule=schedule,
            invocations=asked,
            written=(),
            told=("",) * len(asked),
        )
        return read_outs(bundle, example)

    return read_out


@torch.inference_mode()
def read_outs(bundle: PounceBundle, example: Example) -> Array:
    """What each layer reads from the frame memory at every invocation, (I, D), on one draw of noise."""
    model = bundle.model.eval()
    inputs = collate_pounce([example], model.config, bundle.tokenizer, bundle.statistics).inputs
    if not isinstance(model, Pounce) or not isinstance(inputs, PounceInputs) or model.frame_memory is None:
        raise ValueError("expected a POUNCE with a frame memory")
    read: list[Tensor] = []
    hooks = [
        layer.attn.o_proj.register_forward_hook(lambda _, __, read_INE: read.append(read_INE.mean(dim=1)))
        for layer in model.frame_memory.layers
    ]
    try:
        shape = (1, model.config.horizon, model.config.padded_action_dim)
        noise_1NA = torch.randn(shape, generator=torch.Generator().manual_seed(0))
        next(model.sample(inputs, noise_1NA.expand(len(example.invocations), -1, -1), model.step_table()))
    finally:
        for hook in hooks:
            hook.remove()
    found: NDArray[np.float64] = torch.cat(read[: len(hooks)], dim=1).double().numpy()
    return found


if __name__ == "__main__":
    sys.exit(main())
