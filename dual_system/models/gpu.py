"""A GPU's settings for the whole process, and the generator that draws random weights where they will lie."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor


def settle(device: torch.device, *, tf32: bool = False) -> None:
    """Sets torch's switches for networks on ``device``; on a CPU nothing.

    float32 means float32 unless ``tf32``: torch's own default is TF32 in convolutions. cuDNN's attention is off: it
    makes a plan for every new shape, the number of pictures included, and each takes up to a second.
    """
    if device.type != "cuda":
        return
    torch.backends.cuda.matmul.allow_tf32 = tf32
    torch.backends.cudnn.allow_tf32 = tf32
    torch.backends.cuda.enable_cudnn_sdp(False)


def current(device: torch.device) -> AbstractContextManager[object]:
    """A context in which ``device`` is the current GPU: Triton launches its kernels there, wherever the tensors are."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def generator_for(device: torch.device, seed: int) -> torch.Generator:
    """The generator of random weights on ``device``: a GPU's own, which draws billions in a second, else the CPU's.

    One seed gives the same weights on every CPU, and others on a GPU.
    """
    return torch.Generator(device if device.type == "cuda" else "cpu").manual_seed(seed)


def send(host: Tensor, to: Tensor) -> None:
    """Copies ``host`` to ``to``; if that is on a GPU, from pinned memory, so that the host does not wait for the work
    before it. torch gives that memory to nobody else before the copy has ended."""
    if to.device.type == "cuda":
        to.copy_(host.pin_memory(), non_blocking=True)
    else:
        to.copy_(host)
