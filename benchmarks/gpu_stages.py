"""What a GPU's day measures (`benchmarks.gpu_day`): its sizes and predictions, and its stages."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.gpu_parts import captured, fire_parts, sample_parts, told, trials
from benchmarks.report import git_version
from benchmarks.roofline import measure_ceilings
from dual_system.models.fp8 import has_products
from dual_system.models.gpu import current
from dual_system.models.graphs import directly, graphs_for
from dual_system.models.kernels.fp8 import FEW_ROWS, few_rows_fused, quantise_eager
from dual_system.models.kernels.launch import cuda_time_ms, missing_for
from dual_system.models.kernels.trial import choose
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.ponder.configs import PonderConfig
from dual_system.models.ponder.context import Row
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce import configs as pounce_configs
from dual_system.models.pounce.family import AnyPounceConfig, random_model
from dual_system.models.pounce.precision import cast_streams
from ponder_server.contract import Frame, Opening, WeightsName
from ponder_server.draft import Draft, TrieDraft
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.operations import KERNELS
from ponder_server.operations import TWINS as PONDER_TWINS
from ponder_server.rehearsal import rehearse
from ponder_server.slots import SlotMemory
from ponder_server.stack import Stack
from pounce_server.compiled import compiled_sampler
from pounce_server.contract import DTypeName
from pounce_server.fused import FusedPounce, fused_for
from pounce_server.operations import TWINS

Result = TypeVar("Result")

PREDICTED_MS = {
    "fire at 800 tokens": 13.0,
    "fire at 14000 tokens": 14.0,
    "fire at 800 tokens, twins": 22.0,
    "fire at 14000 tokens, twins": 27.0,
    "fire at 800 tokens, fp8": 10.0,
    "45 tokens, one by one": 330.0,
    "45 tokens, a draft that knows them": 95.0,
    "pi0.5 fused": 18.0,
    "GR00T as graphs": 12.0,
    "GR00T fused": 9.0,
    "8 robots' fires together": 96.0,
}
"""Medians on an H100, by counting kernels, bytes and multiplications, from before the first run."""

GPU_TESTS = (
    *(f"tests/models/test_{name}.py" for name in ("kernel_time", "graphs", "fp8")),
    *("tests/pounce_server/test_fused_gpu.py", "tests/ponder_server/test_captured_engine.py"),
)
"""The files that hold tests for a GPU."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """Networks and numbers of a day."""

    ponder: PonderConfig
    right_layers: int
    """Layers of the network that is compared between precisions; it must fit twice."""
    trained: PonderConfig
    pi05: AnyPounceConfig
    groot: AnyPounceConfig
    contexts: tuple[int, ...]
    fires: int
    text_tokens: int
    robots: tuple[int, ...]


def sizes(name: str) -> Size:
    """``full``: the paper's networks. ``tiny``: the same code in seconds on a CPU."""
    if name == "full":
        return Size(
            ponder=ponder_configs.qwen35_9b(),
            right_layers=8,
            trained=ponder_configs.qwen35_0p8b(),
            pi05=pounce_configs.pi05_base(num_carriers=8),
            groot=pounce_configs.groot_n1_5(num_carriers=8),
            contexts=(800, 4_000, 14_000),
            fires=30,
            text_tokens=45,
            robots=(1, 2, 4, 8),
        )
    tiny = replace(ponder_configs.tiny_cpu(), num_layers=4, image_px=(64, 64))
    return Size(
        ponder=tiny,
        right_layers=4,
        trained=tiny,
        pi05=pounce_configs.tiny_cpu(num_carriers=2),
        groot=pounce_configs.tiny_groot(num_carriers=2),
        contexts=(120,),
        fires=2,
        text_tokens=5,
        robots=(1, 2),
    )


