"""PONDER on disk: a HuggingFace-layout folder, checked name by name before a single weight is read.

    config.json          transformers' Qwen3.5 configuration
    tokenizer.json       the tokenizer
    model.safetensors    the weights, or model.safetensors.index.json and its shards, or model.safetensors.packed
    ponder.json          what PONDER adds: carriers, image size, eyes, proprioception
    reader.safetensors   the weights of its reader of demonstrations, if ponder.json says it has one (``reader_file``)
    specialist_NAME.safetensors   those of each specialist that ponder.json names, likewise

A public Qwen3.5 checkpoint has no ponder.json and loads as it is; its carriers are untrained padding rows. Loaded in
the dtype it was written in, it is written back bit for bit, multi-token prediction included.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from transformers.models.qwen3_5 import Qwen3_5Config

from dual_system.models.config_json import from_json
from dual_system.models.counsel import Counsel
from dual_system.models.eyes import Eyes, check_eyes
from dual_system.models.packed import PackedFile
from dual_system.models.ponder.context import ContextFormat
from dual_system.models.ponder.network import Ponder, image_grid, skeleton, token_px
from dual_system.models.ponder.showing import AS_IN_THE_PAPER, OWN_NAME, Showing
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.proprioception import Proprioception
from dual_system.models.reader import Reader
from dual_system.models.reader_file import narrowing_of, read_weights, stored_shapes, write_reader
from dual_system.models.second_look import SecondLook
from dual_system.models.specialty import Specialty, check_specialties

CONFIG_NAME = "config.json"
INDEX_NAME = "model.safetensors.index.json"
SINGLE_NAME = "model.safetensors"
PACKED_NAME = "model.safetensors.packed"
READER_NAME = "reader.safetensors"
MTP_PREFIX = "mtp."  # multi-token prediction: in public checkpoints, not in transformers' Qwen3.5
MAX_SHARD_BYTES = 5_000_000_000
MAX_NAMES_SHOWN = 5


class CheckpointError(ValueError):
    """A checkpoint folder does not hold the network its config.json describes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredPonder:
    """Contents of ponder.json. The defaults are for a public Qwen3.5, which has none; a file has every field."""

    format: Literal["ponderpounce.ponder/12"] = "ponderpounce.ponder/12"
    """Each is the one before and a field more: /11 has no ``grip`` in its proprioception, /10 no
    ``specialties``, /9 no ``has_reader`` (nor ``on_demonstrations`` in its counsel), /8 no ``demonstrations``, /7 no
    ``fovea``, /6 no ``counsel``, /5 no ``second_look``, /4 no ``takes_notes``, /3 no ``speaks``, /2 no
    ``proprioception``, /1 no ``eyes``. Such a PONDER speaks, is shown demonstrations as in the paper, takes counsel on
    all episodes if on any, and has none of the others."""
    num_carriers: int = 1
    first_carrier_id: int | None = None
    """None: the first row after the tokenizer's last id."""
    image_px: tuple[int, int] = (256, 256)
    eyes: Eyes = None
    fovea: tuple[int, int, int, int] | None = None
    proprioception: Proprioception | None = None
    speaks: bool = True
    takes_notes: bool = False
    second_look: SecondLook | None = None
    counsel: Counsel | None = None
    demonstrations: Showing = AS_IN_THE_PAPER
    has_reader: bool = False
    """See ``reader``."""
    specialties: tuple[Specialty, ...] = ()
    is_random: bool = True
    """The carriers were never trained."""

    def __post_init__(self) -> None:
        check_eyes(self.eyes, self.image_px)
        check_specialties(self.specialties)


