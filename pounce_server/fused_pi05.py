"""pi0.5 on the fast path: packed streams, and per bucket of prefix lengths the static buffers.

Padding is masked and takes no position, so it changes nothing but rounding.
"""

# B batch, T prefix tokens with padding, N horizon, A padded action dim, E expert width, S slots of keys

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.graphs import Capture, Work
from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Style
from dual_system.models.kernels.trial import Verdict
from dual_system.models.pi05.gemma import RmsNorm
from dual_system.models.pi05.network import Prefix
from dual_system.models.pi05.pounce import Pounce, PounceInputs
from pounce_server.fused_stream import FusedStream, Norm, Run
from pounce_server.operations import Operations
from pounce_server.rehearsal import rehearse

SLOT_MULTIPLE = 16
"""Divides the number of keys that an action attends to: torch would pad a bias of another width in every layer."""


class Pi05Network:
    """The part that does not depend on requests: both streams' packed weights, tabulated norms, projections."""

    def __init__(self, model: Pounce, operations: Operations) -> None:
        pi05 = model.pi05
        self._model = model
        self.config = pi05.config
        self.num_steps = model.config.num_steps
        self.language = FusedStream(pi05.language.layers, operations)
        self.expert = FusedStream(pi05.expert.layers, operations)
        self.prefix_norms = [
            _plain(norm)
            for layer in pi05.language.layers
            for norm in (layer.input_layernorm, layer.post_attention_layernorm)
        ]
        self.step_norms = [_styled(styles_M3BTE[:, :, 0, 0]) for styles_M3BTE in pi05.step_table(self.num_steps).styles]
        self.action_in = pi05.action_in_proj
        self.action_out = pi05.action_out_proj

    def see(self, images_BV3PP: Tensor) -> Tensor:
        return self._model.pi05.embed_images(images_BV3PP)

    def embed(self, inputs: PounceInputs, seen: Tensor) -> Prefix:
        return self._model.embed_prefix(inputs, seen)

    def num_text_tokens(self, inputs: PounceInputs) -> int:
        return inputs.token_ids.shape[1]

    def bucket(self, prefix: Prefix, length: int) -> "Pi05Bucket":
        return Pi05Bucket(self, padded(prefix, length))


def padded(prefix: Prefix, length: int) -> Prefix:
    """``prefix`` with unseen tokens up to ``length``, or cut to it."""
    count = length - prefix.num_tokens
    return Prefix(
        embeds=F.pad(prefix.embeds, (0, 0, 0, count)),
        is_real=F.pad(prefix.is_real, (0, count)),
        num_cognition=prefix.num_cognition,
        is_isolated=prefix.is_isolated,
    )


def _plain(norm: RmsNorm) -> Norm:
    return Norm(Style(1.0 + norm.weight.data.float()))


def _styled(styles_M3E: Tensor) -> list[Norm]:
    return [Norm(Style(scale, shift), gate) for scale, shift, gate in styles_M3E]


class Pi05Bucket:
    """Static buffers for prefixes of one shape, and the captured work over them."""

    prefill: Work
    steps: Sequence[Work]

    def __init__(self, network: Pi05Network, prefix: Prefix) -> None:
        config, horizon = network.config, network.config.horizon
        batch_size, num_prefix = prefix.is_real.shape
        embeds = prefix.embeds
        self._network = network
        self._num_prefix = num_prefix
        self._prefix_runs = []
        first = 0
        for stream in prefix.streams():
            seen = slice(first, first + stream.num_tokens)
            self._prefix_runs.append(Run(config.language, batch_size, stream.num_tokens, seen, embeds))
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
        return {"prefill": network.language.choose(prefix, timer), "step": network.expert.choose(step, timer)}

    def capture(self, capture: Capture) -> None:
        """Records the prefill and the flow steps; their runs overwrite the buffers."""
        self.prefill = capture(self._prefill)
        self.steps = [capture(self._step(norms)) for norms in self._network.step_norms]

    def load(self, prefix: Prefix, noise_BNA: Tensor) -> None:
        prefix = padded(prefix, self._num_prefix)
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
