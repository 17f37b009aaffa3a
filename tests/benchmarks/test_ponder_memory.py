"""What a session of PONDER takes is what was computed beforehand, and nothing is allocated for it later."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from benchmarks.ponder_memory import made_by
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig

ROOT = Path(__file__).parents[2]
SMALL = replace(tiny_cpu(), num_layers=4, vision_depth=1, image_px=(64, 64))


@settings(max_examples=4, deadline=None)
@given(
    shape=st.fixed_dictionaries(
        {
            "num_layers": st.sampled_from([4, 8]),
            "num_kv_heads": st.sampled_from([1, 2, 4]),
            "num_gdn_key_heads": st.sampled_from([1, 2]),
            "num_gdn_value_heads": st.sampled_from([2, 4]),
            "gdn_head_dim": st.sampled_from([16, 32]),
        }
    ),
    dtype=st.sampled_from([torch.float32, torch.bfloat16]),
    num_sessions=st.integers(1, 4),
    max_context_tokens=st.integers(1, 700),
)
def test_sessions_take_what_was_computed(
    shape: dict[str, Any], dtype: torch.dtype, num_sessions: int, max_context_tokens: int
) -> None:
    ponder = Ponder.random(replace(SMALL, **shape), seed=0, dtype=dtype)
    config = EngineConfig(max_sessions=num_sessions, max_context_tokens=max_context_tokens)
    engine, made = made_by(partial(QwenEngine, ponder, config))
    which_tokens_are_text_bytes = 2 * ponder.vocab_size  # the writer's masks, one of a kind
    expected_bytes = num_sessions * engine.spec.session_bytes + which_tokens_are_text_bytes
    assert sum(memory.nbytes for memory in made) == expected_bytes


def test_tensors_without_memory_are_not_counted() -> None:
    def build() -> list[torch.Tensor]:
        with FakeTensorMode():
            fake = [torch.empty(8, device="cuda"), torch.nn.Parameter(torch.empty(8, device="cuda"))]
        return [*fake, torch.empty(8, device="meta"), torch.zeros(8)]

    built, made = made_by(build)
    assert [memory.nbytes for memory in made] == [built[-1].nbytes]


def test_an_episode_keeps_nothing_beside_its_session() -> None:
    engine = QwenEngine(Ponder.random(SMALL, seed=0), EngineConfig(max_sessions=2, max_context_tokens=400))
    frames = tuple(np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8))

    def play() -> None:
        engine.open("a", Opening(instruction="press"))
        for exactly in (None, 7, None):
            engine.fire("a", frames, force_text_tokens=exactly)

    _, made = made_by(play)
    assert sum(memory.nbytes for memory in made) < 4000  # tables of the vision tower's angles at most


@pytest.mark.acceptance
def test_the_command_says_both_numbers(tmp_path: Path) -> None:
    """In a process of its own: one that has freed memory before grows by less than it takes, or not at all."""
    command = "; ".join(
        (
            "import pathlib, sys",
            "from benchmarks import ponder_memory, report",
            "report.REPORTS = pathlib.Path(sys.argv[1])",
            "sys.exit(ponder_memory.main(['--size', 'tiny_cpu', '--no-episode']))",
        )
    )
    subprocess.run([sys.executable, "-c", command, str(tmp_path)], cwd=ROOT, check=True, timeout=120)
    (table,) = json.loads((tmp_path / "ponder_memory_tiny_cpu.json").read_text())["tables"]
    (row,) = table["rows"]
    assert row["computed_mib"] == row["allocated_mib"]
    assert row["resident_mib"] > row["computed_mib"] / 2
