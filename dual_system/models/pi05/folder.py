"""Sizes of a public pi0.5 folder, read off its tensors: no config file of openpi or lerobot has them all."""

import logging
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

from dual_system.models.pi05.network import Pi05Config
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.pi05.weights import public_name

log = logging.getLogger(__name__)

Shapes = dict[str, tuple[int, ...]]


def with_sizes_of(shapes: Shapes, config: PounceConfig, where: str) -> PounceConfig:
    """Returns ``config`` with the sizes of the network that these tensors are of; horizon and prefix stay.

    Head counts of the Gemma streams follow from their one key head (`GemmaConfig.num_kv_heads`); SigLIP's cannot be
    read and stays ``config``'s. Sizes other than ``config``'s are logged: a file that lacks its last layers has such.

    Args:
        shapes: shapes of all tensors, by public names with or without lerobot's ``model.``.
        where: names the folder in errors.

    Raises:
        ValueError: a tensor that sizes are read from is missing or has other dims, or the sizes describe no network.
    """
    try:
        found = _read(shapes, config.pi05)
    except KeyError as error:
        raise ValueError(f"{where}: no tensor {error.args[0]}; pi0.5's sizes are read from it") from error
    except (ValueError, IndexError, ArithmeticError) as error:
        raise ValueError(f"{where}: the tensors' shapes describe no pi0.5: {error}") from error
    if found != config.pi05:
        log.warning(
            "%s: a pi0.5 of other sizes than the published one: %s; SigLIP's %d heads, which no file says, are assumed",
            *(where, "; ".join(_differing(found, config.pi05)), found.vision.num_heads),
        )
    return replace(config, pi05=found)


def _differing(found: Any, known: Any, name: str = "") -> Iterator[str]:
    """Yields every value of a configuration that differs from another's, by its dotted name."""
    for each in fields(found):
        mine, theirs = getattr(found, each.name), getattr(known, each.name)
        dotted = f"{name}{each.name}"
        if is_dataclass(mine):
            yield from _differing(mine, theirs, f"{dotted}.")
        elif mine != theirs:
            yield f"{dotted} {mine} ({theirs})"


def _read(shapes: Shapes, known: Pi05Config) -> Pi05Config:
    shapes = {name.removeprefix("model."): shape for name, shape in shapes.items()}
    tied = public_name("pi05.language.embed_tokens.weight")
    vocab_size, _ = shapes.get(tied) or shapes[_below("language", "embed_tokens.weight")]
    patches = shapes[_below("vision", "patch_embedding.weight")]
    side = round(shapes[_below("vision", "position_embedding.weight")][0] ** 0.5)
    vision = replace(
        known.vision,
        width=patches[0],
        depth=_depth(shapes, _below("vision", "layers.")),
        mlp_width=shapes[_below("vision", "layers.0.mlp.fc1.weight")][0],
        image_px=side * patches[-1],
        patch_px=patches[-1],
    )
    streams = {}
    for name in ("language", "expert"):
        attention = _below(name, "layers.0.self_attn.")
        num_query_rows, width = shapes[attention + "q_proj.weight"]
        head_dim = shapes[attention + "k_proj.weight"][0] // getattr(known, name).num_kv_heads
        streams[name] = replace(
            getattr(known, name),
            width=width,
            depth=_depth(shapes, _below(name, "layers.")),
            mlp_width=shapes[_below(name, "layers.0.mlp.gate_proj.weight")][0],
            num_heads=num_query_rows // head_dim,
            head_dim=head_dim,
        )
    action_dim = shapes["action_in_proj.weight"][1]
    return replace(known, vision=vision, **streams, vocab_size=vocab_size, action_dim=action_dim)


def _below(part: str, name: str) -> str:
    """Public name of a tensor of one part of the network."""
    return public_name(f"pi05.{part}.{name}")


def _depth(shapes: Shapes, prefix: str) -> int:
    return 1 + max(int(name.removeprefix(prefix).split(".")[0]) for name in shapes if name.startswith(prefix))
