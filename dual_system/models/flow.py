"""Flow matching as pi0.5 does it: the straight path, its velocity, the loss and the Euler sampler.

Convention: t = 1 is noise and t = 0 is data, as in the public pi0.5 code. The pi0 paper and GR00T N1.5 write
it the other way round; weights of one convention, sampled with the other, integrate away from the data.
"""

# B batch, N horizon, A action dim

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

LossDims = Literal["real", "all"]

# t ~ Beta(1.5, 1) * 0.999 + 0.001: favours noise and avoids t = 0, where nothing is left to learn.
TIME_BETA_ALPHA = 1.5
TIME_SPAN = 0.999
TIME_MIN = 0.001


def noised(actions_BNA: Tensor, noise_BNA: Tensor, time_B: Tensor) -> Tensor:
    """Returns x_t = t * noise + (1 - t) * actions."""
    time_B11 = time_B[:, None, None]
    return time_B11 * noise_BNA + (1.0 - time_B11) * actions_BNA


def target_velocity(actions_BNA: Tensor, noise_BNA: Tensor) -> Tensor:
    """Returns u = dx_t/dt = noise - actions."""
    return noise_BNA - actions_BNA


def sample_times(batch_size: int, generator: torch.Generator) -> Tensor:
    """Draws training times, (B,) float32 in [0.001, 1.0].

    Beta(a, 1) has the closed-form inverse u**(1/a): no rejection sampling, so a seed gives the same draw everywhere.
    """
    uniform_B = torch.rand(batch_size, generator=generator, device=generator.device)
    return uniform_B ** (1.0 / TIME_BETA_ALPHA) * TIME_SPAN + TIME_MIN


def mean_loss(loss_BNA: Tensor, num_real_dims: int, over: LossDims = "real") -> Tensor:
    """Averages the unreduced loss over the robot's own dims ("real", lerobot) or all dims ("all", openpi).

    The two differ in scale: with 8 of 32 dims in use, "all" is a quarter of the robot's error plus the error on
    the padding, which is easy to learn. The paper does not specify; the default is "real", so that w_1 = 1
    weighs action error alone.
    """
    if not 0 < num_real_dims <= loss_BNA.shape[-1]:
        raise ValueError(f"num_real_dims must be 1..{loss_BNA.shape[-1]} (padded action dim), came {num_real_dims}")
    if over not in ("real", "all"):
        raise ValueError(f"over must be 'real' or 'all', came {over!r}")
    return (loss_BNA if over == "all" else loss_BNA[..., :num_real_dims]).mean()


def euler_times(num_steps: int) -> list[float]:
    """Returns 1, 1 - 1/n, ..., 1/n: the flow time at which each Euler step evaluates the velocity.

    Computed from the index, as lerobot does. openpi accumulates ``time += dt`` in float32, which moves the
    goldens' actions by up to 2e-5.
    """
    if num_steps < 1:
        raise ValueError(f"the Euler sampler needs at least 1 step, came {num_steps}")
    return [1.0 - step / num_steps for step in range(num_steps)]


@dataclass(frozen=True, slots=True, eq=False)
class EulerStep:
    """One step of the sampler: its flow time, the velocity there, and the actions after it."""

    index: int
    velocity: Tensor
    actions: Tensor


def euler(velocity_at: Callable[[int, Tensor], Tensor], noise_BNA: Tensor, num_steps: int) -> Iterator[EulerStep]:
    """Integrates from noise at t = 1 to actions at t = 0; yields after every step.

    ``velocity_at(index, x_BNA)`` is the network at time ``euler_times(num_steps)[index]``.
    """
    x_BNA = noise_BNA
    for index in range(num_steps):
        velocity_BNA = velocity_at(index, x_BNA)
        x_BNA = x_BNA - velocity_BNA / num_steps
        yield EulerStep(index, velocity_BNA, x_BNA)
