"""Latency of one PONDER query, and its growth with the context's length.

One fire takes two 256 px frames on the host to a cognition on the host, including vision tower, append, T gate and
copies. The same query is run at every context length, after which the context is restored, so that lengths do not
drift. The lengths take turns, so that a machine that slows down meanwhile affects all of them alike. The cost of the
longest context is compared with the time of its attention's products at this machine's speed for large matrices, in
the same run, precision and number of threads: a lower bound for any implementation.

Further tables: encoding the whole context again in one forward, the cost of a server without an append-only context; a
transition with a text of 45 tokens (the paper's), decoded token by token, with a perfect draft and with multi-token
prediction; the fire with narrow weights, int8 on a CPU and fp8 on a GPU; and an episode's opening with a long
demonstration, in a few large forwards and instant by instant. On a GPU forwards are CUDA graphs, and one more row has
the fire without them.

The networks have random weights: their speed is that of trained ones, their texts and accepted drafts are not.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.report import Report, Row, show, spread
from benchmarks.roofline import product_flops_per_s
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.ponder.checkpoint import mtp_shapes
from dual_system.models.ponder.context import Row as EpisodeRow
from dual_system.models.ponder.network import Ponder
from ponder_server.config import NUM_TORCH_THREADS
from ponder_server.contract import Opening, WeightsName
from ponder_server.draft import Draft, NoDraft, TrieDraft
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.mtp import MtpDraft
from protocol.command_line import parse

SESSION = "bench"
WAYS_TO_ENCODE = {"in forwards of 2048 tokens": 2048, "an instant a forward": 1}
ROUNDS = 5
TEXT_TOKENS = 45
DEMO_S = 48
"""Length of the demonstration; two 256 px views at 1 Hz are about 6.4K tokens."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyOptions:
    """One fire at growing contexts."""

    size: Literal["tiny_cpu", "qwen35_0p8b", "qwen35_2b", "qwen35_4b", "qwen35_9b"] = "tiny_cpu"
    device: str = "cpu"
    dtypes: tuple[Literal["float32", "bfloat16"], ...] | None = None
    """Number formats of the same network, one after the other. None: both on a CPU, bfloat16 on a GPU, whose memory
    two 9B networks in float32 would fill."""
    attention_threads: tuple[int, ...] = (1, 2)
    """Threads for attention, one run of fires each; torch and all other measurements use one thread."""
    contexts: tuple[int, ...] = (800, 4_000, 14_000)
    """Approximate tokens in the context before the fire."""
    fires: int = 60
    """Fires per context length, in several rounds, each after two uncounted ones."""
    encodes: int = 3
    """Encodings of the longest context without a cache."""
    texts: int = 5
    draft_tokens: int = 3
    """Tokens per draft of multi-token prediction."""