class Day:
    """The rows of one stage, and how they are measured."""

    def __init__(self, device: torch.device, size: str, path: Path) -> None:
        self.device = device
        self.size = sizes(size)
        self.dtype: DTypeName = "bfloat16" if device.type == "cuda" else "float32"
        self.rows: dict[str, Any] = {}
        self._path = path
        self._of = f"{size} on {device.type}"
        self._predicted = PREDICTED_MS if size == "full" else {}

    def row(self, name: str, work: Callable[[], Result]) -> Result | None:
        """Runs ``work`` and keeps what it returns, or why it failed. Returns it, or None."""
        result = None
        try:
            result = work()
            self.rows[name] = result
        except Exception as error:
            self.fail(name, error)
        if isinstance(self.rows[name], dict) and name in self._predicted:
            self.rows[name]["predicted_p50_ms"] = self._predicted[name]
        print(f"  {name}: {json.dumps(self.rows[name])}", flush=True)
        self.write()
        return result

    def fail(self, name: str, error: Exception) -> None:
        where = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{type(error).__name__}: {error}"[:400]
        self.rows[name] = {"FAILED": what, "at": f"{where.name}:{where.lineno}"}

    def write(self, *, is_over: bool = False) -> None:
        date = time.strftime("%Y-%m-%d", time.gmtime())
        stage = {"of": self._of, "date": date, "git": git_version(), "is_over": is_over, "rows": self.rows}
        self._path.write_text(json.dumps(stage, indent=1) + "\n")

    def ms(self, call: Callable[[], object], count: int | None = None, after: Callable[[], None] = lambda: None) -> Any:
        """Durations of ``call``, to the end of the device's work; ``after`` each one runs uncounted."""
        took = []
        for index in range(2 + (count or self.size.fires)):
            start_s = time.perf_counter()
            call()
            if self.device.type == "cuda":
                torch.cuda.synchronize(self.device)
            if index >= 2:
                took.append(1e3 * (time.perf_counter() - start_s))
            after()
        p50, p95 = np.percentile(took, (50, 95), method="inverted_cdf")
        return {"n": len(took), "min_ms": round(min(took), 3), "p50_ms": round(p50, 3), "p95_ms": round(p95, 3)}

    def medians(self, calls: Mapping[str, Callable[[], object]]) -> dict[str, float]:
        """Each call's median [ms] of a few."""
        return {name: self.ms(call, 10)["p50_ms"] for name, call in calls.items()}

    def time(self, name: str, call: Callable[[], object], count: int | None = None, **after: Callable[[], None]) -> Any:
        """A row of :meth:`ms`."""
        return self.row(name, partial(self.ms, call, count, **after))

    def to(self, inputs: Any) -> Any:
        """A dataclass of tensors, on the device."""
        values = {field.name: getattr(inputs, field.name) for field in fields(inputs)}
        moved = {name: value.to(self.device) for name, value in values.items() if isinstance(value, Tensor)}
        return replace(inputs, **moved)


# -- stages


def probe(day: Day) -> None:
    """Versions, the machine's ceilings, and what the GPU path takes for granted."""
    device, dtype = day.device, getattr(torch, day.dtype)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
    day.row("machine", lambda: {"device": name, "torch": torch.__version__, "cuda": torch.version.cuda})
    day.row("ceilings", lambda: asdict(measure_ceilings(device, dtype)))
    capture = graphs_for(device) or directly
    system = torch.eye(64, device=device).expand(128, 64, 64).contiguous()
    solved = torch.empty_like(system)

    def solve() -> None:
        solved.copy_(torch.linalg.solve_triangular(system, system, upper=False, unitriangular=True))

    def solves() -> Any:
        replay = capture(solve)
        solved.fill_(float("nan"))
        replay()
        return {"is_right": bool(torch.equal(solved, system)), **day.ms(replay)}

    day.row("a triangular solve, captured", solves)
    for what, queries, keys in (("flow step", 160, 880), ("prefill", 6784, 848)):
        queries = queries if device.type == "cuda" else 16
        q, k = (torch.randn(1, 1, count, 256, device=device, dtype=dtype) for count in (queries, keys))
        bias = torch.zeros(1, 1, 1, keys, device=device, dtype=dtype)
        bias[..., -8:] = float("-inf")

        attend = partial(F.scaled_dot_product_attention, q, k, k, attn_mask=bias)
        day.time(f"attention of a pi0.5 {what}, heads as rows", attend, 5)
    if has_products(device):
        weight = torch.randn(12_288, 4096, device=device)  # of 9B's MLP, more than the card's cache holds
        rows_OI = quantise_eager(weight)
        for count in (1, 16, 160):
            x = torch.randn(count, 4096, device=device, dtype=torch.bfloat16)
            day.row(f"{count} rows times bfloat16 weights", partial(captured, partial(F.linear, x, weight.bfloat16())))
            if count <= FEW_ROWS and not missing_for(device):
                few = partial(few_rows_fused, x, *rows_OI)
                day.row(f"{count} rows times fp8 weights, our kernel", partial(captured, few))
            rows = quantise_eager(x)
            scales = {"scale_a": rows.scale_M[:, None], "scale_b": rows_OI.scale_M[None]}
            scaled = partial(
                torch._scaled_mm, rows.narrow_MI, rows_OI.narrow_MI.t(), out_dtype=torch.bfloat16, **scales
            )
            for is_fast in (False, True):
                name = f"{count} rows, an fp8 product, fast accumulation {is_fast}"
                day.row(name, partial(captured, partial(scaled, use_fast_accum=is_fast)))


