"""AdamW as in the paper: linear warm-up, then a constant rate; joint gradient clipping; averaged weights (EMA).

The rate may decay at the end of a run, which the paper's runs do not use. Weights of fewer than 32 bits are rounded
from float32 masters: in bfloat16 an update of a thousandth is less than half of a weight's last bit and would be lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from dual_system.training.parallel import local, whole
from dual_system.training.shards import RowReader

_ADAM_STATE = ("step", "exp_avg", "exp_avg_sq")  # AdamW's state of a parameter
_EMA_MEMORY = 10  # after n steps the average's time constant is at most n / 10 steps


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimConfig:
    """Defaults are the paper's for RoboMME (B.1)."""

    learning_rate: float = 2e-5
    warmup_steps: int = 100
    betas: tuple[float, float] = (0.9, 0.95)
    eps: float = 1e-8
    weight_decay: float = 1e-10
    clip_norm: float = 1.0
    ema_decay: float = 0.0
    """Decay of the weights' exponential moving average; 0: no average."""

    def __post_init__(self) -> None:
        if self.learning_rate <= 0 or self.clip_norm <= 0 or self.warmup_steps < 0:
            raise ValueError("learning_rate and clip_norm must be above 0, warmup_steps at least 0")
        if not 0 <= self.ema_decay < 1:
            raise ValueError(f"ema_decay must be in [0, 1), came {self.ema_decay}")


def learning_rate(config: OptimConfig, step: int) -> float:
    """Rate of the ``step``-th update, counted from 0; it is above 0 from the first one on."""
    return config.learning_rate * min(1.0, (step + 1) / max(1, config.warmup_steps))


class Optimiser:
    """Updates the trainable parameters and their average, both in float32."""

    def __init__(self, model: nn.Module, config: OptimConfig) -> None:
        self._config = config
        self._named = {name: p for name, p in model.named_parameters() if p.requires_grad}
        if not self._named:
            raise ValueError("nothing to train: every parameter is frozen")
        self._masters = {name: p if p.dtype.itemsize >= 4 else _master(p) for name, p in self._named.items()}
        self._adam = torch.optim.AdamW(
            [{"params": group} for group in self._groups()],
            lr=config.learning_rate,
            betas=config.betas,
            eps=config.eps,
            weight_decay=config.weight_decay,
        )
        self.average = {name: p.detach().clone() for name, p in self._masters.items()} if config.ema_decay else {}

    def collect(self) -> None:
        """Adds the gradients of rounded weights to their masters', so that those of several parts add up in float32."""
        for parameter, master in self._mastered().values():
            if parameter.grad is not None:
                gradient, parameter.grad = parameter.grad.float(), None
                master.grad = gradient if master.grad is None else master.grad + gradient

    def update(self, step: int) -> float:
        """Applies the gradients and clears them; returns their norm before clipping.

        Raises:
            FloatingPointError: the gradients are not finite; nothing was changed.
        """
        self.collect()
        norm = self._clip()
        if not torch.isfinite(torch.tensor(norm)):
            gradients = {name: p.grad for name, p in self._masters.items() if p.grad is not None}
            worst = [name for name, gradient in gradients.items() if not local(gradient).isfinite().all()][:3]
            raise FloatingPointError(
                f"step {step}: gradients are not finite (first in {', '.join(worst)}). Lower learning_rate, or train "
                "in float32; the last checkpoint is untouched."
            )
        for group in self._adam.param_groups:
            group["lr"] = learning_rate(self._config, step)
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)
        with torch.no_grad():
            for parameter, master in self._mastered().values():
                parameter.copy_(master)
            decay = min(self._config.ema_decay, (1 + step) / (_EMA_MEMORY + step))  # forgets early weights soon
            for name, average in self.average.items():
                local(average).lerp_(local(self._masters[name]), 1 - decay)
        return norm

    @torch.no_grad()
    def take_average(self) -> None:
        """Copies the averaged weights into the model; does nothing without an average."""
        for name, average in self.average.items():
            self._named[name].copy_(average)

    def tensors(self) -> dict[str, Tensor]:
        """The optimiser's whole state by name, without the parameters themselves."""
        found = {f"average.{name}": tensor for name, tensor in self.average.items()}
        found |= {f"master.{name}": master.detach() for name, (_, master) in self._mastered().items()}
        for name, parameter in self._masters.items():
            for key, value in self._adam.state[parameter].items():
                found[f"{key}.{name}"] = torch.as_tensor(value)
        return found

    def load(self, stored: RowReader) -> None:
        """Restores the state that ``tensors`` returned; only parameters that had gradients have one.

        The parameters must be loaded already: masters that the checkpoint lacks start from them.

        Raises:
            ValueError: the state is of another model, freeze mode or dtype.
        """
        mastered = self._mastered()
        with torch.no_grad():
            for rounded, master in mastered.values():
                master.copy_(rounded)
        states: dict[str, dict[str, Tensor]] = {}
        for full_name in stored.names():
            key, name = full_name.split(".", 1)
            parameter = self._masters.get(name)
            is_step = key == "step" and stored.shape(full_name) == ()
            fits = parameter is not None and (stored.shape(full_name) == tuple(parameter.shape) or is_step)
            is_own = key in ("average", "master")
            unknown = (key == "average" and name not in self.average) or (key == "master" and name not in mastered)
            if parameter is None or not fits or unknown or not (is_own or key in _ADAM_STATE):
                raise ValueError(f"the optimiser's state is of another model, freeze mode or dtype: it has {full_name}")
            rows = stored.read(full_name, parameter)
            if is_step:
                states.setdefault(name, {})[key] = rows
            elif key == "average":
                local(self.average[name]).copy_(rows)
            elif key == "master":
                local(parameter.detach()).copy_(rows)
            else:
                state = torch.zeros_like(parameter, requires_grad=False)
                local(state).copy_(rows)
                states.setdefault(name, {})[key] = state
        for name, found in states.items():
            self._adam.state[self._masters[name]] = found

    def _groups(self) -> list[list[nn.Parameter]]:
        """Sharded and whole parameters separately, because no torch operation takes both."""
        groups: tuple[list[nn.Parameter], list[nn.Parameter]] = ([], [])
        for each in self._masters.values():
            groups[not isinstance(each, DTensor)].append(each)
        return [group for group in groups if group]

    def _clip(self) -> float:
        """Clips the joint norm of all gradients; returns the norm before."""
        groups = self._groups()
        if len(groups) == 1:
            return float(whole(nn.utils.clip_grad_norm_(groups[0], self._config.clip_norm)))
        gradients = [[each.grad for each in group if each.grad is not None] for group in groups]
        norm = math.hypot(*(float(whole(nn.utils.get_total_norm(group))) for group in gradients))
        scale = min(1.0, self._config.clip_norm / (norm + 1e-6))
        for gradient in (each for group in gradients for each in group):
            gradient.mul_(scale)
        return norm

    def _mastered(self) -> dict[str, tuple[nn.Parameter, nn.Parameter]]:
        """Pairs (parameter, master) by name, for parameters that have a master."""
        pairs = ((name, parameter, self._masters[name]) for name, parameter in self._named.items())
        return {name: (parameter, master) for name, parameter, master in pairs if master is not parameter}


def _master(parameter: nn.Parameter) -> nn.Parameter:
    return nn.Parameter(parameter.detach().float())
