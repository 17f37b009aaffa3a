"""POUNCE's fast path for either family: packed weights, static buffers, fused operations, and a graph per shape.

What stands before the actions is padded to a multiple of 64 tokens that nothing attends to. The vision tower is
captured once a batch size, and a bucket's work once: the prefill, and each flow step with its own styles, so that
heartbeats fit between steps. The first sample, which is the warm-up's, captures all buckets that any prompt may need:
pi0.5's spells the state in digits, so its length changes from one invocation to the next.
"""

# B batch, N horizon, A padded action dim

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from dual_system.models.flow import EulerStep
from dual_system.models.graphs import Capture, Work, cuda_graphs, directly
from dual_system.models.kernels.launch import Timer, cuda_time_ms, missing_for
from dual_system.models.kernels.trial import Verdict, told
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pounce.family import AnyPounce
from pounce_server.fused_groot import GrootNetwork
from pounce_server.fused_pi05 import Pi05Network
from pounce_server.kernels.choice import Choices, ChosenProduct, default_cache, machine_name, preferring
from pounce_server.operations import KERNELS, Operations

log = logging.getLogger(__name__)

BUCKET_TOKENS = 64
"""Prompts of at most 200 tokens need four or five buckets; 63 unseen tokens cost less than half a millisecond."""


class Bucket(Protocol):
    """Static buffers of one shape, and the captured work over them."""

    actions: Tensor
    """(B * N, A) float32"""
    velocity: Tensor
    prefill: Work
    steps: Sequence[Work]

    def try_kernels(self, timer: Timer) -> dict[str, list[Verdict]]:
        """Replaces the network's operations by those that are right and faster at this bucket's shapes."""

    def capture(self, capture: Capture) -> None:
        """Records the prefill and the flow steps; their runs overwrite the buffers."""

    def load(self, prefix: Any, noise_BNA: Tensor) -> None: ...


class FusedPounce:
    """A POUNCE that samples like its model's ``sample``, up to rounding. Takes over the model and repacks its weights.

    It is not thread-safe: all samples of a bucket share its buffers.
    """

    @torch.no_grad()
    def __init__(
        self,
        model: AnyPounce,
        operations: Operations = KERNELS,
        capture: Capture = directly,
        timer: Timer | None = None,
    ) -> None:
        """With a ``timer``, each of ``operations`` is tried before the first capture, and is taken if it is right and
        faster than its twin (``trial``); without one they run untried."""
        self._max_prompt_tokens = model.config.max_prompt_tokens
        self._capture = capture
        self._timer = timer
        self._buckets: dict[tuple[int, int], Bucket] = {}
        self._eyes: dict[int, Eyes] = {}
        self._tried: dict[str, list[Verdict]] = {}
        self._network = Pi05Network(model, operations) if isinstance(model, Pounce) else GrootNetwork(model, operations)

    @property
    def kernels(self) -> str:
        """Which kernels were taken, of prefill and flow step, and why not; "" if none was tried."""
        return told(self._tried)

    def sample(self, inputs: Any, noise_BNA: Tensor) -> Iterator[EulerStep]:
        """Yields the sampler's steps. Their tensors are the bucket's buffers, which the next step overwrites; the last
        actions are a copy.

        ``inputs`` are the model's own; GR00T's without padding, and of its config's embodiment.
        """
        network: Any = self._network
        prefix = network.embed(inputs, self._see(inputs.images))
        key = (len(noise_BNA), bucket_tokens(prefix.num_tokens))
        if key not in self._buckets:  # captured before loading, because capturing overwrites the buffers
            self._capture_all(prefix, len(noise_BNA), prefix.num_tokens - network.num_text_tokens(inputs))
        bucket = self._buckets[key]
        bucket.load(prefix, noise_BNA)
        bucket.prefill()
        for index, step in enumerate(bucket.steps):
            step()
            is_last = index == len(bucket.steps) - 1
            actions = bucket.actions.clone() if is_last else bucket.actions
            yield EulerStep(index, bucket.velocity.view_as(noise_BNA), actions.view_as(noise_BNA))

    def _see(self, images_BV3PP: Tensor) -> Tensor:
        """Embeds the images; the result is overwritten by the next call."""
        batch_size = len(images_BV3PP)
        if batch_size not in self._eyes:
            self._eyes[batch_size] = Eyes(self._network, images_BV3PP, self._capture)
        eyes = self._eyes[batch_size]
        eyes.images.copy_(images_BV3PP)
        eyes.look()
        return eyes.seen

    def _capture_all(self, prefix: Any, batch_size: int, num_beside_text: int) -> None:
        """The buckets of all prompts, the longest first so that the others reuse its memory in the pool."""
        network: Any = self._network
        most = bucket_tokens(num_beside_text + self._max_prompt_tokens)
        for length in range(most, num_beside_text, -BUCKET_TOKENS):
            bucket: Bucket = network.bucket(prefix, length)
            if self._timer is not None and not self._tried:
                self._tried = bucket.try_kernels(self._timer)
                for part, verdicts in self._tried.items():
                    for verdict in verdicts:
                        taken = "kernel" if verdict.is_taken else "twin"
                        log.info("%s %s: %s, %s", part, verdict.operation, taken, verdict.why)
            bucket.capture(self._capture)
            self._buckets[batch_size, length] = bucket


def fused_for(model: AnyPounce, device: torch.device, *, autotune: bool = False) -> FusedPounce:
    """Builds the fast path on ``device``: graphs and tried kernels on a GPU, plain calls in Triton's interpreter.

    ``autotune``: large products use the library that was fastest on this GPU (`kernels.choice`).

    Raises:
        ValueError: Triton, or a device that it supports, is missing; the message says what to do.
    """
    if missing := missing_for(device):
        raise ValueError(f"--path fused cannot run here. {missing}; or --path eager")
    if device.type != "cuda":
        return FusedPounce(model, KERNELS, directly)
    operations = KERNELS
    if autotune:
        chosen = ChosenProduct(Choices(default_cache(), machine_name(device)), cuda_time_ms, preferring)
        operations = replace(KERNELS, product=chosen)
    return FusedPounce(model, operations, cuda_graphs(device), cuda_time_ms)


def bucket_tokens(num_tokens: int) -> int:
    """Tokens before the actions with the padding of their bucket."""
    return -(-num_tokens // BUCKET_TOKENS) * BUCKET_TOKENS


class Eyes:
    """Static buffers for the views of a batch, and the captured vision tower over them."""

    def __init__(self, network: Pi05Network | GrootNetwork, images_BV3PP: Tensor, capture: Capture) -> None:
        self.images = images_BV3PP.clone()
        self.seen = network.see(self.images).clone()

        def look() -> None:
            self.seen.copy_(network.see(self.images))

        self.look: Work = capture(look)
