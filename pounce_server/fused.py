"""POUNCE's fast path for pi0.5: packed weights, static buffers, fused operations, and a graph per shape of the prefix.

The prefix is padded to a multiple of 64 tokens; padding is masked and takes no position, so it changes nothing but
rounding. The vision tower is captured once a batch size, and a bucket's work once: the prefill, and each flow step with
its own styles, so that heartbeats fit between steps. The first sample, which is the warm-up's, captures all buckets
that any prompt may need: the prompt spells the state in digits, so its length changes from one invocation to the next.
"""

# B batch, T prefix tokens with padding, N horizon, A padded action dim, E expert width, S slots of keys

import logging
from collections.abc import Iterator
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.flow import EulerStep
from dual_system.models.graphs import Capture, Work, cuda_graphs, directly
from dual_system.models.kernels.launch import Timer, cuda_time_ms, missing_for
from dual_system.models.kernels.rms_norm import Style
from dual_system.models.kernels.trial import Verdict, told
from dual_system.models.pi05.gemma import RmsNorm
from dual_system.models.pi05.network import Pi05, Prefix
from dual_system.models.pi05.pounce import Pounce, PounceInputs
from pounce_server.fused_stream import KERNELS, FusedStream, Norm, Operations, Run
from pounce_server.kernels.choice import Choices, ChosenProduct, default_cache, machine_name, preferring
from pounce_server.rehearsal import rehearse

log = logging.getLogger(__name__)

BUCKET_TOKENS = 64
"""Prompts of at most 200 tokens need four or five buckets; 63 unseen tokens cost less than half a millisecond."""
SLOT_MULTIPLE = 16
"""Divides the number of keys that an action attends to: torch would pad a bias of another width in every layer."""


class FusedPounce:
    """A pi0.5 POUNCE that samples like `Pounce.sample`, up to rounding. Takes over the model and repacks its weights.

    It is not thread-safe: all samples of a bucket share its buffers.
    """

    @torch.no_grad()
    def __init__(
        self,
        model: Pounce,
        operations: Operations = KERNELS,
        capture: Capture = directly,
        timer: Timer | None = None,
    ) -> None:
        """With a ``timer``, each of ``operations`` is tried before the first capture, and is taken if it is right and
        faster than its twin (``trial``); without one they run untried."""
        pi05 = model.pi05
        self._model = model
        self._capture = capture
        self._timer = timer
        self._buckets: dict[tuple[int, int], Bucket] = {}
        self._eyes: dict[int, Eyes] = {}
        self._tried: dict[str, list[Verdict]] = {}
        self._network = FusedNetwork(pi05, operations, model.config.num_steps)

    @property
    def kernels(self) -> str:
        """Which kernels were taken, of prefill and flow step, and why not; "" if none was tried."""
        return told(self._tried)

    def sample(self, inputs: PounceInputs, noise_BNA: Tensor) -> Iterator[EulerStep]:
        """Yields the sampler's steps. Their tensors are the bucket's buffers, which the next step overwrites."""
        prefix = self._model.embed_prefix(inputs, self._see(inputs.images))
        batch_size, num_tokens = prefix.is_real.shape
        prefix = _padded(prefix, _bucket_tokens(num_tokens))
        key = (batch_size, prefix.is_real.shape[1])
        if key not in self._buckets:  # captured before loading, because capturing overwrites the buffers
            self._capture_all(prefix, num_tokens - inputs.token_ids.shape[1])
        bucket = self._buckets[key]
        bucket.load(prefix, noise_BNA)
        bucket.prefill()
        for index, step in enumerate(bucket.steps):
            step()
            yield EulerStep(index, bucket.velocity.view_as(noise_BNA), bucket.actions.view_as(noise_BNA))

    def _see(self, images_BV3PP: Tensor) -> Tensor:
        """Embeds the images; the result is overwritten by the next call."""
        batch_size = len(images_BV3PP)
        if batch_size not in self._eyes:
            self._eyes[batch_size] = Eyes(self._model.pi05, images_BV3PP, self._capture)
        eyes = self._eyes[batch_size]
        eyes.images.copy_(images_BV3PP)
        eyes.look()
        return eyes.seen

    def _capture_all(self, prefix: Prefix, num_beside_text: int) -> None:
        """The buckets of all prompts, the longest first so that the others reuse its memory in the pool."""
        most = _bucket_tokens(num_beside_text + self._model.config.max_prompt_tokens)
        for length in range(most, num_beside_text, -BUCKET_TOKENS):
            bucket = Bucket(self._network, _padded(prefix, length))
            if self._timer is not None and not self._tried:
                self._tried = bucket.try_kernels(self._timer)
            bucket.capture(self._capture)
            self._buckets[prefix.is_real.shape[0], length] = bucket


def fused_for(model: Pounce, device: torch.device, *, autotune: bool = False) -> FusedPounce:
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


