"""Several robots on one engine: each gets what it would get alone, in turn, and nobody pays for another's error."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.contract import ContextFull, Fire, Frame, Opening, SessionError
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

PONDER = Ponder.random(replace(tiny_cpu(), image_px=(64, 64)), Vocabulary.tiny(), seed=1)
CONFIG = EngineConfig(num_cameras=2, max_context_tokens=300, max_sessions=4, buckets=(1, 16, 64))
ROBOTS = "abc"


def frames(robot: str, query: int) -> tuple[Frame, Frame]:
    first, second = np.random.default_rng((ord(robot), query)).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    return first, second


def opened(robots: str = ROBOTS, config: EngineConfig = CONFIG) -> QwenEngine:
    engine = QwenEngine(PONDER, config)
    for robot in robots:
        engine.open(robot, Opening(instruction=f"press button {robot}"))
    return engine


def settle(engine: QwenEngine) -> dict[str, Fire | Exception | None]:
    """Steps until nothing is owed; how each query ended, in that order."""
    ended: dict[str, Fire | Exception | None] = {}
    for _ in range(60):
        for outcome in engine.step():
            ended[outcome.session] = outcome.error or outcome.result
    return ended


@settings(max_examples=6, derandomize=True)
@given(
    present=st.lists(st.sets(st.sampled_from(ROBOTS), min_size=1), min_size=1, max_size=2),
    text_tokens=st.lists(st.sampled_from([None, None, 1, 4]), min_size=9, max_size=9),
)
def test_no_bit_of_an_answer_depends_on_who_else_asks(present: list[set[str]], text_tokens: list[int | None]) -> None:
    """Query, text and carriers of every robot are what they are when it is the only one; see LEAST_TOKENS."""
    alone, together = opened(), opened()
    for query, asking in enumerate([set(ROBOTS), *present]):
        texts = dict(zip(ROBOTS, text_tokens[query * len(ROBOTS) :], strict=False))
        for robot in sorted(asking):
            together.begin(robot, frames(robot, query), force_text_tokens=texts[robot])
        ended = settle(together)
        for robot in asking:
            expected = alone.fire(robot, frames(robot, query), force_text_tokens=texts[robot])
            answer = ended[robot]
            assert isinstance(answer, Fire)
            assert (answer.texts, answer.context_tokens) == (expected.texts, expected.context_tokens)
            assert answer.cognition.tobytes() == expected.cognition.tobytes()


def test_queries_begun_together_are_answered_by_one_forward() -> None:
    engine = opened()
    for robot in ROBOTS:
        engine.begin(robot, frames(robot, 0))
    assert [outcome.session for outcome in engine.step()] == list(ROBOTS)
    assert engine.step() == []


def test_a_query_that_comes_during_a_long_text_waits_for_one_forward_only() -> None:
    engine = opened()
    engine.begin("a", frames("a", 0), force_text_tokens=40)
    engine.step()
    engine.begin("b", frames("b", 0))
    ended = [outcome.session for _ in range(2) for outcome in engine.step()]
    assert ended == ["b"]


def test_robots_take_turns_when_a_forward_has_one_row() -> None:
    engine = opened(config=replace(CONFIG, max_batch_rows=1))
    num_steps = {}
    for robot, length in zip(ROBOTS, (9, 6, 3), strict=True):
        engine.begin(robot, frames(robot, 0), force_text_tokens=length)
    for step in range(1, 30):
        num_steps |= {outcome.session: step for outcome in engine.step()}
    # A text of n tokens takes n + 2 forwards: rounds of three robots, then of two, then of one.
    assert num_steps == {"c": 3 * 5, "b": 3 * 5 + 2 * 3, "a": 3 * 5 + 2 * 3 + 3}


def test_who_asks_again_at_once_is_not_answered_twice_while_another_waits() -> None:
    engine = opened(config=replace(CONFIG, max_batch_rows=1))
    asks = {"b": (2, 3, 9), "c": (2, 8, 9)}  # steps at which a patient robot would ask
    answers_of_a_since: dict[str, int] = {}
    waited = []
    for step in range(24):
        for robot, steps in asks.items():
            if step in steps and robot not in answers_of_a_since:
                engine.begin(robot, frames(robot, step))
                answers_of_a_since[robot] = 0
        if "a" not in answers_of_a_since:
            engine.begin("a", frames("a", step))
            answers_of_a_since["a"] = 0
        for outcome in engine.step():
            waited.append((outcome.session, answers_of_a_since.pop(outcome.session)))
            if outcome.session == "a":
                answers_of_a_since = {robot: count + 1 for robot, count in answers_of_a_since.items()}
    assert {robot for robot, _ in waited} == set(ROBOTS)
    assert max(count for robot, count in waited if robot != "a") <= 1


def test_a_query_that_fails_does_not_touch_the_others() -> None:
    engine = opened()
    engine.begin("a", frames("a", 0), force_text_tokens=20)
    engine.begin("b", frames("b", 0), force_text_tokens=300)  # does not fit beside its instruction
    ended = settle(engine)
    assert isinstance(ended["b"], ContextFull)
    assert isinstance(ended["a"], Fire)
    assert isinstance(engine.fire("b", frames("b", 0)), Fire)


def test_a_session_thinks_about_one_query_at_a_time() -> None:
    engine = opened()
    engine.begin("a", frames("a", 0))
    with pytest.raises(SessionError, match="'a' is thinking about a query already"):
        engine.begin("a", frames("a", 1))
    with pytest.raises(SessionError, match=r"\('a',\) are being thought about"):
        engine.fire("b", frames("b", 0))


def test_a_session_closed_while_it_thinks_is_forgotten() -> None:
    engine = opened()
    engine.begin("a", frames("a", 0), force_text_tokens=9)
    engine.begin("b", frames("b", 0), force_text_tokens=9)
    engine.step()
    engine.begin("c", frames("c", 0))
    engine.close("a")
    engine.close("c")
    assert list(settle(engine)) == ["b"]
    engine.open("a", Opening(instruction="again"))
    assert isinstance(engine.fire("a", frames("a", 0)), Fire)


def test_out_of_memory_refuses_the_queries_of_that_forward_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = opened()
    for robot in ROBOTS:
        engine.begin(robot, frames(robot, 0))
    with monkeypatch.context() as patch:
        patch.setattr(engine._runner, "append", fail)
        ended = settle(engine)
    assert [str(ended[robot]) for robot in ROBOTS] == [
        "the device had no memory left for this forward; the session is as it was."
    ] * 3
    twin = opened()
    for robot in ROBOTS:
        expected = twin.fire(robot, frames(robot, 0)).cognition
        np.testing.assert_array_equal(engine.fire(robot, frames(robot, 0)).cognition, expected)


def fail(appends: object) -> None:
    raise torch.OutOfMemoryError


def test_sessions_that_do_not_fit_into_memory_are_refused_before_anybody_relies_on_them() -> None:
    with pytest.raises(ValueError, match=r"4 sessions of 1000000000000 tokens need .* MiB beside the weights"):
        QwenEngine(PONDER, replace(CONFIG, max_context_tokens=10**12))


def test_an_opening_without_memory_is_a_refused_session(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = opened("ab")
    with monkeypatch.context() as patch:
        patch.setattr(engine._runner, "append", fail)
        with pytest.raises(SessionError, match="'c': the device has no memory left to encode it"):
            engine.open("c", Opening(instruction="press"))
    for robot in "cd":  # the slot was given back
        engine.open(robot, Opening(instruction="press"))
