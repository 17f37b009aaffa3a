"""``pp-enlarge``: a pair from scratch goes on with a larger PONDER, that sees more, and does what it did before.

The networks are larger (`growing`), and the eye may look at more of the picture, or finer (`wide_eyes`); what is new
has to be trained: `pp-see --ponder` for the eye, then `pp-train`. Pretrained models need nothing of this.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.pounce.checkpoint import load_bundle, save_bundle
from dual_system.training.growing import broadened, grown, reading_more, seeing_deeper
from dual_system.training.places import TEXT_PX
from dual_system.training.wide_eyes import wide_eyed

DONE, REFUSED = 0, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class EnlargeOptions:
    """Writes a larger PONDER that says and thinks what the given one does, and a POUNCE that reads it."""

    ponder: Path
    pounce: Path
    out: Path
    """OUT/ponder and OUT/pounce are written."""
    hidden_size: int | None = None
    """Numbers of the residual stream, with as many times the heads; None: as they are."""
    ffn_size: int | None = None
    """Neurons of an MLP; None: as many times as the stream's numbers."""
    layers: int = 0
    """So many more, copies of the last ones."""
    eye_layers: int = 0
    """So many more of the vision tower, copies of the last ones."""
    box: tuple[int, int, int, int] | None = None
    """What the eye is to look at: top, left, bottom and right in a 256 px picture, whole tokens from where it did."""
    zoom: int = 1
    """So many times as fine."""
    seed: int = 0


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(EnlargeOptions, args=argv, prog="pp-enlarge", description=EnlargeOptions.__doc__)
    try:
        enlarge(options)
    except (OSError, ValueError) as error:
        sys.stderr.write(f"pp-enlarge: {error}\n")
        return REFUSED
    return DONE


def enlarge(options: EnlargeOptions) -> None:
    """Writes the pair. Raises OSError or ValueError if what was given does not fit."""
    if (options.out / "ponder").exists():
        raise ValueError(f"{options.out} holds a pair already; use another --out")
    ponder, bundle = load_ponder(options.ponder), load_bundle(options.pounce)
    if options.box is not None or options.zoom != 1:
        eyes = ponder.format.eyes
        before = eyes[0].box if eyes else (0.0, 0.0, 1.0, 1.0)
        top, left, bottom, right = before if options.box is None else [side / TEXT_PX for side in options.box]
        ponder = wide_eyed(ponder, (top, left, bottom, right), options.zoom)
    text = ponder.qwen.config.text_config
    if options.hidden_size is not None or options.ffn_size is not None:
        hidden_size = options.hidden_size or text.hidden_size
        ffn_size = options.ffn_size or text.intermediate_size * hidden_size // text.hidden_size
        ponder = broadened(ponder, hidden_size, ffn_size, seed=options.seed)
    if options.layers:
        ponder = grown(ponder, options.layers)
    if options.eye_layers:
        ponder = seeing_deeper(ponder, options.eye_layers)
    save_ponder(ponder, options.out / "ponder")
    save_bundle(reading_more(bundle, ponder.hidden_size), options.out / "pounce")


if __name__ == "__main__":
    sys.exit(main())
