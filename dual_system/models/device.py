"""Whether torch can use the device that a user named."""

import torch


def require_device(device: str, option: str = "--device") -> None:
    """Raises ValueError unless tensors can live on ``device``, with torch's reason and what is there instead."""
    try:
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        there = ", ".join(["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))])
        reason = str(error).partition("\n")[0].rstrip(".")
        raise ValueError(
            f"{option} {device} cannot be used: {reason}. torch {torch.__version__} has {there} here"
        ) from None
