"""``pounce-serve``: System 1 as a daemon."""

from __future__ import annotations

import logging
import sys

import tyro

from pounce_server.config import NUM_TORCH_THREADS, PounceOptions
from pounce_server.contract import PounceEngine
from protocol.errors import TransportError
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.messages import ServingState
from protocol.process import StopFlag, host_clock_id, run, set_up_logging
from protocol.version import version
from protocol.zenoh_bus import open_bus

log = logging.getLogger("pounce-serve")


def build_engine(options: PounceOptions) -> PounceEngine:
    """Loads or draws the model.

    Raises:
        FileNotFoundError, ValueError: the checkpoint folder is not one, or does not fit; the message says why.
    """
    import torch

    from ponderpounce.models.ponder_configs import tiny_cpu as tiny_ponder
    from ponderpounce.models.pounce_checkpoint import load_bundle, random_bundle
    from ponderpounce.models.pounce_configs import tiny_cpu
    from pounce_server.engine import Pi05Engine

    torch.set_num_threads(NUM_TORCH_THREADS)
    if options.checkpoint is not None:
        bundle = load_bundle(options.checkpoint, tokenizer=options.tokenizer)
    else:
        hidden_size = options.hidden_size or tiny_ponder().hidden_size
        bundle = random_bundle(tiny_cpu(num_carriers=options.num_carriers, cognition_size=hidden_size), options.seed)
    return Pi05Engine(bundle, device=options.device, dtype=options.dtype)


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(PounceOptions, args=argv, prog="pounce-serve", description=PounceOptions.__doc__)
    set_up_logging()
    should_stop = StopFlag()
    try:
        bus = open_bus(options.link)
    except TransportError as error:
        print(f"pounce-serve: {error}", file=sys.stderr)
        return 2
    link = Link(bus, robot=options.link.robot, proc="pounce")
    heartbeat = Heartbeat(link, version(), host_clock_id())
    try:
        heartbeat.set(state=ServingState.LOADING, detail=str(options.checkpoint or "random weights"))
        try:
            engine = build_engine(options)
        except (OSError, ValueError) as error:
            heartbeat.set(state=ServingState.FAILED, detail=str(error)[:2000])
            print(f"pounce-serve: {error}", file=sys.stderr)
            return 2
        from pounce_server.serve import PounceServer

        server = PounceServer(link, engine, heartbeat, version())
        server.warm_up()
        server.ready()
        run(bus, server.step, should_stop)
        heartbeat.set(state=ServingState.CLOSING)
    finally:
        bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
