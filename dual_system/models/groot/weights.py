"""Public GR00T N1.5 checkpoints: their tensor names, and reading and writing them.

NVIDIA's folder holds 585 tensors of the backbone and 314 of the action head, usually in shards with an index;
lerobot's ``groot`` policy adds a leading ``_groot_model.``. Peculiarities of the layout:

- the LM head is stored beside the token embedding, differs from it, and is never used; nor is SigLIP's pooling
  head (11 tensors). Both are dropped here and written back as zeros, for foreign loaders that are strict;
- embodiment-specific weights are (E, in, out), not torch's (out, in).
"""

from pathlib import Path

import torch
from torch import Tensor

from dual_system.models.groot.network import GrootConfig
from dual_system.models.groot.pounce import GrootPounce
from dual_system.models.public_layout import COGNITION, assign, renamed, require_fit, write_tensors
from dual_system.models.stored_tensors import StoredTensors

_EAGLE = "backbone.eagle_model."
_VISION = _EAGLE + "vision_model.vision_model."
_HEAD = "action_head."
_LM_HEAD = _EAGLE + "language_model.lm_head.weight"
_POOLING_HEAD = _VISION + "head."
LEROBOT_PREFIX = "_groot_model."

# (our prefix, public prefix), first match wins; the rest of a name is the same on both sides except for _INNER.
_PREFIXES = (
    ("groot.eagle.vision.layers.", _VISION + "encoder.layers."),
    ("groot.eagle.vision.post_layernorm.", _VISION + "post_layernorm."),
    ("groot.eagle.vision.", _VISION + "embeddings."),
    ("groot.eagle.projector.", _EAGLE + "mlp1.0."),
    ("groot.eagle.language.", _EAGLE + "language_model.model."),
    ("groot.vl_norm.", _HEAD + "vlln."),
    ("groot.mixer.", _HEAD + "vl_self_attention.transformer_blocks."),
    ("groot.dit.blocks.", _HEAD + "model.transformer_blocks."),
    ("groot.dit.time_mlp_in.", _HEAD + "model.timestep_encoder.timestep_embedder.linear_1."),
    ("groot.dit.time_mlp_out.", _HEAD + "model.timestep_encoder.timestep_embedder.linear_2."),
    ("groot.dit.", _HEAD + "model."),
    ("groot.", _HEAD),  # state_encoder, action_encoder, action_decoder, future_tokens, position_embedding
    ("cognition_prefix.", COGNITION),
)
_INNER = ((".to_out.", ".to_out.0."), (".ff.up.", ".ff.net.0.proj."), (".ff.down.", ".ff.net.2."))


def public_name(name: str) -> str:
    """Returns the public name of one of our parameters."""
    public = renamed(name, _PREFIXES)
    for ours, theirs in _INNER:
        public = public.replace(ours, theirs)
    return public


def unused_shapes(config: GrootConfig) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of tensors that public files hold and no implementation reads."""
    vision, language = config.eagle.vision, config.eagle.language
    width, mlp_width = vision.width, vision.mlp_width
    pooling: dict[str, tuple[int, ...]] = {
        "probe": (1, 1, width),
        "attention.in_proj_weight": (3 * width, width),
        "attention.in_proj_bias": (3 * width,),
        "attention.out_proj.weight": (width, width),
        "attention.out_proj.bias": (width,),
        "layernorm.weight": (width,),
        "layernorm.bias": (width,),
        "mlp.fc1.weight": (mlp_width, width),
        "mlp.fc1.bias": (mlp_width,),
        "mlp.fc2.weight": (width, mlp_width),
        "mlp.fc2.bias": (width,),
    }
    shapes = {_POOLING_HEAD + name: shape for name, shape in pooling.items()}
    return shapes | {_LM_HEAD: (language.vocab_size, language.width)}


def save_weights(model: GrootPounce, path: Path) -> None:
    """Writes ``model`` in the complete public layout: unused tensors are zeros."""
    tensors = {public_name(name): tensor for name, tensor in model.state_dict().items()}
    unused = {name: torch.zeros(shape) for name, shape in unused_shapes(model.config.groot).items()}
    write_tensors(tensors | unused, path)


def read_weights(path: Path) -> dict[str, Tensor]:
    """Reads a file (or shards) in the public layout without its unused tensors; keys are NVIDIA's names."""
    return dict(_stored(path).read())


def load_weights(model: GrootPounce, path: Path) -> bool:
    """Loads ``path`` into ``model``, float32 throughout; returns whether the file held a cognition prefix.

    Raises:
        OSError: neither the file nor an index of shards is there, or it may not be read.
        CheckpointError: as `StoredTensors`; WeightsError: a tensor is missing, unknown or of another shape.
    """
    require_fit(model, _stored(path).shapes, public_name, str(path))
    return assign(model, read_weights(path), public_name, str(path))


def _stored(path: Path) -> StoredTensors:
    """The tensors that are used, without lerobot's prefix."""

    def used(name: str) -> str | None:
        name = name.removeprefix(LEROBOT_PREFIX)
        return None if name == _LM_HEAD or name.startswith(_POOLING_HEAD) else name

    return StoredTensors.of(path).named(used)
