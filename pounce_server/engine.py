"""POUNCE of either family as an action engine: for each request a chunk of rows in the robot's units."""

# B requests, N horizon, A padded action dim, D dims of the action space

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dual_system.models import flow
from dual_system.models.flow import EulerStep
from dual_system.models.gpu import current, settle
from dual_system.models.groot.pounce import GrootInputs, GrootPounce
from dual_system.models.groot.prompt import EagleTokenizer
from dual_system.models.pi05 import rtc as rtc
from dual_system.models.pi05.committed import Committed
from dual_system.models.pi05.pounce import Pounce, PounceInputs
from dual_system.models.pi05.prompt import Tokenizer
from dual_system.models.pounce.batching import joined_groot, joined_pi05, of_equal_length
from dual_system.models.pounce.checkpoint import PounceBundle
from dual_system.models.pounce.family import AnyPounce, max_committed_rows, own_parts, sampling_of
from dual_system.models.pounce.precision import cast_streams
from dual_system.models.pounce.reading import groot_inputs, pi05_inputs
from pounce_server.compiled import compiled_sampler
from pounce_server.contract import (
    Continuity,
    DTypeName,
    EngineSpec,
    Progress,
    Request,
    WeightsName,
    check_request,
    example_request,
    no_progress,
)
from pounce_server.fused import fused_for
from pounce_server.guidance import given, guide, with_committed
from pounce_server.int8 import quantise
from pounce_server.roll_forward import placed, rolled

Sampler: TypeAlias = Callable[[Sequence[Request], Tensor], Iterator[tuple[list[int], EulerStep]]]
"""Samples requests from given noise, (B, N, A); yields flow steps, each with the indices of its requests."""

PathName: TypeAlias = Literal["eager", "compile", "max-autotune", "fused"]

NUM_COMPARED = 4
"""Number of example requests on which the error of int8 weights is measured."""
WARM_UP_UNMEASURED = 3
WARM_UP_MEASURED = 20


