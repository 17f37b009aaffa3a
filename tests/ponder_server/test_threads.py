"""Pieces are done once each, by whoever is free; nobody waits for a helper that has not begun."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.__main__ import build_engine
from ponder_server.config import ContextOptions, PonderOptions, SpeedOptions
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.threads import ALONE, Piece, Threads

PATIENCE_S = 20.0


@settings(deadline=None, max_examples=30)
@given(count=st.integers(1, 4), num_pieces=st.integers(0, 40))
def test_every_piece_is_done_once_and_before_it_returns(count: int, num_pieces: int) -> None:
    done: list[int] = []
    Threads(count).do(partial(done.append, index) for index in range(num_pieces))
    assert sorted(done) == list(range(num_pieces))


def test_alone_the_caller_does_them_in_order() -> None:
    done: list[tuple[int, int]] = []

    def note(index: int) -> None:
        done.append((threading.get_ident(), index))

    ALONE.do(partial(note, index) for index in range(5))
    assert done == [(threading.get_ident(), index) for index in range(5)]


@pytest.mark.parametrize("count", [2, 3])
def test_as_many_pieces_as_threads_are_under_way_at_once(count: int) -> None:
    """Each waits for all the others: on fewer threads it would wait in vain."""
    meeting = threading.Barrier(count)
    threads = Threads(count)

    def meet() -> None:
        meeting.wait(PATIENCE_S)

    for _ in range(3):
        threads.do([meet] * count)


@pytest.mark.parametrize("of_caller", [True, False])
def test_an_error_is_raised_when_nothing_is_under_way_any_more(of_caller: bool) -> None:
    """Whoever met it; what was under way beside it is finished first, or its memory would be gone."""
    both, failed = threading.Barrier(2), threading.Event()
    done: list[str] = []

    def piece() -> None:
        both.wait(PATIENCE_S)
        if (threading.current_thread() is threading.main_thread()) == of_caller:
            failed.set()
            raise ZeroDivisionError
        failed.wait(PATIENCE_S)
        done.append("beside it")

    with pytest.raises(ZeroDivisionError):
        Threads(2).do([piece, piece])
    assert done == ["beside it"]


def test_after_an_error_no_piece_is_begun() -> None:
    done: list[int] = []

    def fail() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        ALONE.do([partial(done.append, 0), fail, partial(done.append, 1)])
    assert done == [0]


def test_nobody_waits_for_a_helper_that_is_busy_elsewhere() -> None:
    threads = Threads(2)
    both, is_over = threading.Barrier(3), threading.Event()
    ended: list[bool] = []

    def occupy() -> None:
        both.wait(PATIENCE_S)
        ended.append(is_over.wait(PATIENCE_S))

    other = threading.Thread(target=threads.do, args=([occupy, occupy],))
    other.start()
    try:
        both.wait(PATIENCE_S)
        done: list[int] = []
        threads.do(partial(done.append, index) for index in range(3))
        assert done == [0, 1, 2]
        assert not ended
    finally:
        is_over.set()
        other.join()
    assert ended == [True, True]


@pytest.mark.parametrize("is_inference", [True, False])
def test_helpers_work_in_the_callers_mode(is_inference: bool) -> None:
    """Or they could not write into its tensors."""
    both = threading.Barrier(2)
    modes: list[bool] = []

    def piece() -> None:
        both.wait(PATIENCE_S)
        modes.append(torch.is_inference_mode_enabled())

    with torch.inference_mode(is_inference):
        Threads(2).do([piece, piece])
    assert modes == [is_inference] * 2


# -- in the engine


def test_an_answer_has_the_same_bits_on_two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a context that is long enough for two: some attention comes in more than one piece."""
    num_pieces: list[int] = []
    do = Threads.do

    def watched(threads: Threads, pieces: Iterable[Piece]) -> None:
        pieces = list(pieces)
        num_pieces.append(len(pieces))
        do(threads, pieces)

    monkeypatch.setattr(Threads, "do", watched)
    model = replace(tiny_cpu(), image_px=(64, 64))
    frames = np.random.default_rng(0).integers(0, 256, (200, 64, 64, 3), dtype=np.uint8)
    opening = Opening(instruction="press the buttons in order", demo_frames=tuple((frame,) for frame in frames))
    answers = []
    for num_threads in (1, 2):
        num_pieces.clear()
        config = EngineConfig(
            max_context_tokens=1600, max_sessions=1, prefill_chunk_tokens=500, attention_threads=num_threads
        )
        engine = QwenEngine(Ponder.random(model, seed=1), config)
        engine.open("a", opening)
        answers.append(engine.fire("a", (frames[0], frames[1])).cognition)
        assert max(num_pieces) == num_threads, "a piece for each of two key heads, or all at once"
    np.testing.assert_array_equal(answers[0], answers[1])


@pytest.mark.parametrize(("wanted", "count"), [(1, 1), (2, 2), (9, 2)])
def test_there_are_no_more_threads_than_cores(
    wanted: int, count: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("ponder_server.threads.num_usable_cores", lambda: 2)
    engine = build_engine(
        PonderOptions(speed=SpeedOptions(attention_threads=wanted), context=ContextOptions(max_context_tokens=400))
    )
    assert isinstance(engine, QwenEngine)
    assert engine._runner._threads.count == count
    assert ("--attention-threads 9: this process may use 2 core(s)" in caplog.text) == (wanted == 9)
