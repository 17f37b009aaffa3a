"""Reading and writing checkpoints in a public layout: the code that both families share.

A layout is a table of names and a few peculiarities: stored tensors that are never used, a prefix that another
project's policy class adds. Our own tensors are in the same file under ``pounce_prefix.``.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

COGNITION = "pounce_prefix."
INDEX_SUFFIX = ".index.json"


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


def weights_files(path: Path) -> list[Path]:
    """Returns the safetensors files of a model: ``path`` itself, or the shards that ``path``.index.json lists.

    Raises:
        FileNotFoundError: neither is there, or a listed shard is missing.
        WeightsError: the index does not parse.
    """
    if path.is_file():
        return [path]
    index = path.with_name(path.name + INDEX_SUFFIX)
    if not index.is_file():
        raise FileNotFoundError(f"checkpoint {path.parent} has no {path.name} and no {index.name}")
    try:
        listed = set(json.loads(index.read_text())["weight_map"].values())
    except (ValueError, KeyError, AttributeError) as error:
        raise WeightsError(str(index), {"unreadable": [f"no weight_map: {error}"]}) from error
    shards = sorted(path.with_name(name) for name in listed)
    lost = [shard.name for shard in shards if not shard.is_file()]
    if lost:
        raise FileNotFoundError(f"checkpoint {path.parent}: {index.name} lists {', '.join(lost)}, not there")
    return shards


def read_tensors(path: Path, is_used: Callable[[str], bool] = lambda name: True) -> dict[str, Tensor]:
    """Reads the tensors of a file or of its shards; those for which ``is_used`` is False are never read."""
    tensors: dict[str, Tensor] = {}
    for file_path in weights_files(path):
        try:
            with safe_open(file_path, framework="pt") as file:
                names = [name for name in file.keys() if is_used(name)]  # noqa: SIM118, no mapping
                tensors |= {name: file.get_tensor(name) for name in names}
        except SafetensorError as error:
            raise WeightsError(str(file_path), {"unreadable": [str(error)]}) from error
    return tensors


def write_tensors(tensors: Mapping[str, Tensor], path: Path) -> None:
    save_file({name: tensor.contiguous().cpu() for name, tensor in tensors.items()}, path, metadata={"format": "pt"})


def renamed(name: str, table: Iterable[tuple[str, str]]) -> str:
    """Replaces the prefix of ``name`` by the first entry (ours, public) of ``table`` that matches.

    Raises:
        KeyError: no entry matches.
    """
    for ours, public in table:
        if name.startswith(ours):
            return public + name.removeprefix(ours)
    raise KeyError(f"no public name for parameter {name!r}")


def assign(model: nn.Module, found: Mapping[str, Tensor], public_name: Callable[[str], str], source: str) -> bool:
    """Loads tensors with public names into ``model``, float32 throughout; returns whether a cognition prefix was there.

    A public file has none: the model then keeps its own prefix parameters.

    Raises:
        WeightsError: a tensor is missing, unknown or of another shape.
    """
    wanted = {public_name(name): name for name in model.state_dict()}
    has_prefix = any(name.startswith(COGNITION) for name in found)
    if not has_prefix:
        wanted = {public: name for public, name in wanted.items() if not public.startswith(COGNITION)}
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
        raise WeightsError(source, problems)
    # Copied even if float32 already: tensors of a mapped file are unaligned, and CPU products of unaligned
    # weights differ in the last bit from those of the saved model.
    state = {name: found[public].to(torch.float32, copy=True) for public, name in wanted.items()}
    model.load_state_dict(state, strict=False, assign=True)
    return has_prefix
