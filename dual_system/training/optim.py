"""AdamW as the paper runs it: linear warm-up, then constant; joint gradient norm clipped; weights averaged.

Networks that learn from scratch may end with a falling rate, which the paper's do not need.

Networks that learn from scratch may also have their matrices turned by Muon (K. Jordan et al., 2024; scaled as in
arXiv:2502.16982, so that AdamW's rates serve), which the paper's do not need either.

Weights of fewer than 32 bits have float32 masters that are updated in their place, and are rounded from them: in
bfloat16 itself an update of a thousandth is less than half of a weight's last bit, and nothing would ever move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from dual_system.training.muon import Muon
from dual_system.training.parallel import local, whole
from dual_system.training.shards import RowReader

_LEAST_RATE = 0.02
_LEAST_RANK = 8  # a matrix of fewer rows is a few vectors: there is little to turn
_LOOKED_UP = ("embed", "lm_head")  # one row a token or a place: rows are learned apart, seldom ones seldom
_EMA_MEMORY = 10  # the average of n steps goes back n / 10 of them at most


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimConfig:
    """Defaults are the paper's for RoboMME (B.1)."""

    learning_rate: float = 2e-5
    warmup_steps: int = 100
    decay: tuple[int, int] | None = None
    """Between these two steps the rate falls in proportion, to a fiftieth; None: it stays."""
    betas: tuple[float, float] = (0.9, 0.95)
    eps: float = 1e-8
    weight_decay: float = 1e-10
    clip_norm: float = 1.0
    ema_decay: float = 0.0
    """0: no average is kept."""
    matrices: Literal["adamw", "muon"] = "adamw"
    """What updates hidden layers' matrices; AdamW updates all else. Muon needs them whole (not sharded)."""

    def __post_init__(self) -> None:
        if self.learning_rate <= 0 or self.clip_norm <= 0 or self.warmup_steps < 0:
            raise ValueError("learning_rate and clip_norm must be above 0, warmup_steps at least 0")
        if not 0 <= self.ema_decay < 1:
            raise ValueError(f"ema_decay must be in [0, 1), came {self.ema_decay}")
        if self.decay is not None and not 0 <= self.decay[0] < self.decay[1]:
            raise ValueError(f"decay must be two steps in order, came {self.decay}")


def learning_rate(config: OptimConfig, step: int) -> float:
    """Of the ``step``-th update, from 0: the first one already moves."""
    rate = config.learning_rate * min(1.0, (step + 1) / max(1, config.warmup_steps))
    if config.decay is None:
        return rate
    first, last = config.decay
    return rate * min(1.0, max(_LEAST_RATE, (last - step) / (last - first)))


