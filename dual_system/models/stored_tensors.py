"""Tensors of a checkpoint: names and shapes from the headers of its safetensors files, then the numbers one by one.

What can be wrong with a folder from elsewhere is refused here, for PONDER and POUNCE alike, and where possible before
a number is read: Git LFS pointers, oversized headers, an index that leads elsewhere or contradicts its files, quantised
weights, numbers that are not finite. Names lose the parts that torch.compile, DDP and FSDP put into them.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from dual_system.hub import instead_of
from protocol.files import read_object, require_file

Shape = tuple[int, ...]

INDEX_SUFFIX = ".index.json"
MAX_HEADER_BYTES = 25_000_000
"""Longest header that is parsed; 900 tensors need 100 kB."""
MAX_NAMES_SHOWN = 8
_WRAPPERS = frozenset({"_orig_mod", "module", "_fsdp_wrapped_module", "_checkpoint_wrapped_module"})
"""Parts of a name that a wrapper around a module adds; no parameter of ours or of a public layout is called so."""
_FLOATS = frozenset({"F64", "F32", "F16", "BF16"})


class CheckpointError(ValueError):
    """A checkpoint folder does not hold the network that its config.json describes."""


class WeightsError(CheckpointError):
    """Tensors do not fit; names what is missing, unknown and misshapen."""

    def __init__(self, source: str, problems: Mapping[str, Iterable[str]]) -> None:
        lines = [f"checkpoint {source} does not fit the configured model:"]
        for kind, names in problems.items():
            listed = sorted(names)
            if listed:
                more = f" and {len(listed) - MAX_NAMES_SHOWN} more" if len(listed) > MAX_NAMES_SHOWN else ""
                lines.append(f"  {len(listed)} {kind}: {', '.join(listed[:MAX_NAMES_SHOWN])}{more}")
        lines.append("Check that config.json describes this model.safetensors.")
        super().__init__("\n".join(lines))


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a tensor is stored."""

    path: Path
    name: str
    shape: Shape
    dtype: str  # safetensors' word for it


class StoredTensors:
    """The tensors of a file, or of the shards that its index lists, by name.

    Attributes:
        shapes: shape of every tensor.
    """

    def __init__(self, places: Mapping[str, _Place]) -> None:
        self._places = places
        self.shapes: dict[str, Shape] = {name: place.shape for name, place in places.items()}

    @classmethod
    def of(cls, path: Path) -> Self:
        """Reads the headers of ``path``, or of the shards in ``path``.index.json.

        Raises:
            OSError: neither is there, a shard is missing, or a file may not be read.
            ValueError: a file is a Git LFS pointer, or the index is no JSON object.
            CheckpointError: a file is no safetensors file, or the index contradicts its files.
        """
        places: dict[str, _Place] = {}
        for file_path in weights_files(path):
            for place in _places(file_path):
                plain = ".".join(part for part in place.name.split(".") if part not in _WRAPPERS)
                if plain in places:
                    raise CheckpointError(f"{file_path}: {place.name} is stored twice, also as {places[plain].name}")
                places[plain] = place
        if (index := _index_of(path)).exists():
            _check_index(index, places)
        return cls(places)

    def named(self, rename: Callable[[str], str | None]) -> "StoredTensors":
        """The same tensors under other names, without those for which ``rename`` gives None."""
        new = [(name, place) for old, place in self._places.items() if (name := rename(old)) is not None]
        places = dict(new)
        if len(places) < len(new):
            raise CheckpointError(f"{new[0][1].path}: {len(new) - len(places)} tensors have two spellings of one name")
        return StoredTensors(places)

    def read(self) -> Iterator[tuple[str, Tensor]]:
        """Yields every tensor, mapped from its file.

        Raises:
            CheckpointError: a tensor is not of floating point, or has numbers that are not finite.
        """
        for path in sorted({place.path for place in self._places.values()}):
            with safe_open(path, framework="pt") as file:
                for name, place in self._places.items():
                    if place.path == path:
                        if place.dtype not in _FLOATS:
                            raise CheckpointError(
                                f"{path}: {place.name} is {place.dtype}, expected floating point; quantised folders "
                                "are not read, use the one they were made from"
                            )
                        tensor = file.get_tensor(place.name)
                        require_finite(tensor, place.name, path)
                        yield name, tensor


