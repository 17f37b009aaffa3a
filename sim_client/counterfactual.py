"""``pp-diagnose counterfactual``: does a trained pair act on its own past? Both models as served, on recorded pairs.

For each pair of ``pp-collect pairs`` PONDER reads either past and the common present, and POUNCE acts on the cognition:
twice on the same pictures, joints and noise. `dual_system.analysis.counterfactual` compares the actions with the
script's in either branch. PONDER generates its own texts on the way, as in an episode.

Without PONDER, a POUNCE that reads text is told what comes next in either branch: does it heed what it is told?
"""

from __future__ import annotations

import importlib
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco

# isort: split

from clock.timebase import NS_PER_MS
from dual_system.analysis.counterfactual import COUNTERFACTUAL, SCHEMA, follows_own_past, heed
from dual_system.models.ponder.coordinates import normalised_text, without_places
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.tasks.pair_files import demo_sampling_of, read_pairs
from dual_system.tasks.pairs import Pair, Telling
from protocol import files
from protocol.command_line import On, command, flat, parse
from sim_client.config import ModelsOptions
from sim_client.ledger import write_json
from sim_client.panda_robot import CAMERAS

Views = tuple[NDArray[np.uint8], ...]
Floats = NDArray[np.float32]
Read = Callable[[str, Sequence[Views], Sequence[Views], NDArray[np.float32]], Floats]
"""`ponder_server.in_process.build_reader`'s."""
Act = Callable[..., Floats]
"""`pounce_server.in_process.build_actor`'s."""
_MIN_SCALE = 1e-3  # of a dimension that no script moves


@dataclass(frozen=True, slots=True, kw_only=True)
class CounterfactualOptions:
    """Scores how often a trained pair's action follows its own past, on pairs that look the same now."""

    pounce: Path
    """POUNCE's checkpoint, trained with that PONDER."""
    pairs: Path
    """Folder of pp-collect pairs, with pictures and demonstrations as PONDER was trained on."""
    out: Path
    """Folder for counterfactual.json."""
    ponder: Path | None = None
    """PONDER's checkpoint. None: POUNCE is told the subgoal of each branch (--subgoal-text)."""
    subgoal_text: Literal["grounded", "simple"] = "grounded"
    """Text that POUNCE is told without --ponder: with places, or without."""
    draws: int = 4
    """Number of draws of flow noise per pair; each is used in both branches."""
    age_ms: int = 300
    """Age of the present's cognition in ms, given to POUNCE; in an episode it is PONDER's delay (paper: 300)."""
    models: tyro.conf.OmitArgPrefixes[ModelsOptions] = field(default_factory=ModelsOptions)
    progress: On = True
    """Do not show a progress bar."""


@command("pp-diagnose counterfactual")
def main(argv: list[str] | None = None, prog: str = "pp-diagnose counterfactual") -> int:
    options = parse(CounterfactualOptions, argv, prog=prog)
    files.folder(options.out)
    pairs = read_pairs(options.pairs)
    read, specs = None, {}
    if options.ponder is not None:
        read, specs["ponder"] = importlib.import_module("ponder_server.in_process").build_reader(
            options.ponder, **options.models.of_ponder()
        )
        _require_as_in_training(options.pairs, specs["ponder"].demonstrations)
    act, specs["pounce"] = importlib.import_module("pounce_server.in_process").build_actor(
        options.pounce, **options.models.of_pounce()
    )
    if options.ponder is None and not specs["pounce"].reads_subgoal:
        raise ValueError(f"{options.pounce} reads cognition and no text; give its PONDER with --ponder")
    entries = scored(tqdm(pairs, unit="pair", disable=not options.progress), read, act, options)
    models = {name: {"model_hash": spec.model_hash, "is_untrained": spec.is_fake} for name, spec in specs.items()}
    write_json(
        options.out / COUNTERFACTUAL, {"schema": SCHEMA, "config": flat(options), "models": models, "pairs": entries}
    )
    folder = shlex.quote(str(options.out))
    sys.stdout.write(f"{options.out / COUNTERFACTUAL}; tables: pp-tables {folder} --out {folder}\n")
    return 0


