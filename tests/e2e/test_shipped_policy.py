"""The policy in the repository: trained, small enough, and it is its memory that does the task."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from dual_system.models.ponder.checkpoint import load_ponder, weights_hash
from dual_system.models.pounce.checkpoint import load_bundle

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"
SHIPPED = CHECKPOINTS / "small"
NUM_SCENES, FIRST_SEED = 3, 100_000
MOST_BYTES = 20_000_000


def test_it_is_trained() -> None:
    assert not load_ponder(SHIPPED / "ponder").is_random
    bundle = load_bundle(SHIPPED / "pounce")
    assert not bundle.is_random
    assert not bundle.has_fresh_prefix


def test_the_pair_is_small_and_the_only_one() -> None:
    assert [path.name for path in CHECKPOINTS.iterdir()] == [SHIPPED.name]
    files = [path for system in ("ponder", "pounce") for path in (SHIPPED / system).iterdir()]
    assert sum(path.stat().st_size for path in files) < MOST_BYTES


@pytest.mark.parametrize("name", ["real", "real60", "null", "other"])
def test_its_results_are_of_these_weights(name: str) -> None:
    episodes = json.loads((SHIPPED / "results" / name / "results.json").read_text())["episodes"]
    pounces = {episode["models"]["pounce"]["model_hash"] for episode in episodes}
    ponders = {episode["models"]["ponder"]["model_hash"].partition(" ")[0] for episode in episodes}
    assert pounces == {load_bundle(SHIPPED / "pounce").digest()}
    assert ponders == {weights_hash(load_ponder(SHIPPED / "ponder"))}


@pytest.mark.slow
@pytest.mark.e2e
def test_it_picks_what_was_highlighted_and_without_cognition_it_does_not(
    evaluate_here: Callable[[Sequence[str]], int], tmp_path: Path
) -> None:
    """Three easy scenes that nothing was chosen by. Rounding differs between machines, so the bar is low."""
    solved = {}
    for cognition in ("real", "null"):
        out = tmp_path / cognition
        arguments = (
            f"--ponder-checkpoint {SHIPPED / 'ponder'} --pounce-checkpoint {SHIPPED / 'pounce'} --tasks PickHighlight "
            f"--difficulty easy --episodes {NUM_SCENES} --seed {FIRST_SEED} --runs 1 --max-steps 300 "
            f"--cognition {cognition} --no-progress --out {out}"
        )
        assert evaluate_here(arguments.split()) == 0
        results = json.loads((out / "results.json").read_text())
        solved[cognition] = sum(episode["success"] for episode in results["episodes"])
    assert solved["real"] >= 2
    assert solved["null"] <= 1  # one of three cubes is the right one: a guess that presses and lifts may hit
    assert solved["null"] < solved["real"]