class EagerEngine:
    """PyTorch for one thread at a time, eager, compiled or fused.

    Takes over the bundle's model: casts, moves and freezes it.

    Raises:
        ValueError: the options exclude each other, or model or device do not support them. ``continuity`` needs pi0.5
            and the eager path, and "trained" a model trained for it; the fused path needs Triton; int8 needs the eager
            path on a CPU; rolling forward excludes ``continuity`` "trained".
    """

    def __init__(
        self,
        bundle: PounceBundle,
        *,
        device: str = "cpu",
        dtype: DTypeName = "float32",
        continuity: Continuity = "none",
        path: PathName = "eager",
        rolls_forward: bool = False,
        weights: WeightsName = "float",
        autotune: bool = False,
    ) -> None:
        if autotune and path != "fused":
            raise ValueError("--autotune chooses among the fused path's products; add --path fused, or leave it out")
        if weights == "int8" and (path != "eager" or torch.device(device).type != "cpu"):
            raise ValueError(
                "int8 weights are for the eager path on a CPU; leave --weights out, and take --dtype bfloat16"
            )
        if rolls_forward and continuity == "trained":
            raise ValueError("--roll-forward plans after the committed rows, --continuity trained with them: take one")
        if rolls_forward and bundle.statistics.space == "native":
            raise ValueError("--roll-forward predicts the Panda's joints; this checkpoint commands another robot")
        self._rolls_forward = rolls_forward
        config = bundle.model.config
        self._statistics = bundle.statistics
        self._network_action_dim, self._padded_action_dim = config.robot_action_dim, config.padded_action_dim
        self._device = torch.device(device)
        settle(self._device)
        self.spec = EngineSpec(
            horizon=config.horizon,
            control_hz=0 if bundle.is_random else config.control_hz,
            action_dim=bundle.statistics.robot_command_dim,
            proprio_dim=bundle.statistics.robot_state_dim,
            space=bundle.statistics.space,
            num_carriers=config.cognition.num_carriers,
            cognition_size=config.cognition.cognition_size,
            image_px=config.image_px,
            num_steps=config.num_steps,
            num_cameras=config.num_cameras,
            cameras=config.cameras,
            model_hash=bundle.digest(),
            is_random=bundle.is_random,
            has_fresh_prefix=bundle.has_fresh_prefix,
            dtype=dtype,
            continuity=continuity,
            max_committed_rows=max_committed_rows(config),
            reads_subgoal=config.reads_subgoal,
            past=sampling_of(config),
        )
        if path != "eager" and (own := own_parts(config)):
            raise ValueError(
                f"this checkpoint has {own}, which --path {path} does not compute; serve it with --path eager"
            )
        model = cast_streams(bundle.model, dtype).to(self._device).eval().requires_grad_(False)
        if path != "eager" and continuity != "none":
            raise ValueError(f"the path {path!r} knows no --continuity; leave one of them out")
        self._fused = fused_for(model, self._device, autotune=autotune) if path == "fused" else None
        if self._fused is not None:
            self._sample = _batched_sampler(model, bundle, self._device, self._fused.sample)
        elif path != "eager":
            with torch.inference_mode():
                run = compiled_sampler(model, path)
            self._sample = _batched_sampler(model, bundle, self._device, run)
        else:
            self._sample = _sampler(model, bundle, self._device, continuity)
        if weights == "int8":
            examples = [example_request(self.spec, seed=seed) for seed in range(NUM_COMPARED)]
            exact = self._network_actions(examples, no_progress)
            quantise(model)
            self._sample = _sampler(model, bundle, self._device, continuity)
            error = float((self._network_actions(examples, no_progress) - exact).abs().mean())
            hash_ = f"{self.spec.model_hash}-int8"
            self.spec = replace(self.spec, weights=weights, model_hash=hash_, action_error=error)

    @torch.inference_mode()
    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        """See `PounceEngine.invoke`.

        Raises:
            ValueError: the request does not fit ``spec``, or has a number that is not finite.
        """
        check_request(request, self.spec)
        (rows_N8,) = self._invoke((request,), progress)
        return rows_N8

    @torch.inference_mode()
    def invoke_many(self, requests: Sequence[Request], progress: Progress = no_progress) -> list[NDArray[np.float32]]:
        """Runs several robots' invocations at once; returns rows for each, in order.

        Rows equal those of `invoke` up to float32 rounding, which depends on the size of products. Prompts may differ
        in length and cameras may be missing; GR00T runs prompts of different lengths one after the other.

        Raises:
            ValueError: there is no request, or one does not fit ``spec``; then nothing is computed.
        """
        if not requests:
            raise ValueError("expected at least one request, came none")
        for index, request in enumerate(requests):
            try:
                check_request(request, self.spec)
            except ValueError as error:
                raise ValueError(f"request {index}: {error}") from error
        return self._invoke(requests, progress)

    def _invoke(self, requests: Sequence[Request], progress: Progress) -> list[NDArray[np.float32]]:
        if not self._rolls_forward:
            return self._planned(requests, progress)
        rolled_requests = [rolled(request, self.spec.horizon) for request in requests]
        return [
            placed(rows, request)
            for rows, request in zip(self._planned(rolled_requests, progress), requests, strict=True)
        ]

    @torch.inference_mode()
    def _network_actions(self, requests: Sequence[Request], progress: Progress) -> Tensor:
        """Normalised actions (B, N, D)."""
        noise_BNA = torch.cat([self._noise(request.seed) for request in requests])
        last: dict[tuple[int, ...], Tensor] = {}
        with current(self._device):
            for moved, step in self._sample(requests, noise_BNA):
                last[tuple(moved)] = step.actions
                progress()
            actions = {moved: part[..., : self._network_action_dim].cpu() for moved, part in last.items()}
        rows = {index: row_ND for moved, part in actions.items() for index, row_ND in zip(moved, part, strict=True)}
        return torch.stack([rows[index] for index in range(len(requests))])

    def _planned(self, requests: Sequence[Request], progress: Progress) -> list[NDArray[np.float32]]:
        robot_actions_BND = self._network_actions(requests, progress).numpy()
        rows_BN8 = [
            self._statistics.absolute_targets(actions_ND, request.proprio)
            for actions_ND, request in zip(robot_actions_BND, requests, strict=True)
        ]
        if self.spec.continuity != "trained":
            return rows_BN8
        most = self.spec.max_committed_rows
        return [with_committed(rows_N8, request, most) for rows_N8, request in zip(rows_BN8, requests, strict=True)]

    def warm_up(self) -> list[int]:
        """See `PounceEngine.warm_up`. The rows end on the CPU, so a duration includes the device's work."""
        request = example_request(self.spec)
        durations_ns = []
        for _ in range(WARM_UP_UNMEASURED + WARM_UP_MEASURED):
            start_ns = time.perf_counter_ns()
            self.invoke(request)
            durations_ns.append(time.perf_counter_ns() - start_ns)
        if self._fused is not None:
            self.spec = replace(self.spec, kernels=self._fused.kernels)
        return durations_ns[WARM_UP_UNMEASURED:]

    def _noise(self, seed: int) -> Tensor:
        """Initial noise, drawn on the CPU, so that a seed gives the same noise on every device."""
        generator = torch.Generator().manual_seed(seed)
        shape = (1, self.spec.horizon, self._padded_action_dim)
        return torch.randn(shape, generator=generator).to(self._device)


