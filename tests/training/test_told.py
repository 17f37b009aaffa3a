"""What a hand is told while it learns to obey texts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import ROBOMME
from dual_system.models.ponder.context import ContextFormat
from dual_system.models.ponder.coordinates import yx_px_from_xy_1000
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.told import Told

TEXT = "pick up the red cube at [438, 512]"
EXACT = Told(grounded=1.0, simple=0.0)


def draws(told: Told, count: int = 4000) -> list[str]:
    rng = np.random.default_rng(0)
    return [told.draw(TEXT, rng) for _ in range(count)]


def test_without_any_jitter_the_text_is_told_as_it_is() -> None:
    assert set(draws(EXACT, 20)) == {TEXT}
    assert set(draws(Told(grounded=0.0, simple=1.0), 20)) == {"pick up the red cube"}
    assert set(draws(Told(grounded=0.0, simple=0.0), 20)) == {""}


def test_the_shares_are_those_that_were_asked_for() -> None:
    counts = Counter(draws(Told(grounded=0.5, simple=0.3)))
    assert counts[TEXT] == pytest.approx(2000, abs=130)
    assert counts["pick up the red cube"] == pytest.approx(1200, abs=120)
    assert counts[""] == pytest.approx(800, abs=110)


def test_a_share_of_the_places_is_far_off_in_every_direction_and_the_rest_is_near() -> None:
    told = Told(grounded=1.0, simple=0.0, jitter_px=0.5, far_share=0.25, far_px=12.0)
    y_px, x_px = yx_px_from_xy_1000((438, 512))
    moves = []
    for text in draws(told):
        x, y = text.rpartition("[")[2].rstrip("]").split(", ")
        there = yx_px_from_xy_1000((int(x), int(y)))
        moves.append((there[0] - y_px, there[1] - x_px))
    far = np.array([move for move in moves if np.hypot(*move) > 6])
    assert len(far) == pytest.approx(1000, abs=100)
    assert np.hypot(*far.T).mean() == pytest.approx(12, abs=0.3)
    assert np.abs(far.mean(axis=0)).max() < 1.2


@given(seed=st.integers(0, 2**32 - 1))
def test_a_text_without_a_place_stays_without_one(seed: int) -> None:
    told = Told(grounded=1.0, simple=0.0, jitter_px=30.0)
    assert told.draw("press the button", np.random.default_rng(seed)) == "press the button"


@pytest.mark.parametrize("wrong", [{"grounded": 0.7, "simple": 0.4}, {"grounded": -0.1}, {"jitter_px": -1.0}])
def test_shares_that_are_none_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="shares are at least 0"):
        Told(**{"grounded": 0.5, "simple": 0.5, **wrong})


MakeEpisode = Callable[..., TrainingEpisode]
FORM = ContextFormat(vocabulary=Vocabulary.tiny(), num_carriers=1, first_carrier_id=448, image_grid=(1, 1), token_px=32)
PLAIN = ExampleConfig(clocks=ROBOMME, max_invocations=8)


@pytest.fixture
def recorded(episode_of_noise: MakeEpisode) -> TrainingEpisode:
    return episode_of_noise(300, changes=(0, 120))


def seen(recorded: TrainingEpisode, config: ExampleConfig, seed: int = 0) -> Example:
    return make_example(recorded, FORM, config, np.random.default_rng(seed))


def test_exact_telling_is_what_ponder_wrote(recorded: TrainingEpisode) -> None:
    plain, told = seen(recorded, PLAIN), seen(recorded, replace(PLAIN, told=EXACT))
    assert plain.told == told.told
    queries = [each.reference.query for each in plain.invocations]
    assert plain.told == tuple("" if query is None else plain.written[query] for query in queries)


def test_a_hand_sees_branch_points_more_often_by_the_weight_it_was_given(recorded: TrainingEpisode) -> None:
    def share(weight: float) -> float:
        ticks = [
            each.tick
            for seed in range(150)
            for each in seen(recorded, replace(PLAIN, branch_weight=weight, max_invocations=1), seed).invocations
        ]
        return float(np.mean([tick < 30 or 120 <= tick < 150 for tick in ticks]))

    assert share(1.0) == pytest.approx(0.2, abs=0.1)
    assert share(4.0) == pytest.approx(0.5, abs=0.13)
