"""PONDER on disk: a HuggingFace-layout folder, checked name by name before a single weight is read.

    config.json          transformers' Qwen3.5 configuration
    tokenizer.json       the tokenizer
    model.safetensors    the weights, or model.safetensors.index.json and its shards
    ponder.json          what PONDER adds: carriers, image size, whether it generates text, demonstration sampling

A public Qwen3.5 checkpoint has no ponder.json and still loads; its carriers are untrained padding rows. Loaded in
the dtype it was written in, it is written back bit for bit, multi-token prediction included.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast

import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from transformers.models.qwen3_5 import Qwen3_5Config

from dual_system.hub import instead_of, local_folder
from dual_system.models.config_json import from_json
from dual_system.models.ponder.context import ContextFormat, OpeningForm
from dual_system.models.ponder.demo_sampling import PAPER_SAMPLING, DemoSampling
from dual_system.models.ponder.network import Ponder, image_grid, skeleton, token_px
from dual_system.models.ponder.observation import WHOLE_VIEWS, ObservationReader
from dual_system.models.ponder.text_policy import OWN_TEXTS, TextPolicy
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.stored_tensors import (
    CheckpointError,
    StoredTensors,
    WeightsError,
    refuse_quantised,
    require_layers,
    require_shapes,
)
from dual_system.models.windows import Box, Windows
from protocol.files import read_object

CONFIG_NAME = "config.json"
OWN_NAME = "ponder.json"
INDEX_NAME = "model.safetensors.index.json"
SINGLE_NAME = "model.safetensors"
SMALL_PAIR = "small_pair"
"""Key of ponder.json under which the demo's PONDER declares its `CropReader`."""
MTP_PREFIX = "mtp."  # multi-token prediction: in public checkpoints, not in transformers' Qwen3.5
MAX_SHARD_BYTES = 5_000_000_000
_HEAD, _EMBEDDING = "lm_head.weight", "model.language_model.embed_tokens.weight"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredPonder:
    """Contents of ponder.json. An absent field takes its default, the paper's value; an unknown one is an error."""

    format: Literal["ponderpounce.ponder/1"] = "ponderpounce.ponder/1"
    num_carriers: int = 1
    first_carrier_id: int | None = None
    """None: the first row after the tokenizer's last id."""
    image_px: tuple[int, int] = (256, 256)
    windows: tuple[Box, ...] = ()
    cameras: tuple[str, ...] = ()
    speaks: bool = True
    demonstrations: DemoSampling = PAPER_SAMPLING
    opening: OpeningForm = "chat"
    texts: TextPolicy = OWN_TEXTS
    remembers: bool = True
    is_random: bool = True
    """True if the carriers were never trained."""


