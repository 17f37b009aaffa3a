"""``ponder-serve``: System 2 as a daemon."""

from __future__ import annotations

import logging
import sys

import tyro

from ponder_server.config import NUM_TORCH_THREADS, PonderOptions
from ponder_server.contract import PonderEngine
from protocol.errors import TransportError
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.messages import ServingState
from protocol.process import StopFlag, host_clock_id, run, set_up_logging
from protocol.version import version
from protocol.zenoh_bus import open_bus

log = logging.getLogger("ponder-serve")


def build_engine(options: PonderOptions) -> PonderEngine:
    """Loads or draws the model.

    Raises:
        FileNotFoundError, ValueError: the checkpoint folder is not one, or does not fit; the message says why.
    """
    import torch  # here, so that --help and a mistyped option answer at once

    from ponder_server.engine import EngineConfig, QwenEngine
    from ponderpounce.models.ponder import Ponder
    from ponderpounce.models.ponder_checkpoint import load_ponder
    from ponderpounce.models.ponder_configs import tiny_cpu
    from ponderpounce.models.vocabulary import Vocabulary

    torch.set_num_threads(NUM_TORCH_THREADS)
    dtype = {"float32": torch.float32, "bfloat16": torch.bfloat16}[options.dtype]
    if options.checkpoint is not None:
        ponder = load_ponder(options.checkpoint, device=options.device, dtype=dtype)
    else:
        ponder = Ponder.random(tiny_cpu(), Vocabulary.tiny(), seed=options.seed, device=options.device, dtype=dtype)
    config = EngineConfig(
        max_context_tokens=options.max_context_tokens,
        max_sessions=options.max_sessions,
        max_text_tokens=options.max_text_tokens,
    )
    return QwenEngine(ponder, config)


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(PonderOptions, args=argv, prog="ponder-serve", description=PonderOptions.__doc__)
    set_up_logging()
    should_stop = StopFlag()
    try:
        bus = open_bus(options.link)
    except TransportError as error:
        print(f"ponder-serve: {error}", file=sys.stderr)
        return 2
    link = Link(bus, robot=options.link.robot, proc="ponder")
    heartbeat = Heartbeat(link, version(), host_clock_id())
    try:
        heartbeat.set(state=ServingState.LOADING, detail=str(options.checkpoint or "random weights"))
        try:
            engine = build_engine(options)
        except (OSError, ValueError) as error:
            heartbeat.set(state=ServingState.FAILED, detail=str(error)[:2000])
            print(f"ponder-serve: {error}", file=sys.stderr)
            return 2
        from ponder_server.serve import PonderServer

        server = PonderServer(link, engine, heartbeat, version())
        server.warm_up()
        server.ready()
        run(bus, server.step, should_stop)
        heartbeat.set(state=ServingState.CLOSING)
    finally:
        bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