def main(argv: list[str] | None = None) -> int:
    options = parse(LatencyOptions, argv, prog="ponder-latency")
    torch.set_num_threads(NUM_TORCH_THREADS)
    report = Report(
        name="ponder_latency",
        question="How long does PONDER think about one query, and how does that grow with its context?",
        config=options,
        warm_up="two fires per context length and round; one encode of each kind; one text.",
    )
    tables: dict[str, list[Row]] = {}
    for dtype in _dtypes(options):
        with torch.inference_mode():
            for title, rows in _measured(dtype, options, report).items():
                tables.setdefault(title, []).extend({"dtype": dtype} | row for row in rows)
        report.tables.clear()
        for title, rows in tables.items():
            report.add_table(title, rows)
        report.write()  # already here: a run that is cut short leaves what it measured
    report.notes += [
        "The draft knows the text beforehand, which is the best a draft can do. In bfloat16 one token and sixteen are "
        "rounded further apart than a random network's likeliest tokens lie: its text goes another way than the draft.",
        "A step is the guessing and a forward that checks it: one certain token, and what was rightly guessed. "
        "Multi-token prediction has random weights too, and is hardly ever right: what it accepts, and so how long the "
        "text takes, says nothing of a trained head's; what a step costs does.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _measured(dtype: str, options: LatencyOptions, report: Report) -> dict[str, list[Row]]:
    """Rows of every table by its title, in one precision."""
    config = getattr(ponder_configs, options.size)()
    ponder = Ponder.random(config, seed=0, device=options.device, dtype=getattr(torch, dtype))
    ponder.mtp = _untrained_prediction(ponder)
    drafts: dict[str, Draft] = {
        "one by one": NoDraft(),
        "with a draft that knows it": TrieDraft([_own_text(ponder)]),
        f"with multi-token prediction, {options.draft_tokens} at a time": MtpDraft(
            ponder, num_tokens=options.draft_tokens
        ),
    }
    fires: list[Row] = []
    floors: list[Row] = []
    for threads in options.attention_threads:
        engine = _engine(ponder, options, attention_threads=threads)
        of_contexts = _fires(engine, options)
        fires += [_labelled(row, options, threads=threads) for row in of_contexts]
        floors.append({"attention_threads": threads} | _floor(engine, options, of_contexts, threads))
    first_p50_ms, longest_p50_ms = (float(fires[at]["p50_ms"] or 0) for at in (0, len(options.contexts) - 1))
    encode_ms = _encodes(ponder, options)
    size = engine.spec.session_bytes
    report.notes.append(
        f"{options.size} with random weights, {dtype} on {options.device}, one thread if nothing else is "
        f"said; a session of {max(options.contexts) + 600} tokens takes {size / 2**20:.1f} MiB."
    )
    if _is_on_gpu(options):
        eager = _engine(ponder, options, graphs=False)
        fires += [_labelled(row, options, graphs=False) for row in _fires(eager, options)]
    weights: WeightsName = "fp8" if _is_on_gpu(options) else "int8"
    # Another network, because its layers are replaced.
    another = Ponder.random(config, seed=0, device=options.device, dtype=getattr(torch, dtype))
    narrow = _engine(another, options, weights=weights)
    fires += [_labelled(row, options, weights=weights) for row in _fires(narrow, options)]
    took = "Each layer is widened as it is called, which takes the time."
    if weights == "fp8":
        took = "In bfloat16 a GPU with fp8 products takes these; elsewhere each layer is widened as it is called."
    report.notes.append(
        f"{weights} weights of this network change cognition by {narrow.spec.cognition_error:.1e} in {dtype} (relative "
        f"L2), which says nothing of a trained one. {took}"
    )
    return {
        "A cognition fire: two frames in, C_t out": fires,
        "What the longest context adds, and what its attention's products alone must take": floors,
        f"The longest context encoded again, every token of it ({max(options.contexts)} tokens)": [
            spread(encode_ms, "ms") | {"fires_per_encode": round(float(np.median(encode_ms)) / longest_p50_ms, 1)}
        ],
        f"A transition: the same, and a text of {TEXT_TOKENS} tokens": [
            {"decoded": name, **_texts(ponder, draft, options, first_p50_ms)} for name, draft in drafts.items()
        ],
        f"A demonstration of {DEMO_S} s, two views at 1 Hz, encoded when the episode is opened": [
            _demonstration(ponder, name, tokens, options) for name, tokens in WAYS_TO_ENCODE.items()
        ],
    }


def _dtypes(options: LatencyOptions) -> tuple[str, ...]:
    if options.dtypes is not None:
        return options.dtypes
    return ("bfloat16",) if _is_on_gpu(options) else ("float32", "bfloat16")


def _is_on_gpu(options: LatencyOptions) -> bool:
    return torch.device(options.device).type == "cuda"


def _labelled(
    row: Row, options: LatencyOptions, *, threads: int = 1, weights: WeightsName = "float", graphs: bool = True
) -> Row:
    """Adds the options to a row; graphs are mentioned only on a GPU."""
    engine: Row = {"engine": "ours graphs" if graphs else "ours eager"} if _is_on_gpu(options) else {}
    return {**engine, "weights": weights, "attention_threads": threads, **row}


def _engine(
    ponder: Ponder,
    options: LatencyOptions,
    draft: Draft | None = None,
    *,
    attention_threads: int = 1,
    weights: WeightsName = "float",
    graphs: bool = True,
) -> QwenEngine:
    config = EngineConfig(
        max_context_tokens=max(options.contexts) + 600,
        max_sessions=len(options.contexts),
        attention_threads=attention_threads,
        weights=weights,
        graphs=graphs,
    )
    return QwenEngine(ponder, config, draft)


def _fires(engine: QwenEngine, options: LatencyOptions) -> list[Row]:
    """A row per context length."""
    frames = _frames(engine, 2, seed=0)
    sessions = {context_tokens: f"{SESSION} {context_tokens}" for context_tokens in options.contexts}
    took_ms: dict[int, list[float]] = {context_tokens: [] for context_tokens in options.contexts}
    for context_tokens, session in sessions.items():
        _open(engine, context_tokens, session)
    for _ in range(ROUNDS):
        for context_tokens, session in sessions.items():
            fire = partial(engine.fire, session, frames)
            took_ms[context_tokens] += _timed(fire, engine, 2, -(-options.fires // ROUNDS), session)
    for session in sessions.values():
        engine.close(session)
    p50_ms = {context_tokens: float(np.median(took)) for context_tokens, took in took_ms.items()}
    return [
        {"context_tokens": context_tokens}
        | spread(took, "ms")
        | {"p50_against_first": round(p50_ms[context_tokens] / p50_ms[options.contexts[0]], 2)}
        for context_tokens, took in took_ms.items()
    ]


def _floor(engine: QwenEngine, options: LatencyOptions, fires: list[Row], threads: int) -> Row:
    """The longest context's extra time over the first one's, and its lower bound."""
    text = engine._ponder.qwen.config.text_config
    last = text.num_hidden_layers - 1
    num_read = 1 + engine.spec.num_carriers  # the last layer computes these only
    num_queries = [
        num_read if index == last else engine._num_query_ids
        for index, kind in enumerate(text.layer_types)
        if kind == "full_attention"
    ]
    num_keys = options.contexts[-1] - options.contexts[0]
    # Two products, queries x keys and weights x values, with a multiplication and an addition each.
    flop = 4 * sum(num_queries) * num_keys * text.num_attention_heads * text.head_dim
    torch.set_num_threads(threads)
    flop_per_ms = product_flops_per_s(engine._ponder.device, engine._ponder.dtype) / 1e3
    torch.set_num_threads(NUM_TORCH_THREADS)
    first_ms, longest_ms = (float(fires[at]["p50_ms"] or 0) for at in (0, -1))
    return {
        "more keys": num_keys,
        "adds_ms": round(longest_ms - first_ms, 2),
        "products_gflop": round(flop / 1e9, 2),
        "machine_gflop_per_s": round(flop_per_ms / 1e6),
        "products_ms": round(flop / flop_per_ms, 2),
        "least_p50_against_first": round(1 + flop / flop_per_ms / first_ms, 2),
    }


class _Watched:
    """A draft that records its proposals, each with the number of tokens written before."""

    def __init__(self, draft: Draft) -> None:
        self._draft = draft
        self.parts: Sequence[nn.Module] = draft.parts
        self.proposals: list[tuple[int, tuple[int, ...]]] = []

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        guesses = self._draft.propose(written, max_tokens, hidden_TH)
        self.proposals.append((len(written), guesses))
        return guesses


def _texts(ponder: Ponder, draft: Draft, options: LatencyOptions, fire_p50_ms: float) -> Row:
    """Measures texts. A step yields one known token and the accepted draft; all steps cost the text's extra time."""
    watched = _Watched(draft)
    engine = _engine(ponder, options, watched)
    frames = _frames(engine, 2, seed=0)
    _open(engine, options.contexts[0])
    said: list[tuple[int, ...]] = []

    def fire() -> None:
        watched.proposals.clear()
        said.append(engine.fire(SESSION, frames, force_text_tokens=TEXT_TOKENS).texts[0].token_ids)

    took_ms = _timed(fire, engine, 1, options.texts)
    engine.close(SESSION)
    num_guessed = sum(len(guesses) for _, guesses in watched.proposals)
    num_accepted = sum(_num_right(guesses, said[-1][written:]) for written, guesses in watched.proposals)
    num_steps = TEXT_TOKENS - num_accepted
    return {
        "guessed": num_guessed,
        "accepted": num_accepted,
        "steps": num_steps,
        **spread(took_ms, "ms"),
        "adds_ms_per_step": round((float(np.median(took_ms)) - fire_p50_ms) / num_steps, 2),
    }


def _num_right(guesses: Sequence[int], said: Sequence[int]) -> int:
    """Number of guesses before the first wrong one; ``said`` is at least as long."""
    return next((n for n, pair in enumerate(zip(guesses, said, strict=False)) if pair[0] != pair[1]), len(guesses))


def _untrained_prediction(ponder: Ponder) -> dict[str, Tensor]:
    """Random tensors of a multi-token prediction block for this network."""
    shapes = {name: tuple(tensor.shape) for name, tensor in ponder.qwen.state_dict().items()}
    generator = torch.Generator().manual_seed(0)
    return {
        name: torch.randn(shape, generator=generator) * (shape[-1] ** -0.5 if len(shape) > 1 else 0.1)
        for name, shape in mtp_shapes(ponder.qwen.config.text_config, shapes).items()
    }


def _encodes(ponder: Ponder, options: LatencyOptions) -> list[float]:
    """Encodes the whole context at once, through transformers' own forward without a cache."""
    form = ponder.format
    queries = max(1, max(options.contexts) // sum(len(segment) for segment in form.query(2)))
    row: EpisodeRow = form.row([*form.opening("go"), *(s for _ in range(queries) for s in form.query(2))])
    frames = torch.zeros(row.num_images, *ponder.image_px, 3, dtype=torch.uint8, device=ponder.device)
    took_ms = []
    for _ in range(1 + options.encodes):
        start_ns = time.perf_counter_ns()
        ponder.encode_row(row, frames)[-1].float().cpu()
        took_ms.append((time.perf_counter_ns() - start_ns) / 1e6)
    return took_ms[1:]


def _demonstration(ponder: Ponder, way: str, prefill_chunk_tokens: int, options: LatencyOptions) -> Row:
    config = EngineConfig(
        max_context_tokens=8192, max_sessions=1, max_prefixes=0, prefill_chunk_tokens=prefill_chunk_tokens
    )
    engine = QwenEngine(ponder, config)
    frames = _frames(engine, 2 * DEMO_S, seed=2)
    opening = Opening(instruction="do as shown", demo_frames=tuple(zip(frames[::2], frames[1::2], strict=True)))
    took_ms, num_tokens = [], 0
    for _ in range(1 + options.encodes):
        start_ns = time.perf_counter_ns()
        num_tokens = engine.open(SESSION, opening)
        took_ms.append((time.perf_counter_ns() - start_ns) / 1e6)
        engine.close(SESSION)
    row: Row = {"encoded": way, "tokens": num_tokens}
    return row | spread(took_ms[1:], "ms")


def _own_text(ponder: Ponder) -> tuple[int, ...]:
    """This network's forced text at the shortest context."""
    engine = QwenEngine(ponder, EngineConfig(max_context_tokens=2048, max_sessions=1))
    _open(engine, 800)
    return engine.fire(SESSION, _frames(engine, 2, seed=0), force_text_tokens=TEXT_TOKENS).texts[0].token_ids


def _open(engine: QwenEngine, context_tokens: int, session: str = SESSION) -> None:
    """Opens a session of about ``context_tokens`` tokens, filled by a demonstration of one view."""
    view_tokens = engine._format.num_image_tokens + 2
    demo = tuple((frame,) for frame in _frames(engine, max(1, context_tokens // view_tokens), seed=1))
    engine.open(session, Opening(instruction="pick up the red cube", demo_frames=demo))


def _frames(
    engine: QwenEngine, count: int, *, seed: int
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.uint8]], ...]:
    height, width = engine.spec.image_px
    return tuple(np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), dtype=np.uint8))


def _timed(
    fire: Callable[[], object], engine: QwenEngine, num_unmeasured: int, num_measured: int, session: str = SESSION
) -> list[float]:
    """Durations in ms; the context is restored before every fire and at the end."""
    context = engine._episode(session).context
    opened = context.save()
    took_ms = []
    for _ in range(num_unmeasured + num_measured):
        start_ns = time.perf_counter_ns()
        fire()
        took_ms.append((time.perf_counter_ns() - start_ns) / 1e6)
        context.restore(opened)
    return took_ms[num_unmeasured:]


if __name__ == "__main__":
    sys.exit(main())
