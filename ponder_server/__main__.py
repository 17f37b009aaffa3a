"""``ponder-serve``: System 2 as a daemon."""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from functools import partial

from model_server.daemon import serve_model
from model_server.ends import check_robots
from ponder_server.config import NUM_TORCH_THREADS, PonderOptions
from ponder_server.contract import BatchingEngine, PonderEngine
from ponder_server.fleet import PonderFleet
from ponder_server.serve import PonderServer
from protocol import files
from protocol.command_line import command, parse
from protocol.heartbeat import Heartbeat
from protocol.link import Link

log = logging.getLogger(__name__)


def build_engine(options: PonderOptions) -> BatchingEngine:
    """Loads or randomly initialises the model.

    Raises:
        OSError, ValueError: the folder is no checkpoint or does not fit, or there is no such device; the message says
            why.
    """
    import torch  # here, so that --help and a mistyped option respond immediately

    from dual_system.models.bfloat16 import warn_of_slow
    from dual_system.models.device import require_device
    from dual_system.models.ponder import configs
    from dual_system.models.ponder.checkpoint import load_ponder
    from dual_system.models.ponder.network import Ponder
    from ponder_server.draft import Draft, FirstOf, TrieDraft
    from ponder_server.engine import QwenEngine
    from ponder_server.engine_config import EngineConfig
    from ponder_server.mtp import MtpDraft
    from ponder_server.threads import num_usable_cores

    context, speed, robots = options.context, options.speed, options.robots
    max_sessions = robots.num_sessions
    check_robots((options.link.robot, *options.robots.other_robots))
    torch.set_num_threads(NUM_TORCH_THREADS)
    num_cores = num_usable_cores()
    if speed.attention_threads > num_cores:
        log.warning("--attention-threads %d: this process may use %d core(s)", speed.attention_threads, num_cores)
    require_device(options.device)
    if warning := warn_of_slow(options.dtype, options.device):
        log.warning("%s", warning)
    dtype = {"float32": torch.float32, "bfloat16": torch.bfloat16}[options.dtype]
    if options.checkpoint is not None:
        ponder = load_ponder(options.checkpoint, device=options.device, dtype=dtype)
    else:
        size = getattr(configs, options.random.size)()
        ponder = Ponder.random(size, seed=options.random.seed, device=options.device, dtype=dtype)
    trained = ponder.format.demonstrations
    to_its_end = context.demo_to_its_end or trained.to_its_end
    wanted = replace(trained, hz=context.demo_hz or trained.hz, to_its_end=to_its_end)
    ponder.format = replace(ponder.format, demonstrations=wanted)
    config = EngineConfig(
        max_context_tokens=context.max_context_tokens,
        when_full=context.when_full,
        max_sessions=max_sessions,
        max_text_tokens=context.max_text_tokens,
        max_batch_rows=robots.max_batch_rows,
        attention_threads=min(speed.attention_threads, num_cores),
        weights=speed.weights,
        graphs=speed.graphs,
        kernels=speed.kernels,
    )
    drafts: list[Draft] = []
    if speed.draft_texts is not None:
        lines = files.read_text(speed.draft_texts, "file of texts, one a line").splitlines()
        drafts.append(TrieDraft(ponder.format.vocabulary.encode(line) for line in lines if line.strip()))
    if speed.draft_tokens and ponder.mtp:
        drafts.append(MtpDraft(ponder, num_tokens=speed.draft_tokens))
    elif speed.draft_tokens:
        log.warning("--draft-tokens: these weights have no multi-token prediction (mtp.*); no text is drafted by it")
    return QwenEngine(ponder, config, FirstOf(drafts))


def build_official(options: PonderOptions) -> PonderEngine:
    """Loads the official release with its own code.

    Raises:
        FileNotFoundError, ValueError: no folder is given, or the official package is not installed.
    """
    from ponder_server.official import OfficialPonder

    if options.checkpoint is None:
        raise ValueError("--backend official needs the official folder; give it with --checkpoint")
    if options.robots.other_robots:
        raise ValueError("--backend official serves one robot; leave --other-robots out")
    return OfficialPonder(options.checkpoint, options.device)


def build_chat(options: PonderOptions) -> PonderEngine:
    """Waits for the chat endpoint.

    Raises:
        OSError, ValueError: an option is missing or does not apply, or the endpoint does not answer; the message says
            why.
    """
    from ponder_server.chat.build import build

    if options.checkpoint is not None:
        raise ValueError("--backend openai has no checkpoint: the endpoint loads --model; leave --checkpoint out")
    if options.robots.other_robots:
        raise ValueError("--backend openai serves one robot; leave --other-robots out")
    return build(options.chat)


@command("ponder-serve")
def main(argv: list[str] | None = None) -> int:
    options = parse(PonderOptions, argv, prog="ponder-serve")
    weights = str(options.checkpoint or f"random weights ({options.random.size})")
    if options.backend == "openai":
        weights = f"{options.chat.model} at an endpoint"
    if options.backend != "own":
        build = partial(build_official if options.backend == "official" else build_chat, options)
        return serve_model(
            "ponder", options.link, weights, build, PonderServer, options.operations, is_shadow=options.shadow
        )

    def make(link: Link, engine: BatchingEngine, heartbeat: Heartbeat, version: str) -> PonderServer | PonderFleet:
        if not options.robots.other_robots:
            return PonderServer(link, engine, heartbeat, version)
        return PonderFleet(link, engine, heartbeat, version, other_robots=options.robots.other_robots)

    return serve_model(
        "ponder",
        options.link,
        weights,
        lambda: build_engine(options),
        make,
        options.operations,
        is_shadow=options.shadow,
    )


if __name__ == "__main__":
    sys.exit(main())