def kernels(day: Day) -> None:
    """The tests that need a GPU, and PONDER's kernels beside their twins. A CPU runs none of them."""
    if day.device.type != "cuda":
        day.row("pytest -m gpu", lambda: "needs a GPU")
        return
    ponder = _random(day, replace(day.size.ponder, num_layers=4), getattr(torch, day.dtype))
    text_model, config = ponder.qwen.model.language_model, ponder.qwen.config.text_config
    tokens = max(day.size.contexts)
    memory = SlotMemory(config, num_slots=1, max_tokens=tokens, device=ponder.device, dtype=ponder.dtype)
    stack = Stack.of(text_model)

    def verdicts(length: int) -> dict[str, str]:
        samples = rehearse(stack, memory, num_rows=1, length=length)
        return told(choose(samples, PONDER_TWINS, KERNELS, cuda_time_ms)[1])

    with torch.inference_mode():
        for length in (1, 16, 160):
            day.row(f"PONDER's kernels, {length} tokens after {tokens}", partial(verdicts, length))
    options = ["-q", "--noconftest", "--continue-on-collection-errors", "-m", "gpu", "-p", "no:cacheprovider"]

    def run() -> str:
        command = [sys.executable, "-m", "pytest", *options, *GPU_TESTS]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=200)
        if done.returncode:
            raise RuntimeError(done.stdout[-350:])
        return done.stdout.strip().splitlines()[-1]

    day.row("pytest -m gpu", run)


def ponder_right(day: Day) -> None:
    """Cognition of one network by every way of computing it: relative L2 distances from eager float32."""
    config = replace(day.size.ponder, num_layers=day.size.right_layers)

    def cognition(dtype: torch.dtype, weights: WeightsName = "float", *, is_captured: bool = True) -> Tensor:
        ponder = _random(day, config, dtype)
        capture = (graphs_for(day.device) or directly) if is_captured else None
        options = EngineConfig(max_context_tokens=1024, max_sessions=1, weights=weights, graphs=is_captured)
        engine = QwenEngine(ponder, options, capture=capture)
        if is_captured:
            engine.warm_up()  # raises unless a replay is the same work run directly
        return engine._example_cognition().cpu()

    exact = cognition(torch.float32, is_captured=False)

    def change(dtype: torch.dtype, weights: WeightsName) -> float:
        return float((cognition(dtype, weights) - exact).norm() / exact.norm())

    day.row("captured float32", partial(change, torch.float32, "float"))
    day.row("captured bfloat16", partial(change, torch.bfloat16, "float"))
    day.row("captured bfloat16, fp8 weights", partial(change, torch.bfloat16, "fp8"))


