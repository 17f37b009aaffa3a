"""Latency of one POUNCE invocation, and its parts: the prefix, and the flow steps.

Two shapes: the paper's (appendix D: three views of 224 px, 60 tokens of prompt, 10 flow steps, 20 rows, K = 8) and
RoboMME's (two views, K = 1, each model's own number of steps). A row is a way to generate one chunk, from tensors on
the device to actions on the host; the engine's rows start from pictures and text instead, as ``pounce-serve`` does. All
ways of one model, shape and batch take turns, so that a busy moment affects all of them.

The networks have random weights: their speed is that of trained ones, their actions are not.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from benchmarks.report import Report, Row, show, spread
from benchmarks.roofline import Ceilings, measure_ceilings, piece_of
from dual_system.models import flow
from dual_system.models.groot import flow as groot_flow
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pounce.checkpoint import random_bundle
from dual_system.models.pounce.configs import groot_n1_5, pi05_base, tiny_cpu, tiny_groot
from dual_system.models.pounce.family import AnyPounce, AnyPounceConfig, Family, random_model
from dual_system.models.pounce.precision import cast_streams
from pounce_server.contract import DTypeName, example_request
from pounce_server.engine import EagerEngine
from pounce_server.fused import FusedPounce, fused_for
from pounce_server.int8 import quantise
from protocol.command_line import parse

CompileMode = Literal["default", "reduce-overhead", "max-autotune"]
Call = Callable[[], Tensor | None]

EAGER, NAIVE, BARE, FUSED = "eager", "prefix again at every step", "eager, no cognition (K = 0)", "fused"
PROMPT_TOKENS = 60
HORIZON = 20
_CONFIGS: dict[tuple[Family, str], Callable[..., AnyPounceConfig]] = {
    ("pi05", "tiny"): tiny_cpu,
    ("pi05", "full"): pi05_base,
    ("groot", "tiny"): tiny_groot,
    ("groot", "full"): groot_n1_5,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyOptions:
    """POUNCE invocations of both families, way by way."""

    size: Literal["tiny", "full"] = "tiny"
    device: str = "cpu"
    dtype: DTypeName = "float32"
    threads: int = 1
    families: tuple[Family, ...] = ("pi05", "groot")
    batches: tuple[int, ...] = (1, 4)
    rounds: int = 60
    """Rounds; each measures every way once, in rotating order."""
    warm_up_rounds: int = 5
    compile_modes: tuple[CompileMode, ...] | None = None
    """Modes of torch.compile to measure, at the paper's shape and batch 1. None: "default" on a CPU, all on a GPU."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    name: str
    num_cameras: int
    num_carriers: int
    num_steps: int | None
    """None: the family's own number."""
    is_compiled: bool

    def config(self, family: Family, size: str, *, has_cognition: bool = True) -> AnyPounceConfig:
        make = _CONFIGS[family, size]
        config = make(num_carriers=self.num_carriers if has_cognition else 0, horizon=HORIZON)
        steps = self.num_steps or config.num_steps
        return replace(config, num_cameras=self.num_cameras, num_steps=steps)


SHAPES = (
    Shape(name="paper", num_cameras=3, num_carriers=8, num_steps=10, is_compiled=True),
    Shape(name="RoboMME", num_cameras=2, num_carriers=1, num_steps=None, is_compiled=False),
)


class Ways:
    """One model and one batch of inputs, and the ways to generate chunks from them."""

    def __init__(self, model: AnyPounce, batch_size: int, device: torch.device) -> None:
        config = model.config
        self._network = model.pi05 if isinstance(model, Pounce) else model.groot
        self._euler = flow.euler if isinstance(model, Pounce) else groot_flow.euler
        self._table: Any = model.step_table()
        self._inputs = _moved(config.example_inputs(batch_size, num_tokens=PROMPT_TOKENS), device)
        shape = (batch_size, config.horizon, config.padded_action_dim)
        self._noise = torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(device)
        self._prefill: Callable[..., Any] = model.prefill
        self._velocity: Callable[..., Tensor] = self._network.velocity
        self._cache = self._prefill(self._inputs)

    def compiled(self, mode: CompileMode) -> Call:
        """Prefix and step compiled separately, as both are reused; shapes are constants."""
        prefill, velocity = (torch.compile(part, mode=mode, dynamic=False) for part in (self._prefill, self._velocity))

        def chunk() -> Tensor:
            torch.compiler.cudagraph_mark_step_begin()
            cache = prefill(self._inputs)
            return self._integrated(lambda index, x: velocity(x, self._table.styles[index], cache).clone())

        return chunk

    def fused(self, model: AnyPounce, device: torch.device) -> Call:
        """Packs the model's weights; the eager ways then use views of them."""
        fused: FusedPounce = fused_for(model, device)

        def chunk() -> Tensor:
            *_, last = fused.sample(self._inputs, self._noise)
            return last.actions.cpu()

        return chunk

    def least_ms(self, ceilings: Ceilings) -> float:
        """The roofline of a whole invocation: the prefix once, and all steps."""
        prefix, step = piece_of(self.prefix), piece_of(self.one_step)
        return prefix.least_ms(ceilings) + self._table.num_steps * step.least_ms(ceilings)

    def eager(self) -> Tensor:
        cache = self._prefill(self._inputs)
        return self._integrated(lambda index, x: self._velocity(x, self._table.styles[index], cache))

    def naive(self) -> Tensor:
        """A sampler without a prefix cache: it computes the prefix at every flow step."""
        return self._integrated(lambda index, x: self._velocity(x, self._table.styles[index], self._again()))

    def prefix(self) -> None:
        self._prefill(self._inputs)

    def one_step(self) -> None:
        self._velocity(self._noise, self._table.styles[0], self._cache)

    def all_steps(self) -> None:
        self._integrated(lambda index, x: self._velocity(x, self._table.styles[index], self._cache))

    def _again(self) -> Any:
        return self._prefill(self._inputs)

    def _integrated(self, velocity_at: Callable[[int, Tensor], Tensor]) -> Tensor:
        steps: Iterator[flow.EulerStep] = self._euler(velocity_at, self._noise, self._table.num_steps)
        *_, last = steps
        return last.actions.cpu()


