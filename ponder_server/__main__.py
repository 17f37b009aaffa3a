"""``ponder-serve``: System 2 as a daemon."""

from __future__ import annotations

import logging
import sys
from functools import partial

import tyro

from clock.daemon import serve_model
from ponder_server.config import NUM_TORCH_THREADS, PonderOptions
from ponder_server.contract import BatchingEngine
from ponder_server.fleet import PonderFleet
from ponder_server.serve import PonderServer
from protocol.heartbeat import Heartbeat
from protocol.link import Link

log = logging.getLogger(__name__)


def build_engine(options: PonderOptions) -> BatchingEngine:
    """Loads or draws the model.

    Raises:
        FileNotFoundError, ValueError: the checkpoint folder is not one, or does not fit; the message says why.
    """
    import torch  # here, so that --help and a mistyped option answer at once

    from dual_system.models.bfloat16 import warn_of_slow
    from dual_system.models.ponder import configs as ponder_configs
    from dual_system.models.ponder.checkpoint import load_ponder
    from dual_system.models.ponder.network import Ponder
    from ponder_server.council import Council
    from ponder_server.draft import Draft, FirstOf, TrieDraft
    from ponder_server.engine import QwenEngine
    from ponder_server.engine_config import EngineConfig
    from ponder_server.mtp import MtpDraft
    from ponder_server.threads import num_usable_cores

    num_robots = 1 + len(options.other_robots)
    if options.max_sessions < num_robots:
        raise ValueError(f"{num_robots} robots need as many sessions: --max-sessions is {options.max_sessions}.")
    torch.set_num_threads(NUM_TORCH_THREADS)
    num_cores = num_usable_cores()
    if options.attention_threads > num_cores:
        log.warning("--attention-threads %d: this process may use %d core(s)", options.attention_threads, num_cores)
    if warning := warn_of_slow(options.dtype, options.device):
        log.warning("%s", warning)
    dtype = {"float32": torch.float32, "bfloat16": torch.bfloat16}[options.dtype]
    if options.checkpoint is not None:
        ponder = load_ponder(options.checkpoint, device=options.device, dtype=dtype)
    else:
        size = getattr(ponder_configs, options.size)()
        ponder = Ponder.random(size, seed=options.seed, device=options.device, dtype=dtype)
    counsel, form = ponder.format.counsel, ponder.format
    num_views = 1 if counsel is None else counsel.num_views
    config = EngineConfig(
        max_context_tokens=options.max_context_tokens,
        when_full=options.when_full,
        max_sessions=options.max_sessions * num_views,
        max_text_tokens=options.max_text_tokens,
        max_batch_rows=options.max_batch_rows,
        attention_threads=min(options.attention_threads, num_cores),
        weights=options.weights,
        graphs=options.graphs,
    )
    drafts: list[Draft] = []
    if options.draft_texts is not None:
        lines = options.draft_texts.read_text(encoding="utf-8").splitlines()
        drafts.append(TrieDraft(ponder.format.vocabulary.encode(line) for line in lines if line.strip()))
    if options.draft_tokens and ponder.mtp:
        drafts.append(MtpDraft(ponder, num_tokens=options.draft_tokens))
    elif options.draft_tokens:
        log.warning(
            "--draft-tokens: these weights have no multi-token prediction (mtp.*); texts are written without it"
        )
    engine = QwenEngine(ponder, config, FirstOf(drafts))
    if counsel is None:
        return engine
    views_of = partial(counsel.views, form.eyes, ponder.image_px)
    return Council(engine, counsel, views_of, max_sessions=options.max_sessions)


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(PonderOptions, args=argv, prog="ponder-serve", description=PonderOptions.__doc__)
    weights = str(options.checkpoint or f"random weights ({options.size})")

    def make(link: Link, engine: BatchingEngine, heartbeat: Heartbeat, version: str) -> PonderServer | PonderFleet:
        if not options.other_robots:
            return PonderServer(link, engine, heartbeat, version)
        return PonderFleet(
            link,
            engine,
            heartbeat,
            version,
            other_robots=options.other_robots,
            latency_budget_ns=options.latency_budget_ms * 1_000_000,
        )

    return serve_model("ponder", options.link, weights, lambda: build_engine(options), make)


if __name__ == "__main__":
    sys.exit(main())