def load_ponder(directory: Path, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Ponder:
    """Reads a checkpoint folder.

    Raises FileNotFoundError for a file that is not there, CheckpointError naming every missing, extra or
    misshapen tensor, and ValueError for a configuration that contradicts itself.
    """
    config_path = directory / CONFIG_NAME
    if not config_path.is_file():
        raise FileNotFoundError(f"{config_path}: not a checkpoint folder (--checkpoint DIR needs config.json).")
    raw = _read_json(config_path)
    if raw.get("model_type") != "qwen3_5":
        raise CheckpointError(f"{config_path}: model_type is {raw.get('model_type')!r}; PONDER reads 'qwen3_5'.")
    qwen_config = Qwen3_5Config.from_dict(raw)
    vocabulary = Vocabulary.load(directory)
    stored = _read_stored(directory)
    first_carrier_id = stored.first_carrier_id
    context_format = ContextFormat(
        vocabulary=vocabulary,
        num_carriers=stored.num_carriers,
        first_carrier_id=vocabulary.num_tokens if first_carrier_id is None else first_carrier_id,
        image_grid=image_grid(qwen_config, stored.image_px),
        token_px=token_px(qwen_config),
        fovea=stored.fovea,
        eyes=stored.eyes,
        proprioception=stored.proprioception,
        speaks=stored.speaks,
        takes_notes=stored.takes_notes,
        second_look=stored.second_look,
        counsel=stored.counsel,
        demonstrations=stored.demonstrations,
    )
    if qwen_config.image_token_id != vocabulary.image_pad:
        raise CheckpointError(
            f"{config_path}: image_token_id is {qwen_config.image_token_id}, but tokenizer.json says "
            f"<|image_pad|> is {vocabulary.image_pad}; the two files are from different checkpoints."
        )
    files = _files_by_tensor(directory)
    shapes = {name: tuple(tensor.shape) for name, tensor in _own_tensors(skeleton(qwen_config)).items()}
    if any(name.startswith(MTP_PREFIX) for name in files):
        shapes |= mtp_shapes(qwen_config.text_config, shapes)
    _check_tensors(directory, files, shapes, tied=qwen_config.tie_word_embeddings)
    ponder = Ponder(qwen_config, context_format, image_px=stored.image_px, device=device, dtype=dtype)
    ponder.is_random = stored.is_random
    _read_tensors(files, ponder)
    if stored.has_reader:
        _read_reader(directory / READER_NAME, ponder.add_reader(), ponder)
    for specialty in stored.specialties:
        _read_reader(directory / specialist_name(specialty), ponder.add_specialist(specialty), ponder)
    return ponder


def save_ponder(ponder: Ponder, directory: Path, *, max_shard_bytes: int = MAX_SHARD_BYTES) -> None:
    """Writes a folder that :func:`load_ponder` and transformers' ``from_pretrained`` both read.

    Raises FileExistsError rather than mix two checkpoints in one folder.
    """
    if (directory / CONFIG_NAME).exists():
        raise FileExistsError(f"{directory} already holds a checkpoint; save into a new folder.")
    directory.mkdir(parents=True, exist_ok=True)
    ponder.qwen.config.save_pretrained(directory)
    ponder.format.vocabulary.save(directory)
    stored = StoredPonder(
        num_carriers=ponder.format.num_carriers,
        first_carrier_id=ponder.format.first_carrier_id,
        image_px=ponder.image_px,
        eyes=ponder.format.eyes,
        fovea=ponder.format.fovea,
        proprioception=ponder.format.proprioception,
        speaks=ponder.format.speaks,
        takes_notes=ponder.format.takes_notes,
        second_look=ponder.format.second_look,
        counsel=ponder.format.counsel,
        demonstrations=ponder.format.demonstrations,
        has_reader=ponder.reader is not None,
        specialties=ponder.format.specialties,
        is_random=ponder.is_random,
    )
    (directory / OWN_NAME).write_text(json.dumps(asdict(stored), indent=2) + "\n")
    for path, reader in _readers(ponder, directory):
        write_reader(reader, ponder.qwen.model.language_model, path)
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
    """12 hex digits of sha256 over the name, dtype, shape and bytes of every tensor that answers depend on: provenance.

    Reads every weight once, which takes seconds per ten gigabytes: compute it when a network is loaded.
    """
    digest = hashlib.sha256()
    own = _own_tensors(ponder.qwen)
    for path, reader in _readers(ponder):
        own |= {f"{path.stem}.{name}": tensor for name, tensor in _own_tensors(reader).items()}
    for name, tensor in sorted(own.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        flat = tensor.detach().contiguous().reshape(-1).view(torch.uint8)
        digest.update(flat.cpu().numpy().data)
    return digest.hexdigest()[:12]


def mtp_shapes(text_config: Any, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
    """The multi-token prediction block that belongs to a network with tensors of these ``shapes``.

    Attention layers like the network's own, behind a projection of [embedding; hidden] and before a norm. Source:
    tensor names of public Qwen3.5 checkpoints; the sum is their published number of parameters.
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


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise CheckpointError(f"{path} is no JSON: {error}") from error


def _open(path: Path) -> Any:
    try:
        return PackedFile(path) if path.name == PACKED_NAME else safe_open(path, framework="pt")
    except SafetensorError as error:
        raise CheckpointError(f"{path} is no safetensors file, or was cut short: {error}") from error


def _read_stored(directory: Path) -> StoredPonder:
    path = directory / OWN_NAME
    if not path.is_file():
        return StoredPonder()
    values = _read_json(path)
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/1":
        values |= {"format": "ponderpounce.ponder/2", "eyes": None}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/2":
        values |= {"format": "ponderpounce.ponder/3", "proprioception": None}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/3":
        values |= {"format": "ponderpounce.ponder/4", "speaks": True}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/4":
        values |= {"format": "ponderpounce.ponder/5", "takes_notes": False}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/5":
        values |= {"format": "ponderpounce.ponder/6", "second_look": None}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/6":
        values |= {"format": "ponderpounce.ponder/7", "counsel": None}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/7":
        values |= {"format": "ponderpounce.ponder/8", "fovea": None}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/8":
        values |= {"format": "ponderpounce.ponder/9", "demonstrations": {"hz": 1, "to_its_end": False}}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/9":
        values |= {"format": "ponderpounce.ponder/10", "has_reader": False}
        if isinstance(values.get("counsel"), dict):
            values["counsel"] |= {"on_demonstrations": True}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/10":
        values |= {"format": "ponderpounce.ponder/11", "specialties": []}
    if isinstance(values, dict) and values.get("format") == "ponderpounce.ponder/11":
        values |= {"format": "ponderpounce.ponder/12"}
        if isinstance(values.get("proprioception"), dict):
            values["proprioception"] |= {"grip": None}
    return from_json(StoredPonder, values, str(path))


def _files_by_tensor(directory: Path) -> dict[str, Path]:
    """Tensor name -> the safetensors file that holds it."""
    index_path = directory / INDEX_NAME
    if index_path.is_file():
        weight_map: dict[str, str] = _read_json(index_path)["weight_map"]
        for file_name in sorted(set(weight_map.values())):
            if not (directory / file_name).is_file():
                raise FileNotFoundError(f"{directory / file_name}: named by {INDEX_NAME}, but not there.")
        return {name: directory / file_name for name, file_name in weight_map.items()}
    there = [directory / name for name in (SINGLE_NAME, PACKED_NAME) if (directory / name).is_file()]
    if not there:
        raise FileNotFoundError(f"{directory}: neither {SINGLE_NAME} nor {INDEX_NAME} nor {PACKED_NAME} is there.")
    single, *_ = there
    with _open(single) as file:
        return dict.fromkeys(file.keys(), single)


def _check_tensors(
    directory: Path, files: dict[str, Path], expected_shapes: dict[str, tuple[int, ...]], *, tied: bool
) -> None:
    found = set(files)
    if tied:
        found.discard("lm_head.weight")  # some exporters write the tied tensor twice
    faults = [f"missing {name} {expected_shapes[name]}" for name in sorted(set(expected_shapes) - found)]
    faults += [f"extra {name}" for name in sorted(found - set(expected_shapes))]
    for path in sorted(set(files.values())):
        with _open(path) as file:
            in_file = set(file.keys())
            for name in sorted(n for n in found & set(expected_shapes) if files[n] == path):
                if name not in in_file:
                    faults.append(f"missing {name}: {INDEX_NAME} places it in {path.name}, which lacks it")
                elif (shape := tuple(file.get_slice(name).get_shape())) != expected_shapes[name]:
                    faults.append(f"misshapen {name}: {shape}, config.json says {expected_shapes[name]}")
    if faults:
        rest = len(faults) - MAX_NAMES_SHOWN
        shown = "; ".join(faults[:MAX_NAMES_SHOWN]) + (f"; and {rest} more" if rest > 0 else "")
        raise CheckpointError(f"{directory} does not match its config.json ({len(faults)} faults): {shown}.")


def specialist_name(specialty: Specialty) -> str:
    """The file of its weights in a checkpoint folder."""
    return f"specialist_{specialty.name}.safetensors"


def _readers(ponder: Ponder, directory: Path = Path()) -> list[tuple[Path, Reader]]:
    """Everybody who has weights beside the language model's, and the files of these."""
    specialists: Any = ponder.specialists
    found = [(directory / specialist_name(each), specialists[each.name]) for each in ponder.format.specialties]
    return found if ponder.reader is None else [(directory / READER_NAME, ponder.reader), *found]


def _read_reader(path: Path, reader: Reader, ponder: Ponder) -> None:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: {OWN_NAME} says that there is one; its weights are here.")
    text_model = ponder.qwen.model.language_model
    with _open(path) as file:
        try:
            narrowing = narrowing_of(file)
        except ValueError as error:
            raise CheckpointError(f"{path}: {error}") from None
        _check_tensors(path.parent, dict.fromkeys(file.keys(), path), stored_shapes(reader, narrowing), tied=False)
        read_weights(file, reader, text_model, narrowing)


@torch.no_grad()
def _read_tensors(files: dict[str, Path], ponder: Ponder) -> None:
    own = _own_tensors(ponder.qwen)
    for path in sorted(set(files.values())):
        with _open(path) as file:
            for name in file.keys():  # noqa: SIM118 - safe_open is not a mapping
                if name in own and files.get(name) == path:
                    own[name].copy_(file.get_tensor(name))
                elif name.startswith(MTP_PREFIX) and files.get(name) == path:
                    ponder.mtp[name] = file.get_tensor(name)  # mapped, not read: until it is saved it costs no memory
