"""``pounce-serve``: System 1 as a daemon."""

from __future__ import annotations

import logging
import sys
from functools import partial

from model_server.daemon import serve_model
from model_server.ends import check_robots
from pounce_server.config import NUM_TORCH_THREADS, PounceOptions
from pounce_server.contract import BatchingEngine, PounceEngine
from pounce_server.fleet import PounceFleet
from pounce_server.serve import PounceServer
from protocol.command_line import command, parse
from protocol.heartbeat import Heartbeat
from protocol.link import Link

log = logging.getLogger(__name__)


def build_engine(options: PounceOptions) -> BatchingEngine:
    """Loads or randomly initialises the model.

    Raises:
        OSError, ValueError: the folder is no checkpoint or does not fit, or there is no such device; the message says
            why.
    """
    import torch

    from dual_system.models.bfloat16 import warn_of_slow
    from dual_system.models.device import require_device
    from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
    from dual_system.models.pounce.checkpoint import load_bundle, random_bundle
    from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
    from dual_system.models.pounce.family import family_of_config
    from pounce_server.engine import EagerEngine

    check_robots((options.link.robot, *options.robots.other_robots))
    if options.robots.max_batch_rows < 1:
        raise ValueError(f"--max-batch-rows {options.robots.max_batch_rows}: expected at least 1")
    torch.set_num_threads(NUM_TORCH_THREADS)
    require_device(options.device)
    if warning := warn_of_slow(options.dtype, options.device):
        log.warning("%s", warning)
    if options.checkpoint is not None:
        bundle = load_bundle(options.checkpoint, tokenizer=options.tokenizer)
        family = family_of_config(bundle.model.config)
        if options.random.family not in (None, family):
            raise ValueError(
                f"checkpoint {options.checkpoint} holds {family}; leave --family {options.random.family} out"
            )
    else:
        hidden_size = options.random.hidden_size or tiny_ponder().hidden_size
        tiny = tiny_groot if options.random.family == "groot" else tiny_cpu
        bundle = random_bundle(
            tiny(num_carriers=options.random.num_carriers, cognition_size=hidden_size),
            options.random.seed,
            device=options.device,
        )
    return EagerEngine(
        bundle,
        device=options.device,
        dtype=options.dtype,
        continuity=options.chunks.continuity,
        path=options.speed.path,
        rolls_forward=options.chunks.roll_forward,
        weights=options.speed.weights,
        autotune=options.speed.autotune,
    )


def build_official(options: PounceOptions) -> PounceEngine:
    """Loads the official release with its own code.

    Raises:
        FileNotFoundError, ValueError: no folder is given, or the official package is not installed.
    """
    from pounce_server.official import OfficialPounce

    if options.checkpoint is None:
        raise ValueError("--backend official needs the official folder; give it with --checkpoint")
    if options.robots.other_robots:
        raise ValueError("--backend official serves one robot; leave --other-robots out")
    return OfficialPounce(options.checkpoint, options.device)


def build_remote(options: PounceOptions) -> PounceEngine:
    """Waits for a policy server and compares its first answer with the mapping file.

    Raises:
        OSError, ValueError: no mapping file, no server, or another answer than the file says.
    """
    from pounce_server.remote.build import build

    if options.checkpoint is not None:
        raise ValueError(f"--backend {options.backend}: its server has the weights; leave --checkpoint out")
    if options.robots.other_robots:
        raise ValueError(f"--backend {options.backend} serves one robot; leave --other-robots out")
    return build(options.backend, options.remote)


@command("pounce-serve")
def main(argv: list[str] | None = None) -> int:
    options = parse(PounceOptions, argv, prog="pounce-serve")
    weights = str(options.remote.url or options.checkpoint or "random weights")
    if options.backend != "own":
        build = partial(build_official if options.backend == "official" else build_remote, options)
        return serve_model(
            "pounce", options.link, weights, build, PounceServer, options.operations, is_shadow=options.shadow
        )

    def make(link: Link, engine: BatchingEngine, heartbeat: Heartbeat, version: str) -> PounceServer | PounceFleet:
        others, max_rows = options.robots.other_robots, options.robots.max_batch_rows
        if not others:
            return PounceServer(link, engine, heartbeat, version)
        return PounceFleet(link, engine, heartbeat, version, other_robots=others, max_batch_rows=max_rows)

    return serve_model(
        "pounce",
        options.link,
        weights,
        lambda: build_engine(options),
        make,
        options.operations,
        is_shadow=options.shadow,
    )


if __name__ == "__main__":
    sys.exit(main())
