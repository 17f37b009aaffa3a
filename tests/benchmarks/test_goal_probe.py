"""The probe finds a goal that a picture or a number gives away, and none where nothing does."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import goal_probe as module
from benchmarks.goal_probe import row_of
from dual_system.tasks.kitchen.environment import KitchenEnvironment

NUM, WIDTH, GOALS = 300, 629, 4


def starts(leak: float, columns: slice) -> tuple[np.ndarray, np.ndarray]:
    """Starts of noise, in some of whose numbers each goal has a value of its own."""
    rng = np.random.default_rng(0)
    goals = rng.integers(GOALS, size=NUM)
    seen = rng.normal(size=(NUM, WIDTH))
    seen[:, 0] = 1.0  # one that never changes
    seen[:, columns] += leak * rng.normal(size=(GOALS, WIDTH))[goals][:, columns]
    return seen, goals


def test_noise_tells_nothing() -> None:
    row = row_of("set", *starts(0.0, slice(1, WIDTH)), GOALS)
    assert row["above chance"] == "no"
    assert row["chance, %"] == 25.0


@pytest.mark.parametrize(
    ("leak", "columns"),
    [
        (1.0, slice(100, 112)),  # a few pixels
        (5.0, slice(600, 601)),  # one number of state
        (0.5, slice(1, WIDTH)),  # the light, a little everywhere
    ],
)
def test_a_planted_leak_is_found(leak: float, columns: slice) -> None:
    row = row_of("set", *starts(leak, columns), GOALS)
    assert row["above chance"] == "yes"


def test_the_command_fails_where_there_is_a_leak(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for leak, code in ((0.0, 0), (1.0, 1)):
        drawn = row_of("FourKnobs", *starts(leak, slice(100, 112)), GOALS)
        monkeypatch.setattr(module, "probed", lambda name, seeds, drawn=drawn: drawn)
        assert module.main(["--sets", "FourKnobs"]) == code
    assert "| FourKnobs |" in capsys.readouterr().out
    assert module.main(["--sets", "OpenDrawer"]) == 2


@pytest.mark.sim
def test_twins_look_alike_to_it() -> None:
    with KitchenEnvironment("PressOrServe") as environment:
        (first, own), (second, other) = (module.seen_at_first(environment, 0, goal) for goal in (0, 1))
        another, _ = module.seen_at_first(environment, 1)
    assert own != other
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - another).max() > 1
    assert first.shape == (3 * 8 * 8 * 3 + 53,)
