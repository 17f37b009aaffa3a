"""Finds Qwen3.5 and pi0.5 in one table of names, whatever stands before them: by anchor, then name by name by shape.

No tensor name of the release is public. Below some unknown prefix, however, a module keeps the names of its own class.
An anchor is a name within a module that no other module of the two networks has: it gives the prefix, and the prefix
the module's other tensors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from dual_system.models.official.header import FolderError, Shape, Stored

_PALIGEMMA = "paligemma_with_expert.paligemma.model."
PONDER_EMBEDDING = "model.language_model.embed_tokens.weight"
PONDER_HEAD = "lm_head.weight"
POUNCE_EMBEDDING = "paligemma_with_expert.paligemma.lm_head.weight"
"""The one public name of pi0.5's token embedding; see `pi05.weights`."""


@dataclass(frozen=True, slots=True)
class Module:
    """A part of one half: the prefix of its names in our files, and its anchors (all of them below one prefix)."""

    ours: str
    anchors: tuple[str, ...]
    within: str = ""
    """Beginning of the names below the module's prefix, if the prefix ends before a component that names the module."""


PONDER_MODULES = (
    Module("model.language_model.", ("layers.0.linear_attn.A_log",)),
    Module("model.visual.", ("patch_embed.proj.weight",)),
)
MTP = Module("mtp.", ("mtp.pre_fc_norm_hidden.weight",), within="mtp.")
POUNCE_MODULES = (
    Module(_PALIGEMMA + "vision_tower.vision_model.", ("embeddings.patch_embedding.weight",)),
    Module(
        _PALIGEMMA + "multi_modal_projector.", ("multi_modal_projector.linear.weight",), within="multi_modal_projector."
    ),
    Module(
        _PALIGEMMA + "language_model.",
        ("layers.0.input_layernorm.weight", "layers.0.self_attn.q_proj.weight"),  # Qwen's layer 0 has no self_attn
    ),
    Module("paligemma_with_expert.gemma_expert.model.", ("layers.0.input_layernorm.dense.weight",)),
    *(
        Module(f"{name}.", (f"{name}.weight",), within=f"{name}.")
        for name in ("action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out")
    ),
)


@dataclass(slots=True)
class Half:
    """One network's tensors within the file."""

    found: dict[str, Stored] = field(default_factory=dict)
    """Our name -> tensor."""
    prefixes: dict[str, str] = field(default_factory=dict)
    """Our prefix -> the file's."""
    faults: list[str] = field(default_factory=list)
    """What is missing or has another shape, one sentence each."""

    @property
    def names(self) -> set[str]:
        """Names in the file."""
        return {tensor.name for tensor in self.found.values()}


def find_ponder(tensors: Mapping[str, Stored], expected: Mapping[str, Shape], mtp: Mapping[str, Shape]) -> Half:
    """Finds Qwen3.5. ``expected``: names and shapes of transformers' class, tied head left out; ``mtp``: of mtp.*.

    The LM head is the tensor ``...lm_head.weight`` of the embedding's shape. A tied model may have it or not.
    """
    half = _half(tensors, {name: shape for name, shape in expected.items() if name != PONDER_HEAD}, PONDER_MODULES)
    if _prefixes(tensors, MTP):
        other = _half(tensors, mtp, (MTP,))
        half.found |= other.found
        half.prefixes |= other.prefixes
        half.faults += other.faults
    heads = [
        tensor
        for name, tensor in tensors.items()
        if _ends(name, PONDER_HEAD) and tensor.shape == expected[PONDER_EMBEDDING] and name not in half.names
    ]
    if len(heads) == 1:
        half.found[PONDER_HEAD] = heads[0]
        half.prefixes[PONDER_HEAD] = heads[0].name
    elif heads:
        half.faults.append(f"{PONDER_HEAD}: expected one, came {', '.join(sorted(head.name for head in heads))}")
    elif PONDER_HEAD in expected:
        half.faults.append(f"missing {PONDER_HEAD} {expected[PONDER_HEAD]}: config.json says the head is not tied")
    return half


def find_pounce(tensors: Mapping[str, Stored], expected: Mapping[str, Shape]) -> Half:
    """Finds pi0.5. ``expected``: public names and shapes, with the embedding once, as `POUNCE_EMBEDDING`.

    ``embed_tokens`` is the embedding where it is stored: the LM head beside it is not read by any forward.
    """
    half = _half(tensors, {name: shape for name, shape in expected.items() if name != POUNCE_EMBEDDING}, POUNCE_MODULES)
    shape = expected[POUNCE_EMBEDDING]
    root = half.prefixes.get(_PALIGEMMA + "language_model.")
    alike = {name: tensor for name, tensor in tensors.items() if tensor.shape == shape and name not in half.names}
    own = alike.get(f"{root}embed_tokens.weight")
    heads = [tensor for name, tensor in alike.items() if _ends(name, "lm_head.weight")]
    if own is None and len(heads) == 1:
        own = heads[0]
    if own is None:
        half.faults.append(f"missing the token embedding {shape}: neither embed_tokens nor one lm_head has this shape")
    else:
        half.found[POUNCE_EMBEDDING] = own
    return half


def _half(tensors: Mapping[str, Stored], expected: Mapping[str, Shape], modules: Iterable[Module]) -> Half:
    half = Half()
    for module in modules:
        wanted = {name: shape for name, shape in expected.items() if name.startswith(module.ours)}
        prefixes = _prefixes(tensors, module)
        if len(prefixes) > 1:  # e.g. layer 0 of multi-token prediction, whose names are Gemma's
            prefixes = {each for each in prefixes if _has_shapes(tensors, each, module, wanted)}
        if len(prefixes) != 1:
            where = f"under {', '.join(map(repr, sorted(prefixes)))}" if prefixes else "nowhere"
            half.faults.append(f"{module.ours}*: expected one {' and '.join(module.anchors)}, came {where}")
            continue
        (prefix,) = prefixes
        half.prefixes[module.ours] = prefix
        for name, shape in wanted.items():
            theirs = prefix + module.within + name.removeprefix(module.ours)
            tensor = tensors.get(theirs)
            if tensor is None:
                half.faults.append(f"missing {theirs} {shape}")
            elif tensor.shape != shape:
                half.faults.append(f"misshapen {theirs}: expected {shape}, came {tensor.shape}")
            else:
                half.found[name] = tensor
    return half


def _prefixes(tensors: Mapping[str, Stored], module: Module) -> set[str]:
    first, *others = module.anchors
    found = {name.removesuffix(first) for name in tensors if _ends(name, first)}
    return {prefix for prefix in found if all(prefix + other in tensors for other in others)}


def _has_shapes(tensors: Mapping[str, Stored], prefix: str, module: Module, wanted: Mapping[str, Shape]) -> bool:
    anchors = [anchor.removeprefix(module.within) for anchor in module.anchors]
    return all(tensors[prefix + module.within + each].shape == wanted.get(module.ours + each) for each in anchors)


def _ends(name: str, suffix: str) -> bool:
    """Whether ``name`` ends with ``suffix`` at a dot."""
    return name == suffix or name.endswith("." + suffix)


def refuse(path: str, faults: Iterable[str], way_out: str) -> None:
    """Raises FolderError with every fault by name, if there is any."""
    listed = list(faults)
    if listed:
        raise FolderError("\n".join([f"{path}: {len(listed)} faults", *(f"  {fault}" for fault in listed), way_out]))
