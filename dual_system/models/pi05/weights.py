"""Public pi0.5 checkpoints: their tensor names, and reading and writing them.

The layout is the one openpi's PyTorch port and lerobot share (812 tensors at full size); lerobot's policy
adds a leading ``model.``. Its peculiarities:

- the token embedding is tied to the LM head and usually stored only as ``...paligemma.lm_head.weight``;
- ``...gemma_expert.lm_head.weight`` (263 M numbers at full size) is never used: dropped here and written back
  as zeros, for foreign loaders that are strict;
- Gemma norms store w of (1 + w).
"""

from pathlib import Path

import torch
from torch import Tensor

from dual_system.models.pi05.network import Pi05Config
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.public_layout import (
    COGNITION,
    FRAME_MEMORY,
    POINTER,
    assign,
    renamed,
    require_fit,
    write_tensors,
)
from dual_system.models.stored_tensors import StoredTensors, WeightsError

_ROOT = "paligemma_with_expert."
_PALIGEMMA = _ROOT + "paligemma.model."
_EXPERT = _ROOT + "gemma_expert.model."
_TIED_HEAD = _ROOT + "paligemma.lm_head.weight"
_EMBEDDING = _PALIGEMMA + "language_model.embed_tokens.weight"
_UNUSED_HEAD = _ROOT + "gemma_expert.lm_head.weight"
_LEROBOT_PREFIX = "model."

# (our prefix, public prefix), first match wins; the rest of a name is the same on both sides.
_PREFIXES = (
    ("pi05.language.embed_tokens.weight", _TIED_HEAD),
    ("pi05.vision.layers.", _PALIGEMMA + "vision_tower.vision_model.encoder.layers."),
    ("pi05.vision.post_layernorm.", _PALIGEMMA + "vision_tower.vision_model.post_layernorm."),
    ("pi05.vision.", _PALIGEMMA + "vision_tower.vision_model.embeddings."),
    ("pi05.projector.", _PALIGEMMA + "multi_modal_projector.linear."),
    ("pi05.language.", _PALIGEMMA + "language_model."),
    ("pi05.expert.", _EXPERT),
    ("pi05.", ""),  # action_in_proj, action_out_proj, time_mlp_in, time_mlp_out
    ("cognition_prefix.", COGNITION),
    ("state_projector.", "state_proj."),  # pi0's name for it
    ("frame_memory.", FRAME_MEMORY),
    ("pointer.", POINTER),
)


def public_name(name: str) -> str:
    """Returns the public name of one of our parameters."""
    return renamed(name, _PREFIXES)


def unused_shapes(config: Pi05Config) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of tensors that public files hold and no implementation reads."""
    return {_UNUSED_HEAD: (config.vocab_size, config.expert.width)}


def save_weights(model: Pounce, path: Path) -> None:
    """Writes ``model`` in the complete public layout, with the embedding once, as the tied LM head."""
    tensors = {public_name(name): tensor for name, tensor in model.state_dict().items()}
    unused = {name: torch.zeros(shape) for name, shape in unused_shapes(model.config.pi05).items()}
    write_tensors(tensors | unused, path)


def read_weights(path: Path) -> dict[str, Tensor]:
    """Reads a file (or shards) in the public layout and undoes its peculiarities; keys are canonical public names.

    Raises:
        CheckpointError: as `StoredTensors`; WeightsError: the embedding and the head that is tied to it differ.
    """
    tensors = dict(_stored(path).read())
    embedding = tensors.pop(_EMBEDDING, None)
    if embedding is not None:
        tied = tensors.setdefault(_TIED_HEAD, embedding)
        if not torch.equal(tied, embedding):
            raise WeightsError(str(path), {"tied tensors that differ": [_TIED_HEAD, _EMBEDDING]})
    return tensors


def load_weights(model: Pounce, path: Path) -> bool:
    """Loads ``path`` into ``model``, float32 throughout; returns whether the file held a cognition prefix.

    A public pi0.5 file has none: the model then keeps its own prefix parameters.

    Raises:
        OSError: neither the file nor an index of shards is there, or it may not be read.
        CheckpointError: as `StoredTensors`; WeightsError: a tensor is missing, unknown or of another shape.
    """
    shapes = _stored(path).shapes
    if _EMBEDDING in shapes:
        shapes.setdefault(_TIED_HEAD, shapes.pop(_EMBEDDING))
    require_fit(model, shapes, public_name, str(path))
    return assign(model, read_weights(path), public_name, str(path))


def _stored(path: Path) -> StoredTensors:
    """The tensors that are used, without lerobot's prefix."""

    def used(name: str) -> str | None:
        return None if name.endswith(_UNUSED_HEAD) else name.removeprefix(_LEROBOT_PREFIX)

    return StoredTensors.of(path).named(used)
