"""What the benchmark counts of a drafted text is what the draft did."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from benchmarks.ponder_latency import (
    TEXT_TOKENS,
    LatencyOptions,
    _dtypes,
    _labelled,
    _num_right,
    _own_text,
    _texts,
    _untrained_prediction,
)
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.draft import Draft, NoDraft, TrieDraft
from ponder_server.mtp import MtpDraft

OPTIONS = LatencyOptions(contexts=(800, 900), texts=1)


@pytest.mark.parametrize(
    ("guesses", "said", "num_right"),
    [((), (1, 2), 0), ((1, 2), (1, 2, 3), 2), ((1, 5), (1, 2, 5), 1), ((5, 2), (1, 2), 0)],
)
def test_right_are_the_guesses_before_the_first_wrong_one(
    guesses: tuple[int, ...], said: tuple[int, ...], num_right: int
) -> None:
    assert _num_right(guesses, said) == num_right


@torch.inference_mode()
def test_a_draft_that_knows_the_text_needs_few_steps_and_one_that_was_never_trained_all() -> None:
    ponder = Ponder.random(replace(tiny_cpu(), image_px=(64, 64), num_layers=4), seed=0)
    ponder.mtp = _untrained_prediction(ponder)
    drafts: list[Draft] = [NoDraft(), TrieDraft([_own_text(ponder)]), MtpDraft(ponder, num_tokens=3)]
    plain, known, guessed = (_texts(ponder, draft, OPTIONS, 0.0) for draft in drafts)
    assert (plain["guessed"], plain["accepted"], plain["steps"]) == (0, 0, TEXT_TOKENS)
    assert known["guessed"] == known["accepted"] == TEXT_TOKENS - 3  # 16 tokens a forward
    assert known["steps"] == 3
    assert guessed["guessed"] > 20
    assert guessed["steps"] > TEXT_TOKENS / 2


def test_graphs_are_told_of_where_there_are_some() -> None:
    gpu = LatencyOptions(device="cuda:0")
    assert _labelled({"p50_ms": 1.0}, OPTIONS) == {"weights": "float", "attention_threads": 1, "p50_ms": 1.0}
    assert [_labelled({}, gpu, graphs=graphs)["engine"] for graphs in (True, False)] == ["ours graphs", "ours eager"]


def test_a_gpu_is_not_asked_for_two_large_networks_in_float32() -> None:
    assert _dtypes(LatencyOptions(device="cuda:0")) == ("bfloat16",)
    assert _dtypes(LatencyOptions(device="cuda:0", dtypes=("float32",))) == ("float32",)
    assert _dtypes(OPTIONS) == ("float32", "bfloat16")
