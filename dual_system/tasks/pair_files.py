"""``pp-collect pairs``: collects a dataset of counterfactual pairs; and its reader.

A folder holds ``pairs.json`` and one ``.npz`` file per pair. The index has the rate of the videos' frames and one entry
per pair: everything of `Pair` that is not an array, and the name of its file. The file has these arrays, where a camera
is ``front`` or ``wrist``:

    now/<camera>                  (image_px, image_px, 3) uint8   the present, the same for both branches
    now/state                     (8,) float32
    <branch>/<camera>             (T, image_px, image_px, 3) uint8   the past at 1 Hz; before it the conditioning video
    <branch>/state                (T, 8) float32
    <branch>/step                 (T,) int64   control steps since reset, or frames since the video began
    <branch>/is_demonstration     (T,) bool
    <branch>/oracle               (20, 8) float32   what the task's script does next; the answer

where a branch is ``own`` or ``twin``. `dual_system.analysis.counterfactual` scores a policy's answers.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from dual_system.tasks.environment import IMAGE_PX, make_environment
from dual_system.tasks.pairs import Pair, Telling, find_pair
from dual_system.tasks.seeds import scenes, seeds_from
from dual_system.tasks.task import make_task, task_names
from protocol import files
from protocol.command_line import command, parse

INDEX = "pairs.json"
SCHEMA = "ponderpounce-pairs/1"
_KIND = "index of pp-collect pairs"

_BRANCHES = ("own", "twin")
_ARRAYS = {"frames", "state"}


@dataclass(frozen=True, slots=True, kw_only=True)
class PairsOptions:
    """Collects counterfactual pairs: two pasts of one present, after which the oracle acts differently."""

    family: Literal["counting", "permanence", "reference", "imitation"]
    """Family of tasks; its tasks take turns."""
    out: Path
    """Folder of the new dataset."""
    pairs: int = 100
    """Number of pairs."""
    tasks: tuple[str, ...] = ()
    """Names of tasks of the family. Empty: all that can be forked."""
    split: Literal["demo", "development", "rollouts"] | None = None
    """Split of the scenes (docs/evaluation.md). None: that of --seed."""
    seed: int | None = None
    """Seed of the first scene of every task. None: the first of the split, without one 0."""
    image_px: int = IMAGE_PX
    """Side of the pictures in pixels (paper and benchmark: 256)."""
    demo_hz: Literal[1, 2, 4, 5, 10, 20] = 1
    """Rate in Hz of the conditioning video's frames, as the PONDER to be scored was trained on."""
    demo_to_its_end: bool = False
    """Take the video's last frame as well."""
    max_seeds: int = 300
    """Number of seeds in a row without a pair after which a task is left out, and named."""

    @property
    def seeds(self) -> range:
        """Seeds to try, to the end of their split's range. Raises SeedError if they are of a split for measurements."""
        return seeds_from(scenes(1, split=self.split, seed=self.seed)[0])

    def __post_init__(self) -> None:
        _ = self.seeds


def write_pair(pair: Pair, folder: Path) -> dict[str, Any]:
    """Writes a pair's arrays and returns its entry of the index."""
    file = f"{pair.task}_{pair.seed:06d}_{pair.variant}.npz"
    arrays: dict[str, NDArray[Any]] = {f"now/{camera}": frame for camera, frame in pair.frames.items()}
    arrays["now/state"] = pair.state
    entry = {"file": file} | {
        field.name: getattr(pair, field.name)
        for field in dataclasses.fields(Pair)
        if field.name not in {*_ARRAYS, *_BRANCHES}
    }
    for branch in _BRANCHES:
        telling: Telling = getattr(pair, branch)
        arrays |= {f"{branch}/{camera}": frames for camera, frames in telling.frames.items()}
        arrays[f"{branch}/state"], arrays[f"{branch}/step"] = telling.states, telling.steps
        arrays[f"{branch}/is_demonstration"], arrays[f"{branch}/oracle"] = telling.is_demonstration, telling.oracle
        entry[branch] = {"subgoal": telling.subgoal, "reasoning": telling.reasoning}
    with files.writing(folder / file):
        np.savez_compressed(folder / file, **arrays)  # type: ignore[arg-type]  # its stubs take allow_pickle for one
    return entry


def write_index(
    entries: list[dict[str, Any]], folder: Path, *, demo_hz: int = 1, demo_to_its_end: bool = False
) -> None:
    """Replaces the index in one go."""
    partial = folder / f"{INDEX}.partial"
    index = {"schema": SCHEMA, "demo_hz": demo_hz, "demo_to_its_end": demo_to_its_end, "pairs": entries}
    with files.writing(folder / INDEX):
        partial.write_text(json.dumps(index, indent=1) + "\n")
        partial.replace(folder / INDEX)


