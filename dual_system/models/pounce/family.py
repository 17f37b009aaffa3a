"""One interface to both action models, pi0.5 and GR00T: build, initialise, load and save by the config's type."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, TypeAlias

import torch

from dual_system.models import flow
from dual_system.models.frame_sampling import FrameSampling
from dual_system.models.groot import flow as groot_flow
from dual_system.models.groot import weights as groot_weights
from dual_system.models.groot.pounce import GrootInputs, GrootPounce, GrootPounceConfig
from dual_system.models.pi05 import weights as pi05_weights
from dual_system.models.pi05.pounce import Pounce, PounceConfig, PounceInputs
from dual_system.models.pounce.initialise import random_groot_pounce, random_pounce
from dual_system.models.stored_tensors import WeightsError

Family: TypeAlias = Literal["pi05", "groot"]
AnyPounce: TypeAlias = Pounce | GrootPounce
AnyPounceConfig: TypeAlias = PounceConfig | GrootPounceConfig

# Part of a tensor name in every file of the family, whatever policy class wrote it.
_MARKS: dict[Family, str] = {"pi05": "paligemma_with_expert.", "groot": "backbone.eagle_model."}


def family_of_config(config: AnyPounceConfig) -> Family:
    return "pi05" if isinstance(config, PounceConfig) else "groot"


def blank_model(config: AnyPounceConfig) -> AnyPounce:
    """Returns the model on the meta device, for loading."""
    with torch.device("meta"):
        return Pounce(config) if isinstance(config, PounceConfig) else GrootPounce(config)


def random_model(config: AnyPounceConfig, seed: int, device: torch.device | str = "cpu") -> AnyPounce:
    if isinstance(config, PounceConfig):
        return random_pounce(config, seed, device)
    return random_groot_pounce(config, seed, device)


def action_loss(
    model: AnyPounce,
    inputs: PounceInputs | GrootInputs,
    actions_BNA: torch.Tensor,
    noise_BNA: torch.Tensor,
    time_B: torch.Tensor,
    num_committed_B: torch.Tensor | None = None,
) -> torch.Tensor:
    """Returns the scalar L_fm over the robot's action dims. Raises TypeError for the other family's inputs.

    ``num_committed_B``: number of committed first rows (`committed`); pi0.5 only.
    """
    if isinstance(model, Pounce) and isinstance(inputs, PounceInputs):
        return model.loss(inputs, actions_BNA, noise_BNA, time_B, num_committed_B=num_committed_B)
    if isinstance(model, GrootPounce) and isinstance(inputs, GrootInputs) and num_committed_B is None:
        return model.loss(inputs, actions_BNA, noise_BNA, time_B)
    raise TypeError(f"{type(model).__name__} does not read {type(inputs).__name__}")


def sample_times(model: AnyPounce, count: int, generator: torch.Generator) -> torch.Tensor:
    """Draws training times, (count,) float32, from the family's distribution; the families' t run in opposite ways."""
    draw = flow.sample_times if isinstance(model, Pounce) else groot_flow.sample_times
    return draw(count, generator)


def max_committed_rows(config: AnyPounceConfig) -> int:
    """Largest number of committed rows, in training and with ``--continuity trained``; 0 for GR00T."""
    return config.max_committed_rows if isinstance(config, PounceConfig) else 0


def sampling_of(config: AnyPounceConfig) -> FrameSampling | None:
    """The past pictures that a model with a frame memory reads; None for all others, and for GR00T."""
    memory = config.frame_memory if isinstance(config, PounceConfig) else None
    return None if memory is None else memory.sampling


def own_parts(config: AnyPounceConfig) -> str:
    """What a model has beyond the public network and the cognition prefix, in words; "" for nothing."""
    memory, places = (config.frame_memory, config.num_pointed) if isinstance(config, PounceConfig) else (None, 0)
    parts = [*(["a frame memory"] if memory is not None else []), *(["a pointer"] if places else [])]
    return " and ".join(parts)


def load_weights(model: AnyPounce, path: Path) -> bool:
    """Loads a public file; returns whether it held a cognition prefix. See `pi05.weights` and `groot.weights`."""
    if isinstance(model, Pounce):
        return pi05_weights.load_weights(model, path)
    return groot_weights.load_weights(model, path)


def save_weights(model: AnyPounce, path: Path) -> None:
    if isinstance(model, Pounce):
        pi05_weights.save_weights(model, path)
    else:
        groot_weights.save_weights(model, path)


def family_of(names: Iterable[str], source: str) -> Family:
    """Recognises by tensor names which model a file holds.

    Raises:
        WeightsError: it holds neither.
    """
    names = list(names)
    for family, mark in _MARKS.items():
        if any(mark in name for name in names):
            return family
    raise WeightsError(
        source, {f"tensors, none of them pi0.5's ({_MARKS['pi05']}*) or GR00T N1.5's ({_MARKS['groot']}*)": names}
    )
