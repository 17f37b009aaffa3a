"""pi0.5 as an action engine: one request in, one chunk of absolute joint targets out."""

# N horizon, A padded action dim

import time

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ponderpounce.models.images import camera_batch
from ponderpounce.models.pounce import PounceInputs
from ponderpounce.models.pounce_checkpoint import PounceBundle
from ponderpounce.models.prompt import prompt_text
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

__all__ = ["EngineSpec", "Pi05Engine", "PounceEngine", "Request"]

WARM_UP_UNMEASURED = 3
WARM_UP_MEASURED = 20


class Pi05Engine:
    """Eager PyTorch, for one thread at a time. Takes over the bundle's model: casts and moves it in place."""

    def __init__(self, bundle: PounceBundle, *, device: str = "cpu", dtype: DTypeName = "float32") -> None:
        config = bundle.model.config
        self._tokenizer = bundle.tokenizer
        self._statistics = bundle.statistics
        self._config = config
        self._device = torch.device(device)
        self.spec = EngineSpec(
            horizon=config.pi05.horizon,
            action_dim=config.robot_action_dim,
            proprio_dim=bundle.statistics.state.num_dims,
            num_carriers=config.cognition.num_carriers,
            cognition_size=config.cognition.cognition_size,
            image_px=config.pi05.vision.image_px,
            num_steps=config.num_steps,
            num_cameras=config.num_cameras,
            model_hash=bundle.digest(),
            is_random=bundle.is_random,
            has_fresh_prefix=bundle.has_fresh_prefix,
            dtype=dtype,
        )
        self._model = cast_for_serving(bundle.model, dtype).to(self._device).eval()
        with torch.inference_mode():
            self._table = self._model.step_table()

    @torch.inference_mode()
    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        """See `PounceEngine.invoke`.

        Raises:
            ValueError: the request does not fit ``spec``, or holds a number that is not finite.
        """
        check_request(request, self.spec)
        inputs = self._inputs(request)
        actions_BNA = noise_BNA = self._noise(request.seed)
        for step in self._model.sample(inputs, noise_BNA, self._table):
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

    def _inputs(self, request: Request) -> PounceInputs:
        """A batch of one without padding, so that no mask hides anything but a missing camera."""
        images, has_view = camera_batch(request.frames, self.spec.image_px)
        state = self._statistics.state.normalise(request.proprio)
        token_ids = self._tokenizer.encode(prompt_text(request.instruction, state))
        if len(token_ids) > self._config.max_prompt_tokens:
            raise ValueError(
                f"prompt has {len(token_ids)} tokens, expected at most {self._config.max_prompt_tokens} "
                f"(max_prompt_tokens); shorten the instruction {request.instruction[:60]!r}"
            )
        cognition = None
        if request.cognition is not None:
            # Copied into aligned memory: where a NumPy array happens to lie changes the last bit of a product.
            cognition = torch.tensor(request.cognition, device=self._device)[None]
        return PounceInputs(
            images=images.to(self._device),
            has_view=has_view.to(self._device),
            token_ids=torch.tensor([token_ids], device=self._device),
            is_token=torch.ones(1, len(token_ids), dtype=torch.bool, device=self._device),
            age_ns=torch.tensor([request.age_ns], device=self._device),
            cognition=cognition,
        )

    def _noise(self, seed: int) -> Tensor:
        """Drawn on the CPU: one seed is one noise on every device."""
        generator = torch.Generator().manual_seed(seed)
        shape = (1, self.spec.horizon, self._config.pi05.action_dim)
        return torch.randn(shape, generator=generator).to(self._device)