def weights_files(path: Path) -> list[Path]:
    """Returns the safetensors files of a model: ``path`` itself, or the shards that ``path``.index.json lists.

    Raises:
        OSError: neither is there, a listed shard is missing, or a file may not be read.
        ValueError: a file is a Git LFS pointer, or the index is no JSON object.
        CheckpointError: the index lists no file names, or is there beside a file that it does not list.
    """
    index = _index_of(path)
    if not index.exists():
        if not path.exists() and not path.is_symlink():
            raise FileNotFoundError(
                f"checkpoint {path.parent} has no {path.name} and no {index.name}{instead_of(path.parent)}"
            )
        require_file(path)
        return [path]
    listed = _weight_map(index)
    if path.exists() and path.name not in listed.values():
        raise CheckpointError(
            f"checkpoint {path.parent} has {path.name}, and {index.name} lists other files; remove what is stale"
        )
    shards = sorted(path.with_name(name) for name in {*listed.values()})
    for shard in shards:
        if not shard.exists() and not shard.is_symlink():
            raise FileNotFoundError(f"checkpoint {path.parent}: {index.name} lists {shard.name}, which is not there")
        require_file(shard)
    return shards


def require_shapes(expected: Mapping[str, Shape], found: Mapping[str, Shape], source: str) -> None:
    """Raises WeightsError if a tensor is missing, unknown or of another shape."""
    problems = {
        "missing": expected.keys() - found.keys(),
        "unknown": found.keys() - expected.keys(),
        "misshapen": [
            f"{name} expected {expected[name]} came {found[name]}"
            for name in expected.keys() & found.keys()
            if expected[name] != found[name]
        ],
    }
    if any(problems.values()):
        raise WeightsError(source, problems)


def require_finite(tensor: Tensor, name: str, source: Path | str) -> None:
    """Raises CheckpointError if a number is NaN or infinite: the network would act on it without a word."""
    if tensor.numel() and not all(map(torch.isfinite, torch.aminmax(tensor))):  # both NaN if a number is
        raise CheckpointError(
            f"{source}: {name} has numbers that are NaN or infinite; the training diverged, or a conversion overflowed"
        )


def refuse_quantised(values: Mapping[str, Any], config_path: Path) -> None:
    """Raises CheckpointError if a config.json declares quantised weights."""
    nested = [each for each in values.values() if isinstance(each, dict)]
    for each in (values, *nested):
        if (declared := each.get("quantization_config")) is not None:
            method = declared.get("quant_method", "unnamed") if isinstance(declared, dict) else declared
            raise CheckpointError(
                f"{config_path}: the folder is quantised (quantization_config: {method}); use the folder it was made "
                "from, servers quantise with --weights int8"
            )


def require_layers(values: Any, stored: StoredTensors, config_path: Path) -> None:
    """Raises CheckpointError if a config.json describes more layers than there are tensors: they would be built first.

    ``values``: its parsed contents; numbers of layers are called ``depth`` or ``..num_hidden_layers`` anywhere in it.
    """
    for name, value in values.items() if isinstance(values, dict) else ():
        if isinstance(value, dict):
            require_layers(value, stored, config_path)
        elif name.endswith(("depth", "num_hidden_layers")) and isinstance(value, int) and value > len(stored.shapes):
            raise CheckpointError(
                f"{config_path}: {name} is {value}, and {len(stored.shapes)} tensors are stored; they are of another "
                "network"
            )


def _index_of(path: Path) -> Path:
    return path.with_name(path.name + INDEX_SUFFIX)


def _weight_map(index: Path) -> dict[str, str]:
    listed = read_object(index).get("weight_map")
    if not isinstance(listed, dict) or not listed:
        raise CheckpointError(f"{index}: expected a weight_map with the file of every tensor, came {str(listed)[:80]}")
    for name, file_name in listed.items():
        if not isinstance(file_name, str) or Path(file_name).name != file_name or file_name in ("", ".."):
            raise CheckpointError(f"{index}: expected the name of a file beside it for {name}, came {file_name!r}")
    return listed


def _check_index(index: Path, places: Mapping[str, _Place]) -> None:
    """Raises WeightsError unless the index lists every tensor at its place, and no other."""
    listed, there = _weight_map(index), {place.name: place.path.name for place in places.values()}
    problems = {
        "not in the file in which the index places them": [
            f"{name} ({file_name})" for name, file_name in listed.items() if there.get(name) != file_name
        ],
        "not in the index": there.keys() - listed.keys(),
    }
    if any(problems.values()):
        raise WeightsError(str(index), problems)


def _places(path: Path) -> Iterator[_Place]:
    """Yields the tensors of a file, by its header. Raises CheckpointError if it is no safetensors file."""
    with path.open("rb") as file:
        num_header_bytes = int.from_bytes(file.read(8), "little")
    if num_header_bytes > min(MAX_HEADER_BYTES, path.stat().st_size):
        raise CheckpointError(
            f"{path} is no safetensors file, or was cut short: its header would have {num_header_bytes} bytes"
        )
    try:
        with safe_open(path, framework="pt") as opened:
            for name in opened.keys():  # noqa: SIM118, no mapping
                found = opened.get_slice(name)
                yield _Place(path, name, tuple(found.get_shape()), found.get_dtype())
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is no safetensors file, or was cut short: {error}") from error