def load_ponder(directory: Path, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Ponder:
    """Reads a checkpoint folder, ours or the hub's (`local_folder`).

    Raises:
        OSError: a file is missing or may not be read.
        CheckpointError: tensors are missing, unknown, misshapen, quantised or not finite; the message names them.
        ValueError: a file is broken or a Git LFS pointer, or the configuration is inconsistent.
    """
    directory = local_folder(directory)
    config_path = directory / CONFIG_NAME
    if not config_path.exists() and not config_path.is_symlink():
        raise FileNotFoundError(f"checkpoint {directory} has no {CONFIG_NAME}{instead_of(directory)}")
    raw = read_object(config_path)
    if raw.get("model_type") != "qwen3_5":
        raise CheckpointError(f"{config_path}: model_type is {raw.get('model_type')!r}; PONDER reads 'qwen3_5'.")
    refuse_quantised(raw, config_path)
    tensors = StoredTensors.of(directory / SINGLE_NAME)
    require_layers(raw, tensors, config_path)
    vocabulary = Vocabulary.load(directory)
    stored, reader = _read_stored(directory)
    with _describing_a_network(config_path):
        _require_dtypes(raw)
        _require_rope(raw)
        qwen_config = Qwen3_5Config.from_dict(raw)
        shapes = {name: tuple(tensor.shape) for name, tensor in _own_tensors(skeleton(qwen_config)).items()}
        if any(name.startswith(MTP_PREFIX) for name in tensors.shapes):
            shapes |= mtp_shapes(qwen_config.text_config, shapes)
        grid, side_px = image_grid(qwen_config, stored.image_px), token_px(qwen_config)
    first_carrier_id = stored.first_carrier_id
    context_format = ContextFormat(
        vocabulary=vocabulary,
        num_carriers=stored.num_carriers,
        first_carrier_id=vocabulary.num_tokens if first_carrier_id is None else first_carrier_id,
        image_grid=grid,
        token_px=side_px,
        reader=reader,
        cameras=stored.cameras,
        speaks=stored.speaks,
        demonstrations=stored.demonstrations,
        opening_form=stored.opening,
        texts=stored.texts,
        remembers=stored.remembers,
    )
    if qwen_config.image_token_id != vocabulary.image_pad:
        raise CheckpointError(
            f"{config_path}: image_token_id is {qwen_config.image_token_id}, but tokenizer.json says "
            f"<|image_pad|> is {vocabulary.image_pad}; the two files are from different checkpoints."
        )
    is_tied = bool(qwen_config.tie_word_embeddings)
    found = {name: shape for name, shape in tensors.shapes.items() if not (is_tied and name == _HEAD)}
    require_shapes(shapes, found, str(directory))
    ponder = Ponder(qwen_config, context_format, image_px=stored.image_px, device=device, dtype=dtype)
    ponder.is_random = stored.is_random
    _fill(ponder, tensors, directory)
    return ponder


def save_ponder(ponder: Ponder, directory: Path, *, max_shard_bytes: int = MAX_SHARD_BYTES) -> None:
    """Writes a folder that :func:`load_ponder` and transformers' ``from_pretrained`` both read.

    Raises FileExistsError if the folder already holds a checkpoint.
    """
    if (directory / CONFIG_NAME).exists():
        raise FileExistsError(f"{directory} already holds a checkpoint; save into a new folder.")
    directory.mkdir(parents=True, exist_ok=True)
    ponder.qwen.config.save_pretrained(directory)
    ponder.format.vocabulary.save(directory)
    reader = ponder.format.reader
    stored = StoredPonder(
        num_carriers=ponder.format.num_carriers,
        first_carrier_id=ponder.format.first_carrier_id,
        image_px=ponder.image_px,
        windows=reader.boxes if isinstance(reader, Windows) else (),
        cameras=ponder.format.cameras,
        speaks=ponder.format.speaks,
        demonstrations=ponder.format.demonstrations,
        opening=ponder.format.opening_form,
        texts=ponder.format.texts,
        remembers=ponder.format.remembers,
        is_random=ponder.is_random,
    )
    values = asdict(stored)
    if reader != WHOLE_VIEWS and not isinstance(reader, Windows):
        values[SMALL_PAIR] = asdict(cast(Any, reader))
    (directory / OWN_NAME).write_text(json.dumps(values, indent=2) + "\n")
    shards: list[dict[str, Tensor]] = [{}]
    shard_bytes = 0
    for name, tensor in (_own_tensors(ponder.qwen) | ponder.mtp).items():
        if shards[-1] and shard_bytes + tensor.nbytes > max_shard_bytes:
            shards.append({})
            shard_bytes = 0
        shards[-1][name] = tensor.contiguous()
        shard_bytes += tensor.nbytes
    if len(shards) == 1:
        save_file(shards[0], directory / SINGLE_NAME, metadata={"format": "pt"})
        return
    weight_map: dict[str, str] = {}
    for number, shard in enumerate(shards, start=1):
        file_name = f"model-{number:05d}-of-{len(shards):05d}.safetensors"
        save_file(shard, directory / file_name, metadata={"format": "pt"})
        weight_map |= dict.fromkeys(shard, file_name)
    total_size = sum(tensor.nbytes for shard in shards for tensor in shard.values())
    index = {"metadata": {"total_size": total_size}, "weight_map": weight_map}
    (directory / INDEX_NAME).write_text(json.dumps(index, indent=2) + "\n")


def weights_hash(ponder: Ponder) -> str:
    """12 hex digits of sha256 over the name, dtype, shape and bytes of every tensor: provenance.

    It reads every weight, which takes seconds per ten gigabytes: compute it once, when a network is loaded.
    """
    digest = hashlib.sha256()
    for name, tensor in sorted(_own_tensors(ponder.qwen).items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        flat = tensor.detach().contiguous().reshape(-1).view(torch.uint8)
        digest.update(flat.cpu().numpy().data)
    return digest.hexdigest()[:12]


def mtp_shapes(text_config: Any, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """Shapes of the multi-token prediction block of a network with tensors of these ``shapes``.

    The block is a projection of [embedding; hidden], attention layers like the network's own, and a norm. Source:
    tensor names of public Qwen3.5 checkpoints; the total is their published number of parameters.
    """
    hidden = text_config.hidden_size
    like = f"model.language_model.layers.{text_config.layer_types.index('full_attention')}."
    layer = {name.removeprefix(like): shape for name, shape in shapes.items() if name.startswith(like)}
    norms = ("norm", "pre_fc_norm_embedding", "pre_fc_norm_hidden")
    block: dict[str, tuple[int, ...]] = {"fc.weight": (hidden, 2 * hidden)}
    block |= {f"{norm}.weight": (hidden,) for norm in norms}
    for index in range(getattr(text_config, "mtp_num_hidden_layers", 1)):
        block |= {f"layers.{index}.{name}": shape for name, shape in layer.items()}
    return {MTP_PREFIX + name: shape for name, shape in block.items()}


def _own_tensors(module: nn.Module) -> dict[str, Tensor]:
    """State dict without the second name of a tied tensor."""
    seen: set[int] = set()
    own = {}
    for name, tensor in module.state_dict(keep_vars=True).items():
        if id(tensor) not in seen:
            seen.add(id(tensor))
            own[name] = tensor.detach()
    return own


@contextmanager
def _describing_a_network(config_path: Path) -> Iterator[None]:
    """Turns whatever transformers and torch raise of sizes that fit no network into a `CheckpointError`."""
    try:
        yield
    except Exception as error:
        told = " ".join(str(error).split())[:300]
        raise CheckpointError(f"{config_path} describes no Qwen3.5 network: {type(error).__name__}: {told}") from error


def _require_dtypes(values: dict[str, Any]) -> None:
    """Raises ValueError if a dtype is none of torch's: transformers looks it up as any attribute of torch."""
    for name, value in values.items():
        if isinstance(value, dict):
            _require_dtypes(value)
        elif name in ("dtype", "torch_dtype") and value not in (None, "float32", "bfloat16", "float16", "float64"):
            raise ValueError(f"{name} is {value!r}, expected a floating dtype")


def _require_rope(values: dict[str, Any]) -> None:
    """Raises ValueError without the rotation's base and sections: transformers has a default, which no Qwen3.5 has."""
    text = values.get("text_config") or {}
    rope = text.get("rope_parameters") or {"rope_theta": text.get("rope_theta"), **(text.get("rope_scaling") or {})}
    if missing := [name for name in ("rope_theta", "mrope_section") if not rope.get(name)]:
        raise ValueError(f"text_config.rope_parameters lacks {' and '.join(missing)}")


def _read_stored(directory: Path) -> tuple[StoredPonder, ObservationReader]:
    path = directory / OWN_NAME
    if not path.is_file():
        return StoredPonder(), WHOLE_VIEWS
    values = read_object(path)
    declared = values.pop(SMALL_PAIR, None)
    stored = from_json(StoredPonder, values, str(path))
    if declared is None:
        return stored, Windows(stored.windows) if stored.windows else WHOLE_VIEWS
    from dual_system.models.small_pair.reading import CropReader  # lazy: only the demo's pair has it

    return stored, from_json(CropReader, declared, f"{path}: {SMALL_PAIR}")


@torch.no_grad()
def _fill(ponder: Ponder, tensors: StoredTensors, directory: Path) -> None:
    """Copies the stored numbers. Raises WeightsError if a head that is tied to the embedding is stored and differs."""
    own = _own_tensors(ponder.qwen)
    head: Tensor | None = None
    for name, tensor in tensors.read():
        if name in own:
            own[name].copy_(tensor)
        elif name.startswith(MTP_PREFIX):
            ponder.mtp[name] = tensor  # memory-mapped: it costs no memory of its own until it is used
        else:
            head = tensor  # some exporters write the tied tensor twice
    embedding = own[_EMBEDDING]
    if head is not None and not torch.equal(head.to(embedding.dtype), embedding.to("cpu")):
        raise WeightsError(str(directory), {"tied tensors that differ (tie_word_embeddings)": [_HEAD, _EMBEDDING]})
