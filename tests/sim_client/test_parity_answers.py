"""``pp-parity answers``: the first difference is named where it was put, and an age that nobody reads shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_client.parity_answers import AGES_NS, AnswersOptions, differences, effects, stored_episode

OPTIONS = AnswersOptions(episode=Path("e"), ponder=Path("a"), pounce=Path("b"), out=Path("o"))


def answers(num: int = 3) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    made: dict[str, Any] = {name: rng.normal(size=(num, 20, 8)).astype(np.float32) for name in AGES_NS}
    return made | {
        "num_tokens": np.arange(num + 1),
        "is_transition": np.zeros(num, bool),
        "texts": np.array([""] * num),
        "cognition": rng.normal(size=(num, 1, 8)).astype(np.float32),
    }


def changed(name: str, index: int, value: Any) -> dict[str, Any]:
    made = answers()
    array = made[name].astype("<U9") if name == "texts" else made[name].copy()
    array[index] = value
    return made | {name: array}


def test_equal_answers_agree() -> None:
    assert not list(differences(answers(), answers(), OPTIONS))


@pytest.mark.parametrize(
    ("ours", "said"),
    [
        (changed("num_tokens", 0, 9), "opening: expected 0 tokens, came 9"),
        (changed("num_tokens", 2, 9), "query 1: num_tokens: expected 2, came 9"),
        (changed("is_transition", 1, True), "query 1: is_transition: expected False, came True"),
        (changed("texts", 2, "pick"), "query 2: texts: expected , came pick"),
        (changed("cognition", 1, 0.0), "query 1: cognition: relative L2 difference 1.00e+00"),
        (changed("cognition", 1, np.nan), "query 1: cognition: relative L2 difference nan"),
        (changed("rows_null", 2, np.nan), "invocation 2: rows_null: largest difference nan"),
        (answers(2), r"num_tokens: expected shape (4,), came (3,)"),
    ],
)
def test_the_difference_is_named_where_it_is(ours: dict[str, Any], said: str) -> None:
    assert next(differences(answers(), ours, OPTIONS)) == said


def test_an_age_that_is_not_read_shows() -> None:
    made = answers() | {"rows_old": answers()["rows"]}
    assert effects(made)["age"] == 0.0
    assert effects(made)["null"] > 0.0


@pytest.mark.sim
def test_an_episode_is_stored_as_the_script_plays_it() -> None:
    episode = stored_episode("PickHighlight", seed=0, seconds=1)
    assert episode["frames"].shape == (1, 2, 256, 256, 3)
    assert (episode["states"].shape, episode["demo"].shape) == ((1, 8), (0, 2, 256, 256, 3))
    assert str(episode["instruction"])


@pytest.mark.sim
@pytest.mark.slow
def test_an_episode_that_succeeds_sooner_than_asked_for_ends_there() -> None:
    episode = stored_episode(OPTIONS.task, OPTIONS.seed, OPTIONS.seconds)
    assert 1 < len(episode["frames"]) == len(episode["states"]) < OPTIONS.seconds