def read_pairs(folder: Path) -> Iterator[Pair]:
    """Yields the pairs of a folder in the index's order, reading lazily.

    Raises OSError without an index, and FileError for one or a pair that is not what it should be.
    """
    return (_read_pair(entry, folder) for entry in _index(folder)["pairs"])


def demo_sampling_of(folder: Path) -> tuple[int, bool]:
    """Returns the rate in Hz of a folder's video frames, and whether the last one is added. Raises as `read_pairs`."""
    index = _index(folder)
    return index["demo_hz"], index["demo_to_its_end"]


def _index(folder: Path) -> dict[str, Any]:
    index = files.read_json(folder / INDEX, _KIND)
    with files.reading(folder / INDEX, _KIND):
        if index["schema"] != SCHEMA:
            raise ValueError(f"schema {index['schema']!r}, expected {SCHEMA!r}")
        return {"demo_hz": int(index["demo_hz"]), "demo_to_its_end": bool(index["demo_to_its_end"])} | {
            "pairs": [dict(entry) for entry in index["pairs"]]
        }


def _read_pair(entry: dict[str, Any], folder: Path) -> Pair:
    with files.reading(folder / INDEX, _KIND):
        path = folder / entry["file"]
        texts = {branch: entry[branch] for branch in _BRANCHES}
    arrays = files.read_npz(path, "pair of pp-collect pairs")
    with files.reading(path, f"pair as {INDEX} describes it"):
        branches: dict[str, Any] = {branch: _telling(branch, texts[branch], arrays) for branch in _BRANCHES}
        plain = {name: value for name, value in entry.items() if name not in {"file", *_BRANCHES}}
        return Pair(**plain, frames=_pictures("now", arrays), state=arrays["now/state"], **branches)


def _telling(branch: str, texts: dict[str, str], arrays: dict[str, NDArray[Any]]) -> Telling:
    return Telling(
        frames=_pictures(branch, arrays),
        states=arrays[f"{branch}/state"],
        steps=arrays[f"{branch}/step"],
        is_demonstration=arrays[f"{branch}/is_demonstration"],
        oracle=arrays[f"{branch}/oracle"],
        **texts,
    )


def _pictures(part: str, arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[np.uint8]]:
    named = ((name.removeprefix(f"{part}/"), array) for name, array in arrays.items() if name.startswith(f"{part}/"))
    return {camera: array for camera, array in named if array.dtype == np.uint8}


def _pairs_of(task: str, options: PairsOptions) -> Generator[Pair]:
    """Yields the pairs of one task, seed by seed, until ``max_seeds`` in a row have none or the split's range ends."""
    with (
        make_environment(task, image_px=options.image_px) as own,
        make_environment(task, render=False) as other,
    ):
        num_barren = 0
        for seed in options.seeds:
            pair = find_pair(own, other, task, seed, demo_hz=options.demo_hz, demo_to_its_end=options.demo_to_its_end)
            num_barren = 0 if pair else num_barren + 1
            if pair:
                yield pair
            if num_barren >= options.max_seeds:
                return


@command("pp-collect pairs")
def main(argv: list[str] | None = None, prog: str = "pp-collect pairs") -> int:
    options = parse(PairsOptions, argv, prog=prog)
    if (options.out / INDEX).exists():
        sys.stderr.write(f"{prog}: {options.out} holds pairs already; give another --out\n")
        return 2
    tasks = options.tasks or tuple(
        name for name in task_names() if make_task(name).family == options.family and make_task(name).can_be_forked()
    )
    strangers = [name for name in tasks if make_task(name).family != options.family]
    if strangers:
        sys.stderr.write(f"{prog}: {', '.join(strangers)}: not of the {options.family} family\n")
        return 2
    if not tasks:
        sys.stderr.write(f"{prog}: no task of the {options.family} family can be forked; see docs/tasks.md\n")
        return 2
    files.folder(options.out)
    entries: list[dict[str, Any]] = []
    sources = {task: _pairs_of(task, options) for task in tasks}
    with tqdm(total=options.pairs, unit="pair", disable=None) as bar:
        while sources and len(entries) < options.pairs:
            for task in list(sources)[: options.pairs - len(entries)]:
                pair = next(sources[task], None)
                if pair is None:
                    del sources[task]
                    sys.stderr.write(
                        f"{prog}: {task} has no pair in the next {options.max_seeds} seeds of the split; left out\n"
                    )
                    continue
                entries.append(write_pair(pair, options.out))
                bar.update()
    for source in sources.values():
        source.close()  # frees its cameras
    write_index(entries, options.out, demo_hz=options.demo_hz, demo_to_its_end=options.demo_to_its_end)
    sys.stdout.write(f"{len(entries)} pairs of {options.family}: {options.out / INDEX}\n")
    return 0 if len(entries) == options.pairs else 1


if __name__ == "__main__":
    sys.exit(main())