def _require_as_in_training(pairs: Path, learned: DemoSampling) -> None:
    hz, to_its_end = demo_sampling_of(pairs)
    found = DemoSampling(hz=hz, to_its_end=to_its_end)
    if (found.hz, found.to_its_end) != (learned.hz, learned.to_its_end):  # views are PONDER's own matter
        way = f"--demo-hz {learned.hz}" + (" --demo-to-its-end" if learned.to_its_end else "")
        raise ValueError(
            f"{pairs} samples demonstrations {_in_words(found)}, and this PONDER was trained on {_in_words(learned)}. "
            f"Make pairs with pp-collect pairs {way}."
        )


def _in_words(sampling: DemoSampling) -> str:
    return f"{sampling.hz} times a second" + (" and at their end" if sampling.to_its_end else "")


def scored(pairs: Iterable[Pair], read: Read | None, act: Act, options: CounterfactualOptions) -> list[dict[str, Any]]:
    """Returns one entry per pair: which it is, its mean score over draws and branches, in [0, 1], and its mean heed.

    Differences of joints and gripper are weighed by their standard deviation over all pairs' scripts.

    Raises:
        ValueError: there are no pairs, or the models do not fit them.
    """
    found, answers, scripts = [], [], []
    for index, pair in enumerate(pairs):
        found.append({"task": pair.task, "seed": pair.seed, "variant": pair.variant, "difficulty": pair.difficulty})
        branches = [_answers(pair, telling, read, act, options, index) for telling in (pair.own, pair.twin)]
        answers.append(np.stack(branches, axis=1))
        scripts.append(np.stack([pair.own.oracle, pair.twin.oracle]))
    if not found:
        raise ValueError(f"{options.pairs} holds no pairs")
    scale = np.maximum(np.concatenate(scripts).reshape(-1, scripts[0].shape[-1]).std(axis=0), _MIN_SCALE)
    for entry, answers_D2HA, script_2HA in zip(found, answers, scripts, strict=True):
        script = np.broadcast_to(script_2HA, answers_D2HA.shape)
        entry["score"] = float(follows_own_past(answers_D2HA, script, scale=scale).mean())
        mean_heed = float(heed(answers_D2HA, script, scale=scale).mean())
        entry["heed"] = None if np.isnan(mean_heed) else mean_heed
    return found


def _answers(
    pair: Pair, telling: Telling, read: Read | None, act: Act, options: CounterfactualOptions, index: int
) -> NDArray[np.float32]:
    """Returns POUNCE's actions after this past, (draws, H, A)."""
    now = tuple(pair.frames[camera] for camera in CAMERAS)
    seeds = range(index * options.draws, (index + 1) * options.draws)
    if read is None:
        told = normalised_text(telling.subgoal)
        told = told if options.subgoal_text == "grounded" else without_places(told)
        return np.stack([act(pair.instruction, now, pair.state, None, 0, seed, told) for seed in seeds])
    past = [tuple(telling.frames[camera][row] for camera in CAMERAS) for row in range(len(telling.steps))]
    demo = [views for views, is_shown in zip(past, telling.is_demonstration, strict=True) if is_shown]
    seen = [views for views, is_shown in zip(past, telling.is_demonstration, strict=True) if not is_shown]
    states = [*telling.states[~telling.is_demonstration], pair.state]
    cognition = read(pair.instruction, demo, [*seen, now], np.stack(states))[-1]
    age_ns = options.age_ms * NS_PER_MS
    return np.stack([act(pair.instruction, now, pair.state, cognition, age_ns, seed) for seed in seeds])


if __name__ == "__main__":
    sys.exit(main())
