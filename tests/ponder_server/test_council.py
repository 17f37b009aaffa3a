"""Counsel: all readings of an episode tell the same story, each in its own view, and an error leaves none of it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.counsel import Counsel, Otherwise
from dual_system.models.eyes import Eye
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.models.views import AS_IT_IS, View
from ponder_server.__main__ import build_engine
from ponder_server.config import PonderOptions
from ponder_server.contract import Fire, Opening, Outcome, SessionError, Text
from ponder_server.council import Council
from ponder_server.engine import QwenEngine
from ponder_server.writer import ends_of_text
from tests.ponder_server.test_engine import (
    CONFIG,
    SCRIPT,
    SUBGOAL,
    TOLERANCE,
    VOCABULARY,
    WITH_DEMO,
    assert_untouched,
    context_of,
    observation,
    state_of,
    taught,
)

COUNSEL = Counsel(others=(Otherwise(right_px=3), Otherwise(is_mirrored=True)), near=30)
VIEWS = (View(text_px=2.0), View(right_px=3, text_px=2.0), View(is_mirrored=True, text_px=2.0))
EYES = (Eye(camera=0, box=(0.25, 0.25, 0.75, 0.75)),)
FRAMES = (np.zeros((4, 4, 3), np.uint8),)
OPENING = Opening(instruction="do it")


class Scripted:
    """Stands in for a `QwenEngine`: every view says what its script has for the query, or what it is told to."""

    def __init__(
        self, scripts: dict[View, list[tuple[str, ...]]], broken: View | None = None, *, shares: bool = False
    ) -> None:
        self.scripts, self.broken, self.shares = scripts, broken, shares
        self.views: dict[str, View] = {}
        self.told: dict[str, list[tuple[str, ...]]] = {}
        self.begun: dict[str, tuple[str, ...] | None] = {}
        self.spec = QwenEngine(taught(SCRIPT), CONFIG).spec
        self.looking: set[View] = set()
        """Who says by a second look what it says."""

    def open_views(self, views: dict[str, View], opening: Opening, progress: Any) -> int:
        self.views |= views
        self.told |= {session: [] for session in views}
        return 7

    def begin(self, session: str, frames: Any, *, proprio: Any = None, saying: tuple[str, ...] | None = None) -> None:
        assert session not in self.begun
        self.begun[session] = saying

    def drop(self, session: str) -> None:
        self.begun.pop(session, None)

    def undo(self, session: str) -> None:
        self.told[session].pop()

    def close(self, session: str) -> None:
        del self.views[session], self.told[session]

    def step(self, progress: Any) -> list[Outcome[Fire]]:
        if not self.begun:
            return []
        outcome = self.answer()
        return [outcome, *self.step(progress)] if self.shares else [outcome]

    def answer(self) -> Outcome[Fire]:
        session = next(reversed(self.begun))  # in whatever order
        saying, view = self.begun.pop(session), self.views[session]
        if view == self.broken:
            return Outcome(session, None, ValueError("broken"))
        said = self.scripts[view][len(self.told[session])] if saying is None else saying
        self.told[session].append(said)
        texts = tuple(Text(kind="subgoal", text=text, token_ids=(), truncated=False) for text in said)
        cognition = np.full((1, 2), VIEWS.index(view), np.float32)
        fire = Fire(
            cognition=cognition,
            is_transition=bool(said),
            texts=texts,
            context_tokens=9,
            is_second_look=bool(said) and saying is None and view in self.looking,
        )
        return Outcome(session, fire)


def council_of(engine: Any, views: tuple[View, ...] = VIEWS) -> Council:
    return Council(engine, COUNSEL, lambda instruction: views)


def test_who_is_outvoted_says_what_was_elected_in_his_own_view() -> None:
    away = [("go to [100, 100]",), ()]
    engine = Scripted(
        {
            VIEWS[0]: away,
            VIEWS[1]: [("go to [523, 600]",), ("go to [1, 1]",)],
            VIEWS[2]: [("go to [500, 600]",), ("go to [1, 1]",)],
        }
    )
    council = council_of(engine)
    council.open("a", OPENING)
    first = council.fire("a", FRAMES)
    assert [text.text for text in first.texts] == ["go to [500, 600]"]
    assert first.cognition.tolist() == [[0.0, 0.0]], "of the view as it is"
    second = council.fire("a", FRAMES)
    assert len(second.texts) == 1
    for view, told in zip(VIEWS, engine.told.values(), strict=True):
        assert [tuple(map(view.meant, said)) for said in told] == [
            tuple(text.text for text in answer.texts) for answer in (first, second)
        ]


def test_what_a_second_look_has_found_gives_way_to_words_of_ones_own() -> None:
    looked, spoken = ("go to [100, 100]",), ("stop",)
    for others, expected in (((spoken, spoken), spoken), ((), looked), ((spoken, ()), ())):
        said = [looked, *others]
        said += [tuple(map(view.seen, looked)) for view in VIEWS[len(said) :]]
        engine = Scripted({view: [each] for view, each in zip(VIEWS, said, strict=True)})
        engine.looking = {view for view, each in zip(VIEWS, said, strict=True) if each and "go" in each[0]}
        council = council_of(engine)
        council.open("a", OPENING)
        assert tuple(text.text for text in council.fire("a", FRAMES).texts) == expected


@pytest.mark.parametrize("shares", [False, True])
@pytest.mark.parametrize("broken", VIEWS)
def test_an_error_in_one_reading_leaves_no_trace_in_any(broken: View, shares: bool) -> None:
    engine = Scripted({view: [("go",), ("stop",)] for view in VIEWS}, broken=broken, shares=shares)
    council = council_of(engine)
    council.open("a", OPENING)
    with pytest.raises(ValueError, match="broken"):
        council.fire("a", FRAMES)
    assert not engine.begun
    assert [*engine.told.values()] == [[], [], []]
    engine.broken = None
    assert [text.text for text in council.fire("a", FRAMES).texts] == ["go"]
    council.close("a")
    assert not engine.views
    with pytest.raises(SessionError, match="is not open"):
        council.begin("a", FRAMES)


def test_readings_in_one_view_are_what_one_is() -> None:
    ponder = taught(SCRIPT)
    alone, council = QwenEngine(ponder, CONFIG), council_of(QwenEngine(ponder, CONFIG), (AS_IT_IS,) * 2)
    for engine in (alone, council):
        assert engine.open("a", WITH_DEMO) > 0
    for query in range(len(SCRIPT)):
        expected, answer = (engine.fire("a", observation(query)) for engine in (alone, council))
        assert answer.texts == expected.texts
        assert answer.context_tokens == expected.context_tokens
        assert np.abs(answer.cognition - expected.cognition).max() < TOLERANCE
    council.close("a")
    council.open("a", WITH_DEMO)  # and there is room again


def test_an_answer_taken_back_leaves_the_session_as_it_was_and_can_be_given_otherwise() -> None:
    engine = QwenEngine(taught(SCRIPT), CONFIG)
    engine.open("a", WITH_DEMO)
    engine.fire("a", observation(0))
    before = state_of(context_of(engine, "a"))
    spoken = engine.fire("a", observation(1))
    assert len(spoken.texts) == 2, "reasoning, and a subgoal"
    engine.undo("a")
    assert_untouched(context_of(engine, "a"), before)
    with pytest.raises(SessionError, match="no answer that could be taken back"):
        engine.undo("a")
    engine.begin("a", observation(1), saying=())
    (outcome,) = engine.step()
    assert outcome.unwrap().texts == ()
    engine.undo("a")
    engine.begin("a", observation(1), saying=tuple(text.text for text in spoken.texts))
    while not (outcomes := engine.step()):
        pass
    again = outcomes[0].unwrap()
    assert [(text.kind, text.text) for text in again.texts] == [(text.kind, text.text) for text in spoken.texts]
    assert np.abs(again.cognition - spoken.cognition).max() < TOLERANCE
    assert again.texts[-1].token_ids == SUBGOAL
    assert not ends_of_text(VOCABULARY) & {*again.texts[-1].token_ids}


@given(st.integers(-4, 4), st.integers(-4, 4), st.booleans(), st.integers(100, 900), st.integers(100, 900))
def test_what_is_meant_is_what_is_seen_undone(down_px: int, right_px: int, is_mirrored: bool, x: int, y: int) -> None:
    view = View(down_px=down_px, right_px=right_px, is_mirrored=is_mirrored, text_px=2.0)
    text = f"move left to [{x}, {y}], then [{y}, {x}]"
    back = view.meant(view.seen(text))
    numbers = [
        [int(n) for n in each.replace("]", "").replace("[", ",").split(",") if n.strip().isdigit()]
        for each in (back, text)
    ]
    assert np.abs(np.subtract(*numbers)).max() <= 1
    assert back.split()[:2] == ["move", "left"]
    assert ("right" in view.seen(text)) == is_mirrored


@given(st.integers(-4, 4), st.integers(-4, 4), st.booleans(), st.integers(20, 230), st.integers(20, 230))
def test_what_ponder_says_moves_as_the_simulators_words_do(
    down_px: int, right_px: int, is_mirrored: bool, y: int, x: int
) -> None:
    view = View(down_px=down_px, right_px=right_px, is_mirrored=is_mirrored, text_px=2.0)
    text = f"move right to <{y}, {x}>"
    ours, theirs = view.seen(normalised_text(text)), normalised_text(view.text(text))
    assert ours.split()[:2] == theirs.split()[:2]
    assert np.abs(np.subtract(*([int(n) for n in re.findall(r"\d+", each)] for each in (ours, theirs)))).max() <= 1


@pytest.mark.parametrize("opening", [OPENING, WITH_DEMO])
def test_a_checkpoint_that_asks_for_counsel_is_served_with_it(tmp_path: Path, opening: Opening) -> None:
    """And to as many robots as it was told, also where an episode takes one of its contexts only."""
    counsel = replace(COUNSEL, on_demonstrations=False)
    opening = replace(opening, demo_frames=((np.zeros((128, 128, 3), np.uint8),),) if opening.has_demo else ())
    ponder = taught(SCRIPT)
    ponder.format = replace(ponder.format, eyes=EYES, counsel=counsel)
    save_ponder(ponder, tmp_path)
    assert load_ponder(tmp_path).format.counsel == counsel
    engine = build_engine(PonderOptions(checkpoint=tmp_path, max_context_tokens=400, max_sessions=1))
    assert isinstance(engine, Council)
    assert engine.num_members == 3
    engine.open("a", opening)
    with pytest.raises(SessionError, match=r"'b' does not fit: \['a'\] are open and max_sessions is 1"):
        engine.open("b", opening)
    engine.close("a")
    engine.open("b", opening)


def test_episodes_with_a_demonstration_can_be_left_without_it() -> None:
    """They are then answered as by the engine alone, to the bit, and others in all views."""
    counsel = replace(COUNSEL, on_demonstrations=False)
    engine, alone = QwenEngine(taught(SCRIPT), replace(CONFIG, max_sessions=4)), QwenEngine(taught(SCRIPT), CONFIG)
    council = Council(engine, counsel, lambda instruction: VIEWS)
    assert council.open("shown", WITH_DEMO) == alone.open("shown", WITH_DEMO)
    assert [*engine._episodes] == ["shown"]
    for query in range(len(SCRIPT)):
        answer, expected = (each.fire("shown", observation(query)) for each in (council, alone))
        assert np.array_equal(answer.cognition, expected.cognition)
        assert [text.text for text in answer.texts] == [text.text for text in expected.texts]
    council.open("plain", OPENING)
    assert len(engine._episodes) == 1 + len(VIEWS)
    council.close("shown")
    council.close("plain")
    assert not engine._episodes


def test_nothing_is_mirrored_where_the_instruction_names_a_side() -> None:
    for instruction, may_mirror in (
        ("put it on the left-side target", False),
        ("place it right after the button was pressed", True),
        ("pick up the cube", True),
    ):
        views = COUNSEL.views(EYES, (64, 64), instruction)
        assert [view.is_mirrored for view in views] == [False, False, may_mirror]
        assert {view.text_px for view in views} == {2.0}


def test_counsel_is_refused_where_words_and_pictures_would_not_move_together() -> None:
    assert COUNSEL.text_px(EYES, (64, 64)) == 2.0
    with pytest.raises(ValueError, match="one eye"):
        COUNSEL.text_px(None, (64, 64))
    with pytest.raises(ValueError, match="not symmetric"):
        COUNSEL.text_px((replace(EYES[0], box=(0.0, 0.0, 0.5, 0.5)),), (64, 64))
    with pytest.raises(ValueError, match="another view"):
        Counsel(others=(), near=30)
    with pytest.raises(ValueError, match="at least 1"):
        replace(COUNSEL, near=0)
