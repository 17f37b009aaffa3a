"""``make kitchen``: RoboCasa-DC's experiment at laptop size on the six goal sets, in slices of some minutes (`slices`).

    python -m benchmarks.kitchen_policy --folder KITCHEN_DIR --minutes 150

Pairs are collected, one hand is trained for all sets, PONDER learns to say what demonstrations show, three rows go on
from these two, and each is played in the test scenes, once. ``pp-tables`` counts whose goal was done.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.policy_weights import require_committed
from benchmarks.slices import Stage, account, run_stages
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.training import kitchen_recipes as recipes
from protocol.command_line import command, parse

EPISODES, TEST_SCENES = 200, 50
ROWS = (recipes.kitchen_words, recipes.kitchen, recipes.kitchen_observation)
CONDITIONS = {
    "words": (recipes.kitchen_words, "--subgoal-text", "simple"),
    "observation": (recipes.kitchen_observation, "--pictures", "without-cue"),
    "pair": (recipes.kitchen,),
    "pair_null": (recipes.kitchen, "--cognition", "null"),
    "pair_retold": (recipes.kitchen, "--pictures", "retold"),
    "pair_last_frame": (recipes.kitchen, "--pictures", "last-frame"),
}
"""What is played: the row, and what its plays are given."""
WEIGHTS = Path("benchmarks/reports/kitchen_weights.json")


@dataclass(frozen=True, slots=True, kw_only=True)
class KitchenPolicyOptions:
    """Runs a slice of the kitchen's experiment, from where the last one ended (exit code 3: there is more)."""

    folder: Path
    """Where data, checkpoints and the account of hours are kept, outside of the checkout."""
    minutes: float = 150.0
    """Length of this slice."""


@command("kitchen-policy")
def main(argv: list[str] | None = None) -> int:
    options = parse(KitchenPolicyOptions, argv, prog="kitchen-policy")
    folder = options.folder.resolve()
    weights = [_row(folder, row.__name__) for row in ROWS]
    code = run_stages(
        stages(folder), folder, options.minutes, lambda: require_committed(weights, folder, weights=WEIGHTS)
    )
    sys.stdout.write(account(folder))
    return code


def stages(folder: Path) -> tuple[Stage, ...]:
    """The stages in their order; each reads what those before it wrote."""
    data, hand, watching = folder / "data", folder / "hand", folder / "watching"
    training = ("dual_system.training.train", "--no-progress", "--picture-store", f"{folder / 'pictures'}")
    training += ("--data", f"{data}")
    rows = [
        (
            *training,
            *("--frozen-features", "--recipe", row.__name__, "--out", f"{_row(folder, row.__name__)}"),
            *("--ponder", f"{watching / 'ponder'}", "--pounce", f"{hand / 'pounce'}"),
        )
        for row in ROWS
    ]
    pictures = ("--demonstration-hz", "1", "--invocation-hz", "10", "--no-progress")
    collecting = ("dual_system.data.kitchen", "--tasks", *GOAL_SETS, "--episodes", f"{EPISODES}", *pictures)
    return (
        Stage(name="data", commands=((*collecting, "--out", f"{data}"),)),
        Stage(
            name="hand and watching",
            commands=(
                (*training, "--recipe", recipes.kitchen_hand.__name__, "--out", f"{hand}"),
                (*training, "--recipe", recipes.kitchen_watching.__name__, "--out", f"{watching}"),
            ),
        ),
        Stage(name="rows", commands=tuple(rows)),
        Stage(name="test", commands=tuple(_plays(folder)), is_test=True),
    )


def _plays(folder: Path) -> Iterator[tuple[str, ...]]:
    scenes = ("--tasks", *GOAL_SETS, "--episodes", f"{TEST_SCENES}", "--runs", "1", "--split", "test")
    for name, (recipe, *given) in CONDITIONS.items():
        row = _row(folder, recipe.__name__)
        models = ("--pounce-checkpoint", f"{row / 'pounce'}")
        if recipe is recipes.kitchen:
            models += ("--ponder-checkpoint", f"{row / 'ponder'}")
        played = ("--query-period-ms", "0", "--max-steps", "1000", *models, *given)
        yield "sim_client.evaluate", "--out", f"{folder / 'test' / name}", *scenes, *played


def _row(folder: Path, recipe: str) -> Path:
    return folder / "rows" / recipe


if __name__ == "__main__":
    sys.exit(main())
