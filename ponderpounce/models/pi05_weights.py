"""Public pi0.5 checkpoints: their tensor names, and reading and writing them.

The layout is the one openpi's PyTorch port and lerobot share (812 tensors at full size); lerobot's policy
adds a leading ``model.``. Our own tensors ride in the same file under ``pounce_prefix.``. Its habits:

- the token embedding is tied to the LM head and usually stored only as ``...paligemma.lm_head.weight``;
- ``...gemma_expert.lm_head.weight`` (263 M numbers at full size) is never used: dropped here and not written
  back, so a strict foreign loader must be told to allow one missing key;
- Gemma norms store w of (1 + w).
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ponderpounce.models.pounce import Pounce

_ROOT = "paligemma_with_expert."
_PALIGEMMA = _ROOT + "paligemma.model."
_EXPERT = _ROOT + "gemma_expert.model."
_TIED_HEAD = _ROOT + "paligemma.lm_head.weight"
_EMBEDDING = _PALIGEMMA + "language_model.embed_tokens.weight"
_UNUSED_HEAD = _ROOT + "gemma_expert.lm_head.weight"
_LEROBOT_PREFIX = "model."
_COGNITION = "pounce_prefix."

# (ours, public), first match wins; names below these prefixes are the same on both sides.
_PREFIXES = (
    ("pi05.language.embed_tokens.weight", _TIED_HEAD),
    ("pi05.vision.layers.", _PALIGEMMA + "vision_tower.vision_model.encoder.layers."),
    ("pi05.vision.post_layernorm.", _PALIGEMMA + "vision_tower.vision_model.post_layernorm."),
    ("pi05.vision.", _PALIGEMMA + "vision_tower.vision_model.embeddings."),
    ("pi05.projector.", _PALIGEMMA + "multi_modal_projector.linear."),
    ("pi05.language.", _PALIGEMMA + "language_model."),
    ("pi05.expert.", _EXPERT),
    ("pi05.", ""),  # action_in_proj, action_out_proj, time_mlp_in, time_mlp_out
    ("cognition_prefix.", _COGNITION),
)


class WeightsError(ValueError):
    """A checkpoint does not fit the model; names what is missing, extra and misshapen."""

    def __init__(self, source: str, problems: Mapping[str, Iterable[str]]) -> None:
        lines = [f"checkpoint {source} does not fit the configured model:"]
        for kind, names in problems.items():
            listed = sorted(names)
            if listed:
                more = f" and {len(listed) - 8} more" if len(listed) > 8 else ""
                lines.append(f"  {len(listed)} {kind}: {', '.join(listed[:8])}{more}")
        lines.append("Check that config.json describes this model.safetensors.")
        super().__init__("\n".join(lines))


def public_name(name: str) -> str:
    """Returns the public name of one of our parameters."""
    for ours, public in _PREFIXES:
        if name.startswith(ours):
            return public + name.removeprefix(ours)
    raise KeyError(f"no public name for parameter {name!r}")


def save_weights(model: Pounce, path: Path) -> None:
    """Writes ``model`` in the public layout, the embedding once, as the tied LM head."""
    tensors = {public_name(name): tensor.contiguous().cpu() for name, tensor in model.state_dict().items()}
    save_file(tensors, path, metadata={"format": "pt"})


def read_weights(path: Path) -> dict[str, Tensor]:
    """Reads a file in the public layout, undoing its habits; keys are canonical public names."""
    try:
        with safe_open(path, framework="pt") as file:
            names = [name for name in file.keys() if not name.endswith(_UNUSED_HEAD)]  # noqa: SIM118, no mapping
            tensors = {name: file.get_tensor(name) for name in names}
    except SafetensorError as error:
        raise WeightsError(str(path), {"unreadable": [str(error)]}) from error
    if any(name.startswith(_LEROBOT_PREFIX + _ROOT) for name in tensors):
        tensors = {name.removeprefix(_LEROBOT_PREFIX): tensor for name, tensor in tensors.items()}
    embedding = tensors.pop(_EMBEDDING, None)
    if embedding is not None:
        tied = tensors.setdefault(_TIED_HEAD, embedding)
        if not torch.equal(tied, embedding):
            raise WeightsError(str(path), {"tied tensors that differ": [_TIED_HEAD, _EMBEDDING]})
    return tensors


def load_weights(model: Pounce, path: Path) -> bool:
    """Loads ``path`` into ``model``, float32 throughout; returns whether the file held a cognition prefix.

    A public pi0.5 file has none: the model's own prefix parameters are then left as they are.

    Raises:
        WeightsError: a tensor is missing, unknown or of another shape.
    """
    found = read_weights(path)
    wanted = {public_name(name): name for name in model.state_dict()}
    has_prefix = any(name.startswith(_COGNITION) for name in found)
    if not has_prefix:
        wanted = {public: name for public, name in wanted.items() if not public.startswith(_COGNITION)}
    parameters = dict(model.named_parameters())
    shapes = {
        public: (tuple(parameters[name].shape), tuple(found[public].shape))
        for public, name in wanted.items()
        if public in found
    }
    problems = {
        "missing": wanted.keys() - found.keys(),
        "unknown": found.keys() - wanted.keys(),
        "misshapen": [
            f"{name} expected {ours} came {theirs}" for name, (ours, theirs) in shapes.items() if ours != theirs
        ],
    }
    if any(problems.values()):
        raise WeightsError(str(path), problems)
    # Copied even where float32 already: tensors of a mapped file lie unaligned, and CPU products of unaligned
    # weights differ in the last bit from those of the model that was saved.
    state = {name: found[public].to(torch.float32, copy=True) for public, name in wanted.items()}
    model.load_state_dict(state, strict=False, assign=True)
    return has_prefix
