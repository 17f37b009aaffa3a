"""``ponder-serve``: System 2 as a daemon."""

from __future__ import annotations

import sys

import tyro

from clock.daemon import serve_model
from ponder_server.config import NUM_TORCH_THREADS, PonderOptions
from ponder_server.contract import PonderEngine
from ponder_server.serve import PonderServer


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
    weights = str(options.checkpoint or "random weights")
    return serve_model("ponder", options.link, weights, lambda: build_engine(options), PonderServer)


if __name__ == "__main__":
    sys.exit(main())
