"""A query's pictures are looked at by replay, to the same bits; those of an opening that no query equals are not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dual_system.models.graphs import Work
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.eyes import Eyes

COUNTS = (2, 4, 6)
"""Pictures of one to three queries of two cameras."""


@pytest.fixture(scope="module")
def ponder() -> Ponder:
    return Ponder.random(replace(tiny_cpu(), num_layers=4, image_px=(64, 96)), seed=3)


def pictures(ponder: Ponder, count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(256, (count, *ponder.image_px, 3), generator=generator).to(torch.uint8)


class Recorder:
    """Captures nothing, and counts captures and replays."""

    def __init__(self) -> None:
        self.captures = self.replays = 0

    def __call__(self, work: Work) -> Work:
        self.captures += 1

        def replay() -> None:
            self.replays += 1
            work()

        return replay


@torch.inference_mode()
def test_replays_and_launches_give_the_tower_s_tokens(ponder: Ponder) -> None:
    recorder, eyes = Recorder(), Eyes(ponder)
    eyes.capture(recorder)
    eyes.prepare(2, max_rows=3)
    eyes.prepare(2, max_rows=2)
    assert recorder.captures == len(COUNTS)
    recorder.replays = 0
    for seed, count in enumerate((2, 6, 4, 2, 3, 1, 8)):
        shown = pictures(ponder, count, seed)
        assert torch.equal(eyes(shown), ponder.image_features(shown))
    assert recorder.replays == 4
    assert recorder.captures == len(COUNTS), "other numbers are not captured while a robot waits"


@torch.inference_mode()
def test_without_graphs_nothing_is_prepared(ponder: Ponder) -> None:
    eyes, shown = Eyes(ponder), pictures(ponder, 2, 0)
    eyes.prepare(2, max_rows=3)
    assert torch.equal(eyes(shown), ponder.image_features(shown))


@torch.inference_mode()
def test_a_tower_that_is_recorded_wrongly_is_refused(ponder: Ponder) -> None:
    eyes = Eyes(ponder)
    eyes.capture(lambda work: lambda: None)
    with pytest.raises(RuntimeError, match=r"captured vision towers change their tokens by .* --no-graphs"):
        eyes.prepare(2, max_rows=1)
