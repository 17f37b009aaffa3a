"""The policy in the repository: trained, small enough, and it is its memory that does the task."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.models.pounce.checkpoint import load_bundle
from dual_system.models.specialty import specialist_for
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.task import make_task, task_names
from sim_client import evaluate

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"
SHIPPED = CHECKPOINTS / "small"
NUM_SCENES, FIRST_SEED = 6, 100_000
MOST_BYTES = 20_000_000


@pytest.mark.parametrize("name", ["small", "several"])
def test_it_is_trained(name: str) -> None:
    assert not load_ponder(CHECKPOINTS / name / "ponder").is_random
    bundle = load_bundle(CHECKPOINTS / name / "pounce")
    assert not bundle.is_random
    assert not bundle.has_fresh_prefix


def test_each_pair_is_small() -> None:
    pairs = [folder.parent for folder in CHECKPOINTS.glob("*/ponder")]
    assert len(pairs) == 2
    for pair in pairs:
        files = [path for system in ("ponder", "pounce") for path in (pair / system).iterdir()]
        assert sum(path.stat().st_size for path in files) < MOST_BYTES


def test_who_knows_several_tasks_was_told_of_them_in_few_words() -> None:
    """Without pieces of their own its texts would take half as many tokens again."""
    vocabulary = load_ponder(CHECKPOINTS / "several" / "ponder").format.vocabulary
    old = load_ponder(SHIPPED / "ponder").format.vocabulary
    text = "pick up the container at [334, 646] that hides the red cube"
    assert vocabulary.decode(vocabulary.encode(text)) == text
    assert len(vocabulary.encode(text)) < 0.75 * len(old.encode(text))
    known = "pick up the first highlighted cube at [441, 430], which is blue"
    assert vocabulary.encode(known) == old.encode(known)


def test_its_specialist_is_for_the_tasks_that_count_and_no_others() -> None:
    specialties = load_ponder(CHECKPOINTS / "several" / "ponder").format.specialties
    counting = {"PickXtimes", "SwingXtimes", "BinFill"}
    for name in task_names():
        task = make_task(name)
        for difficulty, seed in product(DIFFICULTIES, range(8)):
            instruction = task.instruction(task.sample(np.random.default_rng(seed), difficulty))
            assert (specialist_for(specialties, instruction) == "counting") == (name in counting), instruction


@pytest.mark.parametrize("name", ["small", "several"])
def test_both_of_a_pair_are_told_the_fingers_alike(name: str) -> None:
    told = load_ponder(CHECKPOINTS / name / "ponder").format.proprioception
    assert told is not None
    assert told.grip == load_bundle(CHECKPOINTS / name / "pounce").statistics.grip


@pytest.mark.parametrize(("name", "without_fingers"), [("small", set()), ("several", {"PatternLock", "RouteStick"})])
def test_its_results_are_of_this_hand(name: str, without_fingers: set[str]) -> None:
    """Where a robot has no fingers a grip changes nothing, and what was played before there was one is kept."""
    results = json.loads((CHECKPOINTS / name / "results" / "real" / "results.json").read_text())
    hands = {e["models"]["pounce"]["model_hash"] for e in results["episodes"] if e["task"] not in without_fingers}
    assert hands == {load_bundle(CHECKPOINTS / name / "pounce").digest()}


@pytest.mark.slow
@pytest.mark.e2e
def test_it_picks_what_was_highlighted_and_without_cognition_it_does_not(tmp_path: Path) -> None:
    """Six easy scenes that nothing was chosen by. Rounding differs between machines, so the bar is low."""
    solved = {}
    for cognition in ("real", "null"):
        out = tmp_path / cognition
        arguments = (
            f"--ponder-checkpoint {SHIPPED / 'ponder'} --pounce-checkpoint {SHIPPED / 'pounce'} --tasks PickHighlight "
            f"--difficulty easy --episodes {NUM_SCENES} --seed {FIRST_SEED} --runs 1 --max-steps 500 "
            f"--cognition {cognition} --no-progress --out {out}"
        )
        assert evaluate.main(arguments.split()) == 0
        results = json.loads((out / "results.json").read_text())
        solved[cognition] = sum(episode["success"] for episode in results["episodes"])
    assert solved["real"] >= 2
    assert solved["null"] <= 1  # one of three cubes is the right one: a guess that presses and lifts may hit
    assert solved["null"] < solved["real"]
