"""Data-parallel training: torchrun's environment, FSDP2 over both systems, and sums over all processes.

Each process has its share of a batch's episodes. Gradients are averaged over processes, so each scales its part of the
loss such that the average is the gradient of the whole batch (``trainer``). Parameters keep their names. A process
holds either its rows of every parameter, whose gradients FSDP2 averages, or whole parameters, whose gradients
`average_gradients` averages: that suits CPUs, because the processes then do not synchronise at every layer.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import MixedPrecisionPolicy, fully_shard
from torch.distributed.tensor import DTensor

from dual_system.models.units import units_of

_BITS = {1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}
_FACTOR, _NUM_CHECKSUMS = 31, 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """This process's place among a run's processes; the default is a single process."""

    rank: int = 0
    size: int = 1
    device: str = "cpu"

    def __post_init__(self) -> None:
        if not 0 <= self.rank < self.size:
            raise ValueError(f"rank must be 0..{self.size - 1}, came {self.rank}")

    @property
    def is_first(self) -> bool:
        """True for the process that writes logs and exports."""
        return self.rank == 0

    def share(self, count: int) -> range:
        """This process's share of ``count`` episodes: every ``size``-th.

        Raises:
            ValueError: there are fewer episodes than processes; the others would wait forever for an idle one.
        """
        if count < self.size:
            raise ValueError(
                f"a batch of {count} episodes for {self.size} processes; start at most {count}, or raise batch_episodes"
            )
        return range(self.rank, count, self.size)

    def sums(self, numbers: Sequence[float | Tensor]) -> list[float]:
        """Sums each number over all processes, in float64. All must call it."""
        total = torch.tensor([float(number) for number in numbers], dtype=torch.float64, device=self.device)
        if self.size > 1:
            dist.all_reduce(total)
        return [float(number) for number in total.tolist()]

    def wait(self) -> None:
        """Waits for every process to call it."""
        self.sums([0.0])


@contextmanager
def joined(device: str) -> Iterator[World]:
    """Joins torchrun's process group; without torchrun, yields a world of one. On CUDA the local rank selects the GPU.

    Raises:
        ValueError: torchrun started more processes on this host than it has GPUs.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield World(device=device)
        return
    if device == "cuda":
        local_rank, num_gpus = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if local_rank >= num_gpus:
            raise ValueError(f"process {local_rank} of this host has no GPU: there are {num_gpus}; --nproc-per-node")
        torch.cuda.set_device(local_rank)
    dist.init_process_group("nccl" if device == "cuda" else "gloo")
    try:
        yield World(rank=dist.get_rank(), size=size, device=device)
    finally:
        dist.destroy_process_group()


def require_alike(model: nn.Module, world: World) -> None:
    """Checks that every process built or loaded the same weights; all must call it, before `shard`.

    Raises:
        ValueError: they differ. Averaged gradients would then be wrong for each, though the loss would still fall.
    """
    mine = checksum(model)
    total, squares = world.sums([mine, mine * mine])
    if world.size * squares != total * total:  # equal only if all numbers are; exact up to some hundred processes
        raise ValueError(
            f"process {world.rank} of {world.size} begins with other weights than the rest (checksum {mine}); every "
            "process and host must see the same --out, --ponder and --pounce, and nobody else may write there"
        )


def checksum(model: nn.Module) -> int:
    """Checksum of all weights' bits, below 2**20. In integers, so neither device nor summation order matters."""
    total = 0
    for parameter in model.parameters():
        bits = parameter.detach().view(_BITS[parameter.element_size()]).sum(dtype=torch.int64)
        total = (total * _FACTOR + int(bits)) % _NUM_CHECKSUMS
    return total


def shard(model: nn.Module, world: World) -> None:
    """Shards every parameter over the processes by rows (FSDP2); does nothing for a single process.

    Units are gathered while they run; the remaining parameters stay gathered throughout a step. All processes must
    have built the same weights. FSDP2 reduces gradients of one dtype per unit: trainable parameters of another dtype
    (decays and norms of PONDER's recurrent layers, pi0.5's attention beside a PONDER in bfloat16) stay whole on every
    process, and `average_gradients` averages theirs. Reductions are in float32.
    """
    if world.size == 1:
        return
    mesh = init_device_mesh(world.device, (world.size,))
    left_whole: set[nn.Parameter] = set()
    for unit in [*units_of(model), model]:
        there = (each for each in unit.parameters() if not isinstance(each, DTensor) and each not in left_whole)
        weights = [each for each in there if each.requires_grad]
        dtype = _most(weights)
        left_whole |= {each for each in weights if each.dtype != dtype}
        is_rounded = dtype is not None and dtype.itemsize < 4
        policy = MixedPrecisionPolicy(reduce_dtype=torch.float32) if is_rounded else MixedPrecisionPolicy()
        fully_shard(unit, mesh=mesh, mp_policy=policy, ignored_params=left_whole)


def _most(weights: Sequence[Tensor]) -> torch.dtype | None:
    """The dtype of most elements."""
    counts: Counter[torch.dtype] = Counter()
    for each in weights:
        counts[each.dtype] += each.numel()
    return counts.most_common(1)[0][0] if counts else None


@torch.no_grad()
def average_gradients(model: nn.Module, world: World) -> None:
    """Replaces gradients of whole parameters by their mean over all processes, which must all call it.

    A missing gradient counts as zero if any process has one; FSDP2 has averaged those of sharded parameters already.
    """
    if world.size == 1:
        return
    trained = [each for each in model.parameters() if each.requires_grad and not isinstance(each, DTensor)]
    if not trained:
        return
    has_one = torch.tensor([float(each.grad is not None) for each in trained], device=world.device)
    gradients = [torch.zeros_like(each) if each.grad is None else each.grad for each in trained]
    total = torch.cat([has_one, *(each.flatten().float() for each in gradients)])
    dist.all_reduce(total)
    counts, *means = total.split([len(trained), *(each.numel() for each in trained)])
    for parameter, count, mean in zip(trained, counts.tolist(), means, strict=True):
        if count:
            parameter.grad = (mean / world.size).view_as(parameter).to(parameter.dtype)


def local(tensor: Tensor) -> Tensor:
    """This process's rows of a sharded tensor, sharing memory; the tensor itself if it is whole."""
    return tensor.to_local() if isinstance(tensor, DTensor) else tensor


def whole(tensor: Tensor) -> Tensor:
    """Gathers all rows of a tensor. All processes must call it."""
    return tensor.full_tensor() if isinstance(tensor, DTensor) else tensor


@torch.no_grad()
def gather(model: nn.Module, into: nn.Module | None) -> None:
    """Copies the whole weights into a model of the same kind, one parameter at a time. All processes must call it.

    ``into`` is a model on any device, or None on processes that need no copy.
    """
    targets = None if into is None else dict(into.named_parameters())
    for name, parameter in model.named_parameters():
        value = whole(parameter)
        if targets is not None:
            targets[name].copy_(value)
