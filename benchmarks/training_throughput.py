"""Training throughput, the parts of a step, and their rates compared with the machine's peak.

One step is the trainer's: forward, backward, clipping, AdamW, average. Timed separately, forward and backward: PONDER's
rows (pictures and text of whole episodes, with the LM head on supervised tokens), alternately batched and one after
the other, and POUNCE's invocations with given cognition. Episodes are noise, of ``--ticks``, under the recipe's own
schedules; reading and decoding a dataset is not included.

Operations are those that torch counts in matrix products and attention (``FlopCounterMode``), forward and backward; the
peak is a square product of the same dtype, measured here. Networks of a few dozen channels spend their time elsewhere.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.report import Report, Row, show, spread
from dual_system.models.pi05.pounce import freeze
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import PounceBundle, random_bundle
from dual_system.models.pounce.family import action_loss, sample_times
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import make_example
from dual_system.training.joint import Draws, JointModel, PonderBatch, PounceBatch, encode_rows
from dual_system.training.recipe import Recipe
from dual_system.training.recipes import recipe
from dual_system.training.trainer import Trainer
from protocol.command_line import parse


@dataclass(frozen=True, slots=True, kw_only=True)
class ThroughputOptions:
    """Steps of one recipe with random weights; `tiny_cpu` sizes are the recipe's own."""

    recipe: str = "tiny"
    ponder: Literal["recipe", "tiny_cpu", "qwen35_0p8b", "qwen35_2b", "qwen35_4b", "qwen35_9b"] = "recipe"
    """PONDER of this size instead; POUNCE reads its cognition."""
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Number format of PONDER's weights and of the peak's product."""
    threads: int = 1
    ticks: tuple[int, ...] = (100, 100)
    """Number of 20 Hz steps of each episode in the batch."""
    demo: int = 5
    """Seconds of demonstration, with one picture per camera and second."""
    steps: int = 5
    """Measured steps, after an uncounted one."""
    peak_size: int = 1024
    """Side of the square product; use 8192 on a GPU."""


def main(argv: list[str] | None = None) -> int:
    options = parse(ThroughputOptions, argv, prog="training-throughput")
    torch.set_num_threads(options.threads)
    report = Report(
        name=f"training_throughput_{options.device}",
        question="How fast does training go, and where does a step spend its time?",
        config=options,
        warm_up="one step, one pass of each part, one product.",
    )
    model, bundle, run = _build(options)
    episodes, invocations = _batch(model, bundle, run, options)
    peak = _peak_flops(options)
    trainer = Trainer(model, lambda step: (episodes, invocations), run.train)
    num_tokens = sum(len(row.ids) for row in episodes.rows)
    count = len(invocations.actions_INA)
    parts: list[tuple[str, Callable[[], object]]] = [
        ("a whole step", lambda: list(trainer.run(trainer.step + 1))),
        ("PONDER's rows, together", lambda: _ponder(model, episodes, together=True)),
        ("PONDER's rows, one after the other", lambda: _ponder(model, episodes, together=False)),
        ("POUNCE's invocations", lambda: _pounce(model, invocations)),
    ]
    rows: list[Row] = []
    flops_of = [_flops(once) for _, once in parts]
    turns = [[_timed_ms(once, options.device) for _, once in parts] for _ in range(options.steps)]
    for (name, _), flops, took_ms in zip(parts, flops_of, map(list, zip(*turns, strict=True)), strict=True):
        p50_s = float(np.median(took_ms)) / 1e3
        rows.append(
            {"part": name}
            | spread(took_ms, "ms")
            | {
                "episodes_per_s": round(len(episodes.rows) / p50_s, 2),
                "row_tokens_per_s": None if name.startswith("POUNCE") else round(num_tokens / p50_s),
                "invocations_per_s": None if name.startswith("PONDER") else round(count / p50_s, 1),
                "gflop": round(flops / 1e9, 2),
                "share_of_peak_%": round(100 * flops / p50_s / peak, 1),
            }
        )
    report.add_table("Forward and backward; the whole step with its update", rows)
    report.notes += [
        f"Episodes of {', '.join(map(str, options.ticks))} ticks: rows of {num_tokens} tokens in all with "
        f"{sum(row.num_images for row in episodes.rows)} pictures, {count} invocations.",
        f"Measured peak: {peak / 1e9:.1f} GFLOP/s, a product of {options.peak_size} x {options.peak_size} in "
        f"{options.dtype} on {options.device}, {options.threads} thread(s).",
        f"PONDER {_millions(model.ponder)} M parameters, POUNCE {_millions(model.pounce)} M, random weights.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _build(options: ThroughputOptions) -> tuple[JointModel, PounceBundle, Recipe]:
    run = recipe(options.recipe)
    if options.ponder != "recipe":
        ponder_config = getattr(ponder_configs, options.ponder)()
        cognition = replace(run.pounce.cognition, cognition_size=ponder_config.hidden_size)
        run = replace(run, ponder=ponder_config, pounce=replace(run.pounce, cognition=cognition))
    ponder = Ponder.random(run.ponder, seed=0, device=options.device, dtype=getattr(torch, options.dtype))
    bundle = random_bundle(run.pounce, seed=0)
    bundle.model.to(options.device)
    freeze(bundle.model, run.freeze)
    reads_together = options.device != "cpu"  # as in pp-train
    return JointModel(ponder, bundle.model, w1=run.w1, w2=run.w2, reads_together=reads_together), bundle, run


def _batch(
    model: JointModel, bundle: PounceBundle, run: Recipe, options: ThroughputOptions
) -> tuple[PonderBatch, PounceBatch]:
    rng = np.random.default_rng(0)
    images, views = (
        tuple(rng.integers(0, 256, (*size, 3), np.uint8) for _ in range(2))
        for size in (model.ponder.image_px, (bundle.model.config.image_px,) * 2)
    )
    recorded = [
        TrainingEpisode(
            instruction="watch the video, then do the same",
            demo=(images,) * options.demo,
            images=[images] * ticks,
            views=[views] * ticks,
            state_TS=rng.uniform(-0.2, 0.2, (ticks, 8)).astype(np.float32),
            action_TA=rng.uniform(-0.2, 0.2, (ticks, 8)).astype(np.float32),
            subgoals=[f"pick cube {1 + tick // 50} at <{50 + tick // 50}, 120>" for tick in range(ticks)],
            is_transition_T=np.arange(ticks) % 50 == 0,
        )
        for ticks in options.ticks
    ]
    examples = [make_example(episode, model.ponder.format, run.example, rng) for episode in recorded]
    episodes = collate_ponder(examples)
    invocations = collate_pounce(examples, bundle.model.config, bundle.tokenizer, bundle.statistics)
    return episodes.to(options.device), invocations.to(options.device)


def _ponder(model: JointModel, episodes: PonderBatch, *, together: bool) -> None:
    hidden = encode_rows(model.ponder, episodes, together=together)
    read = [hidden_TH[row.supervised_index] for row, hidden_TH in zip(episodes.rows, hidden, strict=True)]
    model.ponder.logits(torch.cat(read)).float().logsumexp(dim=-1).mean().backward()
    model.zero_grad(set_to_none=True)


def _pounce(model: JointModel, invocations: PounceBatch) -> None:
    pounce, count = model.pounce, len(invocations.actions_INA)
    config = pounce.config.cognition
    device = invocations.actions_INA.device
    cognition_IKH = torch.zeros(count, config.num_carriers, config.cognition_size, device=device, requires_grad=True)
    generators = [torch.Generator().manual_seed(index) for index in range(int(invocations.episode_I.max()) + 1)]
    draws = Draws.draw(invocations, lambda n, generator: sample_times(pounce, n, generator), 0.0, generators)
    inputs = replace(invocations.inputs, cognition=cognition_IKH)
    action_loss(pounce, inputs, invocations.actions_INA, draws.noise_SNA, draws.time_S).backward()
    model.zero_grad(set_to_none=True)


def _flops(once: Callable[[], object]) -> int:
    """Counts the operations of one pass, which is also the warm-up."""
    with FlopCounterMode(display=False) as counter:
        once()
    return int(counter.get_total_flops())


def _peak_flops(options: ThroughputOptions) -> float:
    """Rate of a square product, the best of ten."""
    side = options.peak_size
    left = torch.randn(side, side, device=options.device, dtype=getattr(torch, options.dtype))
    took_ms = [_timed_ms(lambda: left @ left, options.device) for _ in range(11)][1:]
    return 2 * side**3 / (min(took_ms) / 1e3)


def _timed_ms(once: Callable[[], object], device: str) -> float:
    start_ns = time.perf_counter_ns()
    once()
    if device == "cuda":
        torch.cuda.synchronize()
    return (time.perf_counter_ns() - start_ns) / 1e6


def _millions(model: torch.nn.Module) -> float:
    return round(sum(parameter.numel() for parameter in model.parameters()) / 1e6, 2)


if __name__ == "__main__":
    sys.exit(main())
