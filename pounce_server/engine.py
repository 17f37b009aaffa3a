"""A POUNCE of either family as an action engine: one request in, one chunk of absolute joint targets out."""

# N horizon, A padded action dim

import time
from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ponderpounce.models.flow import EulerStep
from ponderpounce.models.groot_prompt import EagleTokenizer
from ponderpounce.models.pounce import Pounce
from ponderpounce.models.pounce_checkpoint import PounceBundle
from ponderpounce.models.pounce_family import AnyPounce
from ponderpounce.models.prompt import Tokenizer
from pounce_server.contract import (
    DTypeName,
    EngineSpec,
    PounceEngine,
    Progress,
    Request,
    check_request,
    example_request,
    no_progress,
)
from pounce_server.precision import cast_for_serving
from pounce_server.reading import groot_inputs, pi05_inputs

__all__ = ["EagerEngine", "EngineSpec", "PounceEngine", "Request"]

Sampler: TypeAlias = Callable[[Request, Tensor], Iterator[EulerStep]]
"""Reads a request and yields the flow steps from a given noise, (1, N, A)."""

WARM_UP_UNMEASURED = 3
WARM_UP_MEASURED = 20


class EagerEngine:
    """Eager PyTorch, for one thread at a time. Takes over the bundle's model: casts and moves it in place."""

    def __init__(self, bundle: PounceBundle, *, device: str = "cpu", dtype: DTypeName = "float32") -> None:
        config = bundle.model.config
        self._statistics = bundle.statistics
        self._padded_action_dim = config.padded_action_dim
        self._device = torch.device(device)
        self.spec = EngineSpec(
            horizon=config.horizon,
            action_dim=config.robot_action_dim,
            proprio_dim=bundle.statistics.state.num_dims,
            num_carriers=config.cognition.num_carriers,
            cognition_size=config.cognition.cognition_size,
            image_px=config.image_px,
            num_steps=config.num_steps,
            num_cameras=config.num_cameras,
            model_hash=bundle.digest(),
            is_random=bundle.is_random,
            has_fresh_prefix=bundle.has_fresh_prefix,
            dtype=dtype,
        )
        model = cast_for_serving(bundle.model, dtype).to(self._device).eval()
        self._sample = _sampler(model, bundle, self._device)

    @torch.inference_mode()
    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        """See `PounceEngine.invoke`.

        Raises:
            ValueError: the request does not fit ``spec``, or holds a number that is not finite.
        """
        check_request(request, self.spec)
        actions_BNA = noise_BNA = self._noise(request.seed)
        for step in self._sample(request, noise_BNA):
            actions_BNA = step.actions
            progress()
        robot_actions_N8 = actions_BNA[0, :, : self.spec.action_dim].cpu().numpy()
        return self._statistics.absolute_targets(robot_actions_N8, request.proprio)

    def warm_up(self) -> list[int]:
        """See `PounceEngine.warm_up`. The rows end on the CPU, so a duration includes the device's work."""
        request = example_request(self.spec)
        durations_ns = []
        for _ in range(WARM_UP_UNMEASURED + WARM_UP_MEASURED):
            start_ns = time.perf_counter_ns()
            self.invoke(request)
            durations_ns.append(time.perf_counter_ns() - start_ns)
        return durations_ns[WARM_UP_UNMEASURED:]

    def _noise(self, seed: int) -> Tensor:
        """Drawn on the CPU: one seed is one noise on every device."""
        generator = torch.Generator().manual_seed(seed)
        shape = (1, self.spec.horizon, self._padded_action_dim)
        return torch.randn(shape, generator=generator).to(self._device)


@torch.inference_mode()
def _sampler(model: AnyPounce, bundle: PounceBundle, device: torch.device) -> Sampler:
    """Tabulates what depends on the flow step only, and returns the rest."""
    statistics, tokenizer = bundle.statistics, bundle.tokenizer
    if isinstance(model, Pounce):
        assert isinstance(tokenizer, Tokenizer), "the bundle checks this"
        pi05, text, table = model, tokenizer, model.step_table()
        return lambda request, noise: pi05.sample(
            pi05_inputs(request, pi05.config, text, statistics, device), noise, table
        )
    assert isinstance(tokenizer, EagleTokenizer), "the bundle checks this"
    groot, eagle_text, groot_table = model, tokenizer, model.step_table()
    return lambda request, noise: groot.sample(
        groot_inputs(request, groot.config, eagle_text, statistics, device), noise, groot_table
    )
