"""The counterfactual score: who follows the past scores 1, who contradicts it 0, who ignores it exactly one half."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from dual_system.analysis.counterfactual import follows_own_past, heed, p_own

shapes = st.tuples(st.integers(1, 4), st.just(2), st.integers(1, 3), st.integers(1, 3))
numbers = st.floats(-3, 3, width=32)


def chunks(shape: tuple[int, ...]) -> st.SearchStrategy[np.ndarray]:
    return npst.arrays(np.float32, shape, elements=numbers)


twice = shapes.flatmap(lambda shape: st.tuples(chunks(shape), chunks(shape)))


@given(twice)
def test_who_ignores_the_past_scores_one_half_whatever_it_says(both: tuple[np.ndarray, np.ndarray]) -> None:
    answers, script = both
    same_twice = np.repeat(answers[:, :1], 2, axis=1)
    assert p_own(same_twice, script) == 0.5


@given(twice)
def test_the_score_and_that_of_the_exchanged_answers_make_one(both: tuple[np.ndarray, np.ndarray]) -> None:
    answers, script = both
    np.testing.assert_array_equal(
        follows_own_past(answers, script) + follows_own_past(answers, script[:, ::-1]), np.ones(answers.shape[:2])
    )


@given(shapes.flatmap(chunks))
def test_the_script_follows_itself(script: np.ndarray) -> None:
    is_apart = np.any(script[:, 0] != script[:, 1], axis=(1, 2))
    np.testing.assert_array_equal(follows_own_past(script, script)[is_apart], 1.0)
    np.testing.assert_array_equal(follows_own_past(script[:, ::-1], script)[is_apart], 0.0)
    np.testing.assert_array_equal(follows_own_past(script, script)[~is_apart], 0.5)


@given(twice, st.floats(0.125, 8))
def test_a_common_scale_changes_nothing(both: tuple[np.ndarray, np.ndarray], scale: float) -> None:
    answers, script = both
    scales = np.full(script.shape[3], 2.0 ** round(np.log2(scale)))
    assert p_own(answers, script, scale=scales) == p_own(answers, script)


def test_a_scale_decides_what_counts() -> None:
    """The joint speaks for the own past, the gripper for the other."""
    script = np.array([[[[0.0, -1.0]], [[0.1, 1.0]]]])
    answers = np.array([[[[0.0, 1.0]], [[0.1, -1.0]]]])
    assert p_own(answers, script) == 0.0
    assert p_own(answers, script, scale=[0.01, 1.0]) == 1.0


@pytest.mark.parametrize(
    ("predicted", "script", "scale", "complaint"),
    [
        (np.zeros((1, 2, 3)), np.zeros((1, 2, 3)), None, r"expected \(P, 2, H, A\) twice; got predicted \(1, 2, 3\)"),
        (np.zeros((1, 3, 3, 3)), np.zeros((1, 3, 3, 3)), None, "expected"),
        (np.zeros((1, 2, 3, 8)), np.zeros((2, 2, 3, 8)), None, "expected"),
        (np.full((1, 2, 3, 1), np.nan), np.zeros((1, 2, 3, 1)), None, "must be finite"),
        (np.zeros((1, 2, 3, 2)), np.zeros((1, 2, 3, 2)), [1.0, 0.0], "expected 2 positive scales"),
        (np.zeros((0, 2, 3, 2)), np.zeros((0, 2, 3, 2)), None, "no pairs, no score"),
    ],
)
def test_what_cannot_be_scored_is_refused(
    predicted: np.ndarray, script: np.ndarray, scale: list[float] | None, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        p_own(predicted, script, scale=scale)


@given(twice, st.floats(-2, 2))
def test_heed_is_how_far_the_end_moves_in_units_of_the_script_s(
    both: tuple[np.ndarray, np.ndarray], share: float
) -> None:
    start, script = (each.astype(np.float64) for each in both)
    answers = start.copy()
    answers[:, 1, -1] = start[:, 0, -1] + share * (script[:, 1, -1] - script[:, 0, -1])
    found = heed(answers, script)
    is_apart = np.sum((script[:, 1, -1] - script[:, 0, -1]) ** 2, axis=1) > 1e-6
    np.testing.assert_allclose(found[is_apart], share, atol=1e-6)
    is_alike = np.all(script[:, 1, -1] == script[:, 0, -1], axis=1)
    assert np.isnan(found[is_alike]).all()


@given(twice)
def test_who_ignores_the_past_heeds_nothing(both: tuple[np.ndarray, np.ndarray]) -> None:
    answers, script = both
    found = heed(np.repeat(answers[:, :1], 2, axis=1), script)
    assert np.all((found == 0) | np.isnan(found))


def test_a_move_sideways_is_no_heed() -> None:
    script = np.array([[[[0.0, 0.0]], [[2.0, 0.0]]]])
    answers = np.array([[[[5.0, 5.0]], [[6.0, 9.0]]]])
    assert heed(answers, script).tolist() == [0.5]