@torch.inference_mode()
def _sampler(model: AnyPounce, bundle: PounceBundle, device: torch.device, continuity: Continuity) -> Sampler:
    """Tabulates all that depends on the flow step only, and returns the sampler."""
    statistics, tokenizer = bundle.statistics, bundle.tokenizer
    if isinstance(model, Pounce):
        assert isinstance(tokenizer, Tokenizer), "the bundle checks this"
        if continuity == "rtc":
            return _rtc_sampler(
                model,
                lambda request: pi05_inputs(request, model.config, tokenizer, statistics, device),
                lambda requests: guide(requests, model.config, statistics, device),
            )
        if continuity == "trained" and not model.config.max_committed_rows:
            raise ValueError(
                "this checkpoint was never trained to continue rows (its max_committed_rows is 0): train it with "
                "pp-train --max-committed-rows, or serve it with --continuity rtc"
            )
        return _pi05_sampler(
            model,
            lambda request: pi05_inputs(request, model.config, tokenizer, statistics, device),
            lambda requests: given(requests, model.config, statistics, device) if continuity == "trained" else None,
        )
    if continuity != "none":
        raise ValueError(f"continuity {continuity!r} is pi0.5's only; leave --continuity out for GR00T")
    assert isinstance(tokenizer, EagleTokenizer), "the bundle checks this"
    return _groot_sampler(model, lambda request: groot_inputs(request, model.config, tokenizer, statistics, device))


def _pi05_sampler(
    pi05: Pounce,
    read: Callable[[Request], PounceInputs],
    given_of: Callable[[Sequence[Request]], Committed | None],
) -> Sampler:
    table = pi05.step_table()

    def sample(requests: Sequence[Request], noise_BNA: Tensor) -> Iterator[tuple[list[int], EulerStep]]:
        everyone = list(range(len(requests)))
        inputs = joined_pi05([read(request) for request in requests])
        for step in pi05.sample(inputs, noise_BNA, table, given=given_of(requests)):
            yield everyone, step

    return sample


@torch.inference_mode(False)  # autograd refuses inference tensors
def _rtc_sampler(
    pounce: Pounce,
    read: Callable[[Request], PounceInputs],
    guide_of: Callable[[Sequence[Request]], rtc.Guide | None],
) -> Sampler:
    table = pounce.step_table()

    @torch.inference_mode(False)
    def sample(requests: Sequence[Request], noise_BNA: Tensor) -> Iterator[tuple[list[int], EulerStep]]:
        everyone = list(range(len(requests)))
        cache = pounce.prefill(joined_pi05([read(request) for request in requests]))

        def velocity_at(index: int, x_BNA: Tensor) -> Tensor:
            return pounce.pi05.velocity(x_BNA, table.styles[index], cache)

        pull = guide_of(requests)
        flowing = velocity_at if pull is None else rtc.guided(velocity_at, pull, table.num_steps)
        for step in flow.euler(flowing, noise_BNA.clone(), table.num_steps):
            yield everyone, step

    return sample


def _groot_sampler(groot: GrootPounce, read: Callable[[Request], GrootInputs]) -> Sampler:
    table = groot.step_table()

    def sample(requests: Sequence[Request], noise_BNA: Tensor) -> Iterator[tuple[list[int], EulerStep]]:
        inputs = [read(request) for request in requests]
        for alike in of_equal_length(inputs):
            for step in groot.sample(joined_groot([inputs[index] for index in alike]), noise_BNA[alike], table):
                yield alike, step

    return sample


def _batched_sampler(
    model: AnyPounce,
    bundle: PounceBundle,
    device: torch.device,
    run: Callable[[Any, Tensor], Iterator[EulerStep]],
) -> Sampler:
    """Requests through ``run``, which samples from inputs and noise: all of pi0.5's at once, GR00T's by length."""
    statistics, tokenizer = bundle.statistics, bundle.tokenizer

    def sample(requests: Sequence[Request], noise_BNA: Tensor) -> Iterator[tuple[list[int], EulerStep]]:
        if isinstance(model, Pounce):
            assert isinstance(tokenizer, Tokenizer), "the bundle checks this"
            read = [pi05_inputs(request, model.config, tokenizer, statistics, device) for request in requests]
            for step in run(joined_pi05(read), noise_BNA):
                yield list(range(len(requests))), step
            return
        assert isinstance(tokenizer, EagleTokenizer), "the bundle checks this"
        seen = [groot_inputs(request, model.config, tokenizer, statistics, device) for request in requests]
        for alike in of_equal_length(seen):
            for step in run(joined_groot([seen[index] for index in alike]), noise_BNA[alike]):
                yield alike, step

    return sample
