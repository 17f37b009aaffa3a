"""What a fire and an invocation are made of on a GPU, for rows beside theirs: medians of parts, trials of kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from dual_system.models.kernels.launch import cuda_time_ms
from dual_system.models.kernels.trial import Verdict
from ponder_server.captured import CapturedDecoder
from ponder_server.contract import Frame
from ponder_server.engine import QwenEngine
from pounce_server.fused import FusedPounce, bucket_tokens

Medians = Callable[[Mapping[str, Callable[[], object]]], dict[str, float]]
"""Durations [ms] of calls by name, each to the end of the device's work."""


def captured(work: Callable[[], object]) -> dict[str, float]:
    """A row: the time of work that is shorter than its launch, without that."""
    return {"captured_ms": round(cuda_time_ms(work), 4)}


def launches(device: torch.device) -> None:
    """Launches 1000 smallest operations: their time is the host's, which drifts from minute to minute."""
    x = torch.zeros(1, device=device)
    for _ in range(1000):
        x.add_(1.0)


def fire_parts(engine: QwenEngine, session: str, frames: tuple[Frame, ...], medians: Medians) -> dict[str, float]:
    """Parts of a fire in ``session``'s context, which they change."""
    context, runner = engine._episode(session).context, engine._runner
    ids, pictures = engine._query_ids(None), [*engine._see(frames, "parts")]
    embeds_TH = engine._embed(ids, pictures)
    calls: dict[str, Callable[[], object]] = {
        "1000 launches": lambda: launches(embeds_TH.device),
        "pictures to embeddings": lambda: engine._embed(ids, pictures),
        "save": lambda: context.save(context.before_fire),
        "yes or no": lambda: engine._writer.gate(embeds_TH[:1]),
    }
    if (captured := runner._captured) is not None:
        length, longest = runner.bucket(len(ids)), context.num_tokens
        positions = next(most for most in captured._buckets(1, length) if most >= longest)
        calls["forward, replayed"] = captured.forward(1, length, positions).run
    return medians(calls)


def sample_parts(fused: FusedPounce, inputs: Any, noise_BNA: Tensor, medians: Medians) -> dict[str, float]:
    """Parts of a sample of a shape that was sampled before."""
    network: Any = fused._network
    seen = fused._see(inputs.images)
    prefix = network.embed(inputs, seen)
    bucket = fused._buckets[len(noise_BNA), bucket_tokens(prefix.num_tokens)]
    return medians(
        {
            "1000 launches": lambda: launches(noise_BNA.device),
            "vision tower": fused._eyes[len(noise_BNA)].look,
            "embed": lambda: network.embed(inputs, seen),
            "load": lambda: bucket.load(prefix, noise_BNA),
            "prefill": bucket.prefill,
            "flow steps": lambda: [step() for step in bucket.steps],
        }
    )


def trials(of: CapturedDecoder | FusedPounce | None) -> dict[str, dict[str, str]]:
    """Every verdict, by shape and operation."""
    return {} if of is None else {shape: told(verdicts) for shape, verdicts in of._tried.items()}


def told(verdicts: Sequence[Verdict]) -> dict[str, str]:
    return {one.operation: f"{'kernel' if one.is_taken else 'twin'}: {one.why}" for one in verdicts}
