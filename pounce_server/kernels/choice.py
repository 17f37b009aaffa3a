"""Selects the fastest library per matrix product on this GPU: timed once and stored on disk.

cuBLAS and cuBLASLt compute the same product with different kernels, and neither is always faster. The choice is made
at the first use of a shape, before a graph is captured (`graphs.cuda_graphs` runs work first). The file also holds the
choices of other GPUs and versions, which are kept.
"""

# M rows, K inputs, N outputs

import contextlib
import json
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TypeAlias

import torch
from torch import Tensor

from dual_system.models.kernels.launch import Timer

LIBRARIES = ("cublas", "cublaslt")

Switch: TypeAlias = Callable[[str], AbstractContextManager[None]]
"""Returns a context in which torch uses the named library."""


def default_cache() -> Path:
    """Default file of choices, in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ponderpounce" / "products.json"


def machine_name(device: torch.device) -> str:
    """Key of the machine's choices: the GPU's name and the versions of torch and CUDA."""
    return f"{torch.cuda.get_device_name(device)}, torch {torch.__version__}, CUDA {torch.version.cuda}"


class Choices:
    """The file of choices: machine -> product -> library. A damaged file is replaced; timing again costs a few ms."""

    def __init__(self, path: Path, machine: str) -> None:
        self._path, self._machine = path, machine
        self._mine = {name: value for name, value in self._read().get(machine, {}).items() if value in LIBRARIES}

    def get(self, product: str) -> str | None:
        return self._mine.get(product)

    def keep(self, product: str, library: str) -> None:
        """Stores a choice atomically, and keeps those that other processes wrote meanwhile."""
        self._mine[product] = library
        everything = self._read()
        everything[self._machine] = everything.get(self._machine, {}) | self._mine
        self._path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self._path.with_name(f"{self._path.name}.{os.getpid()}.tmp")
        fresh.write_text(json.dumps(everything, indent=1, sort_keys=True) + "\n")
        fresh.replace(self._path)

    def _read(self) -> dict[str, dict[str, str]]:
        try:
            values = json.loads(self._path.read_text())
        except (OSError, ValueError):
            return {}
        if not isinstance(values, dict):
            return {}
        return {machine: choices for machine, choices in values.items() if isinstance(choices, dict)}


class ChosenProduct:
    """Multiplies like `product`, each shape with its fastest library."""

    def __init__(self, choices: Choices, timer: Timer, switch: Switch) -> None:
        self._choices, self._timer, self._switch = choices, timer, switch

    def __call__(self, x_MK: Tensor, weight_NK: Tensor, out_MN: Tensor, bias_N: Tensor | None = None) -> None:
        (rows, inputs), outputs = x_MK.shape, len(weight_NK)
        bias = "" if bias_N is None else " + bias"
        name = f"{str(x_MK.dtype).removeprefix('torch.')} {rows}x{inputs}x{outputs}{bias}"
        library = self._choices.get(name)
        if library is None:
            library = self._fastest(x_MK, weight_NK, out_MN, bias_N)
            self._choices.keep(name, library)
        with self._switch(library):
            product(x_MK, weight_NK, out_MN, bias_N)

    def _fastest(self, x_MK: Tensor, weight_NK: Tensor, out_MN: Tensor, bias_N: Tensor | None) -> str:
        times = {}
        for library in LIBRARIES:
            with self._switch(library):
                times[library] = self._timer(lambda: product(x_MK, weight_NK, out_MN, bias_N))
        return min(LIBRARIES, key=times.__getitem__)


def product(x_MK: Tensor, weight_NK: Tensor, out_MN: Tensor, bias_N: Tensor | None = None) -> None:
    """Writes x W^T, plus a bias, to ``out_MN``, with torch's preferred library."""
    if bias_N is None:
        torch.mm(x_MK, weight_NK.T, out=out_MN)
    else:
        torch.addmm(bias_N, x_MK, weight_NK.T, out=out_MN)


@contextlib.contextmanager
def preferring(library: str) -> Iterator[None]:
    """The `Switch` for CUDA builds of torch; CPU builds have no such option."""
    before = torch.backends.cuda.preferred_blas_library()
    torch.backends.cuda.preferred_blas_library(library)
    try:
        yield
    finally:
        torch.backends.cuda.preferred_blas_library(before)
