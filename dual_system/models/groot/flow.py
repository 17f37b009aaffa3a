"""Flow matching as GR00T N1.5 does it: t = 0 is noise and t = 1 is data, the other way round than pi0.5 (`flow`).

The network never reads t itself but its bucket: the integer part of 1000 t, truncated towards zero.
"""

# B batch, N horizon, A action dim

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from dual_system.models.flow import EulerStep

# t = (s - b) / s with b ~ Beta(1.5, 1): favours noise. b > s gives a t slightly below 0, in bucket 0.
TIME_BETA_ALPHA = 1.5
TIME_S = 0.999


def noised(actions_BNA: Tensor, noise_BNA: Tensor, time_B: Tensor) -> Tensor:
    """Returns x_t = (1 - t) * noise + t * actions."""
    time_B11 = time_B[:, None, None]
    return (1.0 - time_B11) * noise_BNA + time_B11 * actions_BNA


def target_velocity(actions_BNA: Tensor, noise_BNA: Tensor) -> Tensor:
    """Returns dx_t/dt = actions - noise."""
    return actions_BNA - noise_BNA


def sample_times(batch_size: int, generator: torch.Generator) -> Tensor:
    """Draws training times, (B,) float32 in [-0.001, 1]; by the inverse of Beta(a, 1), as `flow.sample_times`."""
    uniform_B = torch.rand(batch_size, generator=generator, device=generator.device)
    return (TIME_S - uniform_B ** (1.0 / TIME_BETA_ALPHA)) / TIME_S


def time_buckets(time_B: Tensor, num_buckets: int) -> Tensor:
    """Returns (B,) int64. Truncation, not floor: -0.0006 is in bucket 0."""
    return (time_B * num_buckets).long()


def euler_buckets(num_steps: int, num_buckets: int) -> list[int]:
    """Returns the buckets of 0, 1/n, ..., (n-1)/n, the flow times of the Euler steps."""
    if num_steps < 1:
        raise ValueError(f"the Euler sampler needs at least 1 step, came {num_steps}")
    return [int(step / num_steps * num_buckets) for step in range(num_steps)]


def masked_mean(loss_BNA: Tensor, mask_BNA: Tensor) -> Tensor:
    """Averages an unreduced, already masked loss over the unmasked entries."""
    return loss_BNA.sum() / mask_BNA.sum()


def euler(velocity_at: Callable[[int, Tensor], Tensor], noise_BNA: Tensor, num_steps: int) -> Iterator[EulerStep]:
    """Integrates from noise at t = 0 to actions at t = 1; yields after every step."""
    x_BNA = noise_BNA
    for index in range(num_steps):
        velocity_BNA = velocity_at(index, x_BNA)
        x_BNA = x_BNA + velocity_BNA / num_steps
        yield EulerStep(index, velocity_BNA, x_BNA)