def main(argv: list[str] | None = None) -> int:
    options = parse(LatencyOptions, argv, prog="pounce-latency")
    torch.set_num_threads(options.threads)
    is_usual = (options.size, options.device, options.dtype) == ("tiny", "cpu", "float32")
    report = Report(
        name="pounce_latency" if is_usual else f"pounce_latency_{options.size}_{options.device}_{options.dtype}",
        question="How long does POUNCE think about one invocation, and what of that is the prefix, what the flow?",
        config=options,
        warm_up=f"{options.warm_up_rounds} rounds of everything; compilation.",
    )
    invocations: list[Row] = []
    parts: list[Row] = []
    ratios: list[Row] = []
    modes = _compile_modes(options, report.notes)
    with torch.inference_mode():
        dtype = {"float32": torch.float32, "bfloat16": torch.bfloat16}[options.dtype]
        ceilings = measure_ceilings(torch.device(options.device), dtype)
        for family in options.families:
            for shape in SHAPES:
                found = _measure(family, shape, options, modes if shape.is_compiled else (), report.notes, ceilings)
                for rows, new in zip((invocations, parts, ratios), found, strict=True):
                    rows += new
    report.add_table(
        "One invocation, noise to actions; the error is against eager float32, normalised actions", invocations
    )
    report.add_table("What an eager invocation consists of", parts)
    report.add_table("Ratios and differences of this run's p50", ratios)
    report.notes += _notes(options, ceilings)
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _measure(
    family: Family,
    shape: Shape,
    options: LatencyOptions,
    modes: tuple[CompileMode, ...],
    notes: list[str],
    ceilings: Ceilings,
) -> tuple[list[Row], list[Row], list[Row]]:
    """The rows of the three tables."""
    device = torch.device(options.device)
    bundle = random_bundle(shape.config(family, options.size), 0, device=device)
    model = bundle.model.to(device).eval()
    exact = {batch: Ways(model, batch, device).eager() for batch in options.batches}
    cast_streams(model, options.dtype)
    without = random_model(shape.config(family, options.size, has_cognition=False), 0, device).eval()
    cast_streams(without, options.dtype)
    engine = EagerEngine(bundle, device=options.device, dtype=options.dtype)
    narrow = random_model(shape.config(family, options.size), 0, device).eval() if device.type == "cpu" else None
    if narrow is not None:
        quantise(narrow)
        cast_streams(narrow, options.dtype)
    invocations: list[Row] = []
    parts: list[Row] = []
    ratios: list[Row] = []
    for batch in options.batches:
        ways = Ways(model, batch, device)
        calls: dict[str, Call] = {EAGER: ways.eager, BARE: Ways(without, batch, device).eager, NAIVE: ways.naive}
        if narrow is not None:
            calls["eager, int8 weights"] = Ways(narrow, batch, device).eager
        if batch == 1:
            calls |= _compiled(ways, modes, f"{family}, {shape.name}", notes)
        if device.type == "cuda":  # Triton's interpreter is not worth timing
            calls[FUSED] = ways.fused(model, device)
        calls |= _engine_call(engine, batch)
        steps = f"{model.config.num_steps} steps"
        pieces: dict[str, Call] = {"prefix": ways.prefix, "1 step": ways.one_step, steps: ways.all_steps}
        least_ms = ways.least_ms(ceilings)
        took_ms = _in_turns(calls | pieces, options, device)
        eager_p50_ms = _p50(took_ms[EAGER])
        of: Row = {"model": family, "shape": shape.name, "batch": batch}
        for name, call in calls.items():
            ratio = round(_p50(took_ms[name]) / eager_p50_ms, 2)
            is_same_network = not name.startswith("engine") and name != BARE
            error = _mae(call(), exact[batch]) if is_same_network else None
            share = round(least_ms / _p50(took_ms[name]), 3) if is_same_network else None
            judged: Row = {"of_eager": ratio, "of_roofline": share, "mae": error}
            invocations.append(of | {"way": name} | spread(took_ms[name], "ms") | judged)
        parts += [
            of
            | {"part": name}
            | spread(took_ms[name], "ms")
            | {"of_eager": round(_p50(took_ms[name]) / eager_p50_ms, 2)}
            for name in pieces
        ]
        ratios.append(of | _ratios({name: _p50(values) for name, values in took_ms.items()}, steps))
    return invocations, parts, ratios