class Optimiser:
    """Updates the parameters that want gradients, and their average. Both are kept in float32."""

    def __init__(self, model: nn.Module, config: OptimConfig) -> None:
        self._config = config
        self._named = {name: p for name, p in model.named_parameters() if p.requires_grad}
        if not self._named:
            raise ValueError("nothing to train: every parameter is frozen")
        self._masters = {name: p if p.dtype.itemsize >= 4 else _master(p) for name, p in self._named.items()}
        turned = [p for name, p in self._masters.items() if config.matrices == "muon" and is_turned(name, p)]
        if any(isinstance(each, DTensor) for each in turned):
            raise ValueError("Muon needs whole matrices, these are sharded: give --weights whole, or matrices='adamw'")
        self._turned = {id(each) for each in turned}
        groups = [[each for each in group if id(each) not in self._turned] for group in self._groups()]
        adam = torch.optim.AdamW(
            [{"params": group} for group in groups if group] or [{"params": []}],
            lr=config.learning_rate,
            betas=config.betas,
            eps=config.eps,
            weight_decay=config.weight_decay,
        )
        self._parts: list[tuple[torch.optim.Optimizer, tuple[str, ...]]] = [(adam, ("step", "exp_avg", "exp_avg_sq"))]
        """And what each remembers of a parameter."""
        if turned:
            muon = Muon(turned, lr=config.learning_rate, weight_decay=config.weight_decay)
            self._parts.append((muon, ("momentum_buffer",)))
        self.average = {name: p.detach().clone() for name, p in self._masters.items()} if config.ema_decay else {}

    def update(self, step: int) -> float:
        """Applies the gradients and clears them; returns their norm before clipping.

        Raises:
            FloatingPointError: the gradients are not finite; nothing was changed.
        """
        for parameter, master in self._mastered().values():
            if parameter.grad is not None:
                master.grad, parameter.grad = parameter.grad.float(), None
        norm = self._clip()
        if not torch.isfinite(torch.tensor(norm)):
            gradients = {name: p.grad for name, p in self._masters.items() if p.grad is not None}
            worst = [name for name, gradient in gradients.items() if not local(gradient).isfinite().all()][:3]
            raise FloatingPointError(
                f"step {step}: gradients are not finite (first in {', '.join(worst)}). Lower learning_rate, or train "
                "in float32; the last checkpoint is untouched."
            )
        for part, _ in self._parts:
            for group in part.param_groups:
                group["lr"] = learning_rate(self._config, step)
            part.step()
            part.zero_grad(set_to_none=True)
        with torch.no_grad():
            for parameter, master in self._mastered().values():
                parameter.copy_(master)
            decay = min(self._config.ema_decay, (1 + step) / (_EMA_MEMORY + step))  # early weights are soon forgotten
            for name, average in self.average.items():
                local(average).lerp_(local(self._masters[name]), 1 - decay)
        return norm

    @torch.no_grad()
    def take_average(self) -> None:
        """Copies the averaged weights into the model; nothing where no average is kept."""
        for name, average in self.average.items():
            self._named[name].copy_(average)

    def tensors(self) -> dict[str, Tensor]:
        """Everything that the next update depends on besides the parameters."""
        found = {f"average.{name}": tensor for name, tensor in self.average.items()}
        found |= {f"master.{name}": master.detach() for name, (_, master) in self._mastered().items()}
        for name, parameter in self._masters.items():
            part, _ = self._part_of(parameter)
            for key, value in part.state[parameter].items():
                found[f"{key}.{name}"] = torch.as_tensor(value)
        return found

    def load(self, stored: RowReader) -> None:
        """Takes back what ``tensors`` gave: the state of every parameter that had a gradient so far.

        The parameters themselves must be loaded already: a checkpoint from before there were masters has none.

        Raises:
            ValueError: it is another model's, or of another freeze mode or dtype.
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
            if parameter is None or not fits or unknown or not (is_own or key in self._part_of(parameter)[1]):
                raise ValueError(
                    f"the optimiser's state is of another model, freeze mode, dtype or optimiser: it has {full_name}"
                )
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
            part, _ = self._part_of(self._masters[name])
            part.state[self._masters[name]] = found

    def _part_of(self, parameter: nn.Parameter) -> tuple[torch.optim.Optimizer, tuple[str, ...]]:
        """What updates a parameter, and what it remembers of it."""
        return self._parts[id(parameter) in self._turned]

    def _groups(self) -> list[list[nn.Parameter]]:
        """Those of which a process holds its rows, and those of which it holds all: no operation takes both at once."""
        groups: tuple[list[nn.Parameter], list[nn.Parameter]] = ([], [])
        for each in self._masters.values():
            groups[not isinstance(each, DTensor)].append(each)
        return [group for group in groups if group]

    def _clip(self) -> float:
        """Shortens the gradients, all together; returns their norm before."""
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
        """Parameters that have a master, and it."""
        pairs = ((name, parameter, self._masters[name]) for name, parameter in self._named.items())
        return {name: (parameter, master) for name, parameter, master in pairs if master is not parameter}


def is_turned(name: str, parameter: nn.Parameter) -> bool:
    """True for the matrix of a hidden layer."""
    is_matrix = parameter.ndim == 2 and min(parameter.shape) >= _LEAST_RANK
    return is_matrix and not any(each in name for each in _LOOKED_UP)


def _master(parameter: nn.Parameter) -> nn.Parameter:
    return nn.Parameter(parameter.detach().float())