def ponder_fire(day: Day) -> None:
    """A fire, two frames to a cognition on the host, beside its parts and the baseline: the context encoded again."""
    ponder = _ponder(day)
    longest = max(day.size.contexts)

    def fires(name: str, **options: Any) -> tuple[Frame, ...]:
        engine = _warm(day, ponder, longest, **options)
        day.row(f"kernels taken{name}", lambda: engine.spec.kernels or "none tried")
        frames = engine.example_frames()
        for length in day.size.contexts:
            context = _open(engine, "day", length)
            restore = partial(context.restore, context.save())
            day.time(f"fire at {length} tokens{name}", partial(engine.fire, "day", frames), after=restore)
            day.row(f"parts at {length} tokens{name}", partial(fire_parts, engine, "day", frames, day.medians))
            engine.close("day")
        day.row(f"trials{name}", lambda: trials(engine._runner._captured))
        return frames

    fires("")
    frames = fires(", twins", kernels=False)
    pictures = torch.from_numpy(np.stack(frames)).to(day.device)
    day.time("vision tower, two frames, not captured", partial(ponder.image_features, pictures))
    row, seen = _row(ponder, max(1, longest // sum(len(segment) for segment in ponder.format.query(2))))
    day.time(f"baseline: {len(row.ids)} tokens encoded again", partial(ponder.encode_row, row, seen), 3)
    fires(", fp8", weights="fp8")  # last: it replaces the network's layers


def ponder_text(day: Day) -> None:
    """A fire with a text of forced length: token by token, and with a draft that knows it."""
    ponder, count = _ponder(day), day.size.text_tokens
    said: list[int] = []

    def measure(draft: Draft | None = None) -> Any:
        engine = _warm(day, ponder, day.size.contexts[0] + 2 * count, draft)
        frames = engine.example_frames()
        context = _open(engine, "day", day.size.contexts[0])
        restore = partial(context.restore, context.save())

        def fire() -> None:
            said[:] = engine.fire("day", frames, force_text_tokens=count).texts[0].token_ids

        took = day.ms(fire, 3, after=restore)
        engine.close("day")
        return took

    day.row(f"{count} tokens, one by one", measure)
    day.row(f"{count} tokens, a draft that knows them", lambda: measure(TrieDraft([list(said)])))


def pounce(day: Day) -> None:
    """pi0.5, tensors to actions: eager, compiled, fused, and the mean difference of the actions."""
    model, inputs, noise = _pounce(day, day.size.pi05)
    table = model.step_table()

    def eager() -> Tensor:
        *_, last = model.sample(inputs, noise, table)
        return last.actions  # type: ignore[no-any-return]

    day.time("pi0.5 eager", eager)
    if day.device.type == "cuda":
        run = compiled_sampler(model, "compile")
        day.time("pi0.5 torch.compile", lambda: list(run(inputs, noise)), 10)
    _fused(day, "pi0.5", model, inputs, noise, eager().clone())


def groot(day: Day) -> None:
    """GR00T, tensors to actions: eager, prefill and steps as graphs, fused, and the mean difference of the actions."""
    model, inputs, noise = _pounce(day, day.size.groot)
    table = model.step_table()

    def eager() -> Tensor:
        *_, last = model.sample(inputs, noise, table)
        return last.actions  # type: ignore[no-any-return]

    day.time("GR00T eager", eager)
    capture = graphs_for(day.device) or directly
    cache: list[Any] = []
    x_BNA = noise.clone()

    def prefill() -> None:
        cache[:] = [model.prefill(inputs)]

    def steps() -> None:
        x_BNA.copy_(noise)
        for style in table.styles:
            x_BNA.add_(model.groot.velocity(x_BNA, style, cache[0]) / table.num_steps)

    def as_graphs() -> Any:
        replays = [capture(prefill), capture(steps)]
        return day.ms(lambda: [replay() for replay in replays])

    day.row("GR00T as graphs", as_graphs)
    _fused(day, "GR00T", model, inputs, noise, eager().clone())


def share(day: Day) -> None:
    """Queries of several robots that arrive together, until the last is answered."""
    ponder, most = _ponder(day), max(day.size.robots)
    engine = _warm(day, ponder, day.size.contexts[-1], max_sessions=most)
    frames = engine.example_frames()
    contexts = {f"robot {index}": _open(engine, f"robot {index}", day.size.contexts[-1]) for index in range(most)}
    opened = {name: context.save() for name, context in contexts.items()}

    def fires(count: int) -> None:
        for name in list(contexts)[:count]:
            engine.begin(name, frames)
        while count:
            count -= len([outcome.unwrap() for outcome in engine.step()])

    def restore() -> None:
        for name, context in contexts.items():
            context.restore(opened[name])

    for count in day.size.robots:
        name = "1 robot's fire" if count == 1 else f"{count} robots' fires together"
        day.time(name, partial(fires, count), after=restore)


def train(day: Day) -> None:
    """Forward and backward pass of a small PONDER over one long row, and of pi0.5 over one observation."""
    with torch.inference_mode(False), torch.enable_grad():
        ponder = Ponder.random(day.size.trained, seed=0, device=day.device, dtype=getattr(torch, day.dtype))
        row, seen = _row(ponder, 8)
        took = day.time("PONDER, one row", lambda: ponder.encode_row(row, seen).square().mean().backward(), 3)
        if took is not None:
            day.row("PONDER, tokens a second", lambda: round(1e3 * len(row.ids) / took["p50_ms"]))
        model, inputs, noise = _pounce(day, day.size.pi05)
        model.requires_grad_(True)
        loss = partial(model.loss, inputs, torch.zeros_like(noise), noise, torch.full((1,), 0.5, device=day.device))
        day.time("pi0.5, one observation", lambda: loss().backward(), 3)


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of the day."""

    run: Callable[[Day], None]
    budget_s: int


STAGES = {
    "probe": Stage(probe, 45),
    "kernels": Stage(kernels, 150),  # most of it compiles kernels
    "ponder_right": Stage(ponder_right, 90),
    "ponder_fire": Stage(ponder_fire, 200),
    "ponder_text": Stage(ponder_text, 75),
    "pounce": Stage(pounce, 150),
    "groot": Stage(groot, 60),
    "share": Stage(share, 150),  # most of it captures 130 graphs
    "train": Stage(train, 75),
}


# -- what the stages share


def _ponder(day: Day) -> Ponder:
    return _random(day, day.size.ponder, getattr(torch, day.dtype))


def _random(day: Day, config: PonderConfig, dtype: torch.dtype) -> Ponder:
    """A random network, whose weights are not hashed: that would take a minute, and nobody will ask for them again."""
    ponder = Ponder.random(config, seed=0, device=day.device, dtype=dtype)
    ponder.served_hash = "unhashed"
    return ponder


def _row(ponder: Ponder, queries: int) -> tuple[Row, Tensor]:
    """An episode's row of so many queries, and its pictures, which are black."""
    form = ponder.format
    row = form.row([*form.opening("go"), *(segment for _ in range(queries) for segment in form.query(2))])
    return row, torch.zeros(row.num_images, *ponder.image_px, 3, dtype=torch.uint8, device=ponder.device)


def _warm(day: Day, ponder: Ponder, tokens: int, draft: Draft | None = None, **options: Any) -> QwenEngine:
    """An engine with room for two queries after ``tokens``; ``options`` are more of `EngineConfig`'s."""
    config = EngineConfig(**{"max_sessions": 1, **options}, max_context_tokens=tokens + 600)
    engine = QwenEngine(ponder, config, draft)
    if day.device.type == "cuda":
        engine.warm_up()
    return engine


def _open(engine: QwenEngine, session: str, tokens: int) -> Any:
    """Opens a session and fills its context with meaningless tokens."""
    engine.open(session, Opening(instruction="pick up the red cube"))
    context = engine._episode(session).context
    context.fill(max(tokens, context.num_tokens))
    return context


def _fused(day: Day, name: str, model: Any, inputs: Any, noise: Tensor, expected: Tensor) -> None:
    """The fast path, which repacks the model's weights, and its mean difference from the ``expected`` actions."""
    is_fused = not missing_for(day.device) and day.device.type == "cuda"
    fused = fused_for(model, day.device) if is_fused else FusedPounce(model, TWINS)

    def sampled() -> Tensor:
        with current(day.device):
            *_, last = fused.sample(inputs, noise)
        return last.actions

    day.time(f"{name} fused", sampled)
    day.row(f"{name} parts", partial(sample_parts, fused, inputs, noise, day.medians))
    day.row(f"{name} kernels taken", lambda: fused.kernels or "none tried")
    day.row(f"{name} trials", partial(trials, fused))
    day.row(f"{name} fused against eager, mean", lambda: float((sampled() - expected).abs().mean()))


def _pounce(day: Day, config: AnyPounceConfig) -> tuple[Any, Any, Tensor]:
    """A random network, one observation with a prompt of 60 tokens, and noise."""
    model: Any = cast_streams(random_model(config, 0, day.device), day.dtype).eval().requires_grad_(False)
    noise = torch.randn(1, config.horizon, config.padded_action_dim, device=day.device)
    return model, day.to(config.example_inputs(1, num_tokens=60)), noise