def _ratios(p50_ms: dict[str, float], steps: str) -> Row:
    """Effect of the flow steps, the cache, the cognition and the kernels on an invocation."""
    compiled = [value for name, value in p50_ms.items() if name.startswith("torch.compile")]
    fused = p50_ms.get(FUSED)
    return {
        "all_steps_of_1_step": round(p50_ms[steps] / p50_ms["1 step"], 2),
        "prefix_again_of_once": round(p50_ms[NAIVE] / p50_ms[EAGER], 2),
        "cognition_ms": round(p50_ms[EAGER] - p50_ms[BARE], 3),
        "best_compile_of_fused": round(min(compiled) / fused, 2) if fused and compiled else None,
    }


def _engine_call(engine: EagerEngine, batch: int) -> dict[str, Call]:
    requests = [example_request(engine.spec, seed=seed) for seed in range(batch)]

    def invoke() -> None:
        engine.invoke_many(requests)

    return {"engine, from pictures and text": invoke}


def _compile_modes(options: LatencyOptions, notes: list[str]) -> tuple[CompileMode, ...]:
    is_cpu = torch.device(options.device).type == "cpu"
    if is_cpu and not any(map(shutil.which, ("c++", "g++", "clang++"))):
        notes.append("torch.compile was not measured: no C++ compiler here.")
        return ()
    if options.compile_modes is not None:
        return options.compile_modes
    return ("default",) if is_cpu else ("default", "reduce-overhead", "max-autotune")


def _compiled(ways: Ways, modes: tuple[CompileMode, ...], what: str, notes: list[str]) -> dict[str, Call]:
    """The modes that compile; a note gives the compile time or the failure."""
    calls: dict[str, Call] = {}
    for mode in modes:
        name, call = f"torch.compile, {mode}", ways.compiled(mode)
        start_s = time.monotonic()
        try:
            call()
        except Exception as error:  # a compiler may raise anything; keep the other rows
            notes.append(f"{name} failed for {what}: {type(error).__name__}.")
            continue
        notes.append(f"{name} took {time.monotonic() - start_s:.0f} s for {what}.")
        calls[name] = call
    return calls


def _in_turns(calls: dict[str, Call], options: LatencyOptions, device: torch.device) -> dict[str, list[float]]:
    """Milliseconds of every call in every round."""
    took_ms: dict[str, list[float]] = {name: [] for name in calls}
    order = list(calls)
    for _ in range(options.warm_up_rounds + options.rounds):
        for name in order:
            start_ns = time.perf_counter_ns()
            calls[name]()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            took_ms[name].append((time.perf_counter_ns() - start_ns) / 1e6)
        order.append(order.pop(0))
    return {name: values[options.warm_up_rounds :] for name, values in took_ms.items()}


def _p50(took_ms: list[float]) -> float:
    return sorted(took_ms)[(len(took_ms) - 1) // 2]


def _mae(actions_BNA: Tensor | None, exact_BNA: Tensor) -> float | None:
    """Mean absolute error over all dims of the network's actions."""
    return None if actions_BNA is None else float(f"{(actions_BNA - exact_BNA).abs().mean().item():.1e}")


def _moved(inputs: Any, device: torch.device) -> Any:
    tensors = {name: getattr(inputs, name) for name in inputs.__dataclass_fields__}
    return replace(inputs, **{name: value.to(device) for name, value in tensors.items() if value is not None})


def _notes(options: LatencyOptions, ceilings: Ceilings) -> list[str]:
    where = options.device if options.device == "cpu" else torch.cuda.get_device_name(options.device)
    return [
        f"Both families at {options.size} size with random weights, {options.dtype} on {where}, {options.threads} "
        "thread(s).",
        f'"{NAIVE}" is the same sampler without its cache; of_eager is a ratio of two p50 of this run.',
        "of_roofline: least time over p50, with this device's best in this run: "
        f"{ceilings.flops_per_s / 1e9:.0f} GFLOP/s in one large product, {ceilings.bytes_per_s / 1e9:.1f} GB/s in one "
        "large copy.",
        f'"{FUSED}" is measured on a GPU only; on a CPU its kernels run in Triton\'s interpreter, which tests do.',
        "pi0.5 takes 10 steps in either shape, GR00T 10 in the paper's and its own 4 in RoboMME's.",
        "The engine's rows have a longer prompt than 60 tokens, and count the resizing of their pictures.",
    ]


if __name__ == "__main__":
    sys.exit(main())