def _bucket_tokens(num_tokens: int) -> int:
    return -(-num_tokens // BUCKET_TOKENS) * BUCKET_TOKENS


def _padded(prefix: Prefix, length: int) -> Prefix:
    """``prefix`` with unseen tokens up to ``length``, or cut to it."""
    count = length - prefix.is_real.shape[1]
    return Prefix(
        embeds=F.pad(prefix.embeds, (0, 0, 0, count)),
        is_real=F.pad(prefix.is_real, (0, count)),
        num_cognition=prefix.num_cognition,
        is_isolated=prefix.is_isolated,
    )


class Eyes:
    """Static buffers for the views of a batch, and the captured vision tower over them."""

    def __init__(self, pi05: Pi05, images_BV3PP: Tensor, capture: Capture) -> None:
        self.images = images_BV3PP.clone()
        self.seen = pi05.embed_images(self.images).clone()

        def look() -> None:
            self.seen.copy_(pi05.embed_images(self.images))

        self.look: Work = capture(look)


class FusedNetwork:
    """The part that does not depend on requests: both streams' packed weights, tabulated norms, projections."""

    def __init__(self, pi05: Pi05, operations: Operations, num_steps: int) -> None:
        self.config = pi05.config
        self.num_steps = num_steps
        self.language = FusedStream(pi05.language.layers, operations)
        self.expert = FusedStream(pi05.expert.layers, operations)
        self.prefix_norms = [
            _plain(norm)
            for layer in pi05.language.layers
            for norm in (layer.input_layernorm, layer.post_attention_layernorm)
        ]
        self.step_norms = [_styled(styles_M3BTE[:, :, 0, 0]) for styles_M3BTE in pi05.step_table(num_steps).styles]
        self.action_in = pi05.action_in_proj
        self.action_out = pi05.action_out_proj


def _plain(norm: RmsNorm) -> Norm:
    return Norm(Style(1.0 + norm.weight.data.float()))


def _styled(styles_M3E: Tensor) -> list[Norm]:
    return [Norm(Style(scale, shift), gate) for scale, shift, gate in styles_M3E]


class Bucket:
    """Static buffers for prefixes of one shape, and the captured work over them."""

    prefill: Work
    steps: list[Work]

    def __init__(self, network: FusedNetwork, prefix: Prefix) -> None:
        config, horizon = network.config, network.config.horizon
        batch_size, num_prefix = prefix.is_real.shape
        embeds = prefix.embeds
        self._network = network
        self._prefix_runs = []
        first = 0
        for stream in prefix.streams():
            seen = slice(first, first + stream.is_real.shape[1])
            self._prefix_runs.append(Run(config.language, batch_size, stream.is_real.shape[1], seen, embeds))
            first = seen.stop
        self._num_gap = -(num_prefix + horizon) % SLOT_MULTIPLE
        num_slots = num_prefix + self._num_gap + horizon
        self._action_run = Run(config.expert, batch_size, horizon, slice(0, num_slots), embeds)
        cache_shape = (batch_size, config.expert.num_kv_heads, num_slots, config.expert.head_dim)
        self._cache = [
            (embeds.new_zeros(cache_shape), embeds.new_zeros(cache_shape)) for _ in range(config.expert.depth)
        ]
        self.actions = torch.zeros(batch_size * horizon, config.action_dim, device=embeds.device)
        self.velocity = torch.zeros_like(self.actions)

    def try_kernels(self, timer: Timer) -> dict[str, list[Verdict]]:
        """Replaces the network's operations by those that are right and faster at this bucket's shapes."""
        network = self._network
        prefix_run = max(self._prefix_runs, key=lambda run: len(run.x))
        prefix = rehearse(prefix_run, network.prefix_norms[1], *self._cache[0], network.language.layers[0].gate_up)
        step = rehearse(self._action_run, network.step_norms[0][1], *self._cache[0], network.expert.layers[0].gate_up)
        actions, velocity = torch.randn_like(self.actions), torch.randn_like(self.actions)
        step.parts["euler"] = (actions, velocity, network.action_out.bias, 1)
        tried = {"prefill": network.language.choose(prefix, timer), "step": network.expert.choose(step, timer)}
        for part, verdicts in tried.items():
            for verdict in verdicts:
                taken = "kernel" if verdict.is_taken else "twin"
                log.info("%s %s: %s, %s", part, verdict.operation, taken, verdict.why)
        return tried

    def capture(self, capture: Capture) -> None:
        """Records the prefill and the flow steps; their runs overwrite the buffers."""
        self.prefill = capture(self._prefill)
        self.steps = [capture(self._step(norms)) for norms in self._network.step_norms]

    def load(self, prefix: Prefix, noise_BNA: Tensor) -> None:
        for stream, run in zip(prefix.streams(), self._prefix_runs, strict=True):
            run.x.copy_(stream.embeds.flatten(0, 1))
            run.place(stream.positions(), stream.is_real)
        next_position_B = prefix.is_real.sum(dim=1) - prefix.num_cognition
        offsets_N = torch.arange(noise_BNA.shape[1], device=noise_BNA.device)
        is_seen_BS = F.pad(prefix.is_real, (0, self._num_gap))
        is_seen_BS = F.pad(is_seen_BS, (0, noise_BNA.shape[1]), value=True)
        self._action_run.place(next_position_B[:, None] + offsets_N, is_seen_BS)
        self.actions.copy_(noise_BNA.flatten(0, 1))

    def _prefill(self) -> None:
        for run in self._prefix_runs:
            self._network.language(run, self._network.prefix_norms, self._cache)

    def _step(self, norms: list[Norm]) -> Work:
        network, run = self._network, self._action_run

        def step() -> None:
            run.x.copy_(network.action_in(self.actions))
            network.expert(run, norms, self._cache)
            torch.mm(run.normed.float(), network.action_out.weight.T, out=self.velocity)
            network.expert.do.euler(self.actions, self.velocity, network.action_out.bias, network.num_steps)

        return step
