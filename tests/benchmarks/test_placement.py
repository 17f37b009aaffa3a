"""Sums of memory: those of the page are those of the command, and a server allocates what they count."""

from pathlib import Path

import torch

from benchmarks.placement import session_gb, tables, weight_gb
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.narrow import quantise


def test_the_page_shows_what_the_command_prints() -> None:
    assert tables() in (Path(__file__).parents[2] / "docs/gpu.md").read_text()


def test_sums_are_what_a_server_allocates() -> None:
    ponder = Ponder.random(tiny_cpu(), seed=0, dtype=torch.bfloat16)
    engine = QwenEngine(ponder, EngineConfig(max_sessions=1, max_context_tokens=512))
    assert session_gb(ponder, 512) == engine.spec.session_bytes / 1e9
    narrow_gb = weight_gb(ponder.qwen, is_fp8=True)
    quantise(ponder, "fp8")
    held = {id(each): each for each in (*ponder.qwen.parameters(), *ponder.qwen.buffers())}.values()
    rotations = sum(each.nbytes for name, each in ponder.qwen.named_buffers() if name.endswith("inv_freq"))
    assert narrow_gb == (sum(each.nbytes for each in held) - rotations) / 1e9
