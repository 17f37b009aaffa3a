"""``pp-widen``: a pair from scratch is taken over to the texts of more tasks, before it learns them.

Its tokenizers know the words of what it has learned, and spell the others byte by byte. PONDER's gets pieces for them
on rows that were unused; every id keeps its meaning. POUNCE's is trained anew on all instructions, and its words are
drawn anew: it reads one sentence an episode, and acts by cognition. Pretrained models need nothing of this.
"""

from __future__ import annotations

import copy
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

from dual_system.data.errors import DatasetError
from dual_system.models.pi05.prompt import tokenizer_of_instructions
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle, save_bundle
from dual_system.training.data import TrainingSet
from dual_system.training.in_words import told_in_words

DONE, REFUSED = 0, 2
_TABLES = {"model.language_model.embed_tokens.weight", "lm_head.weight"}


@dataclass(frozen=True, slots=True, kw_only=True)
class WidenOptions:
    """Gives a pair words for the tasks of further data."""

    ponder: Path
    pounce: Path
    data: tuple[Path, ...]
    """Folders that pp-collect made, of all tasks that the pair is to know."""
    out: Path
    """OUT/ponder and OUT/pounce are what `pp-train --ponder --pounce` goes on from."""
    pieces: int = 0
    """Rows to add to PONDER's table for words, where no id is free any more."""
    seed: int = 0


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(WidenOptions, args=argv, prog="pp-widen", description=WidenOptions.__doc__)
    try:
        widen(options)
    except (DatasetError, OSError, ValueError) as error:
        sys.stderr.write(f"pp-widen: {error}\n")
        return REFUSED
    return DONE


def widen(options: WidenOptions) -> None:
    """Writes the pair. Raises DatasetError, OSError or ValueError if what was given does not fit."""
    if options.pieces < 0:
        raise ValueError(f"--pieces {options.pieces}: a number of rows, or 0 for none")
    if (options.out / "ponder").exists():
        raise ValueError(f"{options.out} holds a pair already; use another --out")
    data = TrainingSet(*options.data)
    ponder = with_more_rows(load_ponder(options.ponder), options.pieces)
    save_ponder(widened(ponder, data.texts()), options.out / "ponder")
    bundle = load_bundle(options.pounce)
    tokenizer = tokenizer_of_instructions(data.instructions())
    wide = told_in_words(bundle, bundle.model.config, tokenizer, options.seed)
    save_bundle(replace(wide, is_random=False, has_fresh_prefix=False), options.out / "pounce")


@torch.no_grad()
def with_more_rows(ponder: Ponder, num_rows: int) -> Ponder:
    """The same PONDER with so many rows more for words; what stands behind them, carriers and senses, moves up.

    Nothing speaks for saying a new one.
    """
    form, config = ponder.format, copy.deepcopy(ponder.qwen.config)
    first = form.first_carrier_id
    config.text_config.vocab_size += num_rows
    senses = form.proprioception
    form = replace(
        form,
        first_carrier_id=first + num_rows,
        proprioception=None if senses is None else replace(senses, first_id=senses.first_id + num_rows),
    )
    new = ponder.reshaped(config, form=form)
    known = ponder.qwen.state_dict()
    for name in _TABLES & known.keys():
        before, after = known[name][:first], known[name][first:]
        known[name] = torch.cat([before, before.new_zeros(num_rows, before.shape[1]), after])
    new.qwen.load_state_dict(known)
    new.is_random = ponder.is_random
    return new


@torch.no_grad()
def widened(ponder: Ponder, texts: list[str]) -> Ponder:
    """The same PONDER, with a piece for every id that no text, carrier or sense has; in place.

    A new piece means at first what its spelling did, on the average. What speaks for saying it is left as it is.
    """
    old, form = ponder.format.vocabulary, ponder.format
    new = old.extended(texts, form.first_carrier_id)
    words = ponder.qwen.model.language_model.embed_tokens.weight
    for id_ in range(old.num_tokens, new.num_tokens):
        words[id_] = words[list(old.encode(new.decode([id_])))].mean(dim=0)
    ponder.format = replace(form, vocabulary=new)
    return ponder


if __name__ == "__main__":
    sys.exit(main())
