"""GR00T N1.5 on the fast path: packed layers, and per bucket of feature lengths the static buffers over them.

Prompts are padded at the end, and the padding is hidden from every real token: the language model is causal, mixer and
cross-attention get a bias. (The padding at the front that the public model attends to does not occur in serving.)
"""

# B batch, T tokens of text and images, P cognition tokens, F = P + T features with padding, W their width
# N horizon, A padded action dim, U padded state dim, D width of the transformer

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from dual_system.models.graphs import Capture, Work
from dual_system.models.groot.blocks import BLOCK_NORM_EPS, EmbodimentLinear
from dual_system.models.groot.dit import OUT_NORM_EPS
from dual_system.models.groot.pounce import GrootInputs, GrootPounce
from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Residual, Style
from dual_system.models.kernels.trial import Verdict
from dual_system.models.siglip import Float32LayerNorm
from pounce_server.groot_stream import (
    BlockRun,
    BlockStream,
    LanguageRun,
    LanguageStream,
    PackedBlock,
    Read,
    keys_values_of,
)
from pounce_server.operations import Operations
from pounce_server.packed import Matrix
from pounce_server.rehearsal import rehearse_blocks, rehearse_language


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrootPrefix:
    """What an observation comes to before the first layer."""

    embeds: Tensor
    """(B, T, W): text and images, after P if the language model reads it."""
    cognition: Tensor | None
    """(B, P, W), if it joins the features instead."""
    state: Tensor
    """(B, U) float32"""

    @property
    def num_tokens(self) -> int:
        return self.embeds.shape[1] + (0 if self.cognition is None else self.cognition.shape[1])


class GrootNetwork:
    """The part that does not depend on requests: packed weights, tabulated norms, the embodiment's matrices."""

    def __init__(self, model: GrootPounce, operations: Operations) -> None:
        groot, robot = model.groot, model.config.embodiment
        self._model = model
        self.config = model.config
        self.language = LanguageStream(groot.eagle.language, operations)
        self.features_norm = _layer_norm(groot.vl_norm)
        self.mixer_norms = [_layer_norm(norm) for block in groot.mixer for norm in (block.norm1, block.norm3)]
        self.mixer = BlockStream((PackedBlock.of(block, reads_features=False) for block in groot.mixer), operations)
        blocks = list(groot.dit.blocks)
        self.read = keys_values_of(block.attn1 for block in blocks[::2])
        packed = (PackedBlock.of(block, reads_features=index % 2 == 0) for index, block in enumerate(blocks))
        self.dit = BlockStream(packed, operations)
        self.dit_out = Matrix.of(groot.dit.proj_out_2)
        self.future = groot.future_tokens.weight.data
        self.positions_ND = groot.position_embedding.weight.data[: model.config.horizon]
        self.state_in, self.state_out = (
            _affine(part, robot) for part in (groot.state_encoder.layer1, groot.state_encoder.layer2)
        )
        self.velocity_in, self.velocity_out = (
            _affine(part, robot) for part in (groot.action_decoder.layer1, groot.action_decoder.layer2)
        )
        encoder, styles = groot.action_encoder, model.step_table().styles
        # Nothing stands between the encoder's first two layers but the time, so they are one matrix and a bias a step.
        (first, first_bias), (second, second_bias) = (
            (weight.double(), bias.double())
            for weight, bias in (_affine(encoder.W1, robot), _affine(encoder.W2, robot))
        )
        of_action, of_time = second.chunk(2)
        self.action_in = (first @ of_action).float()
        self.step_biases = [
            (first_bias @ of_action + style.action_time[0, 0].double() @ of_time + second_bias).float()
            for style in styles
        ]
        self.action_out = _affine(encoder.W3, robot)
        plain = Style(torch.ones_like(styles[0].norms[0, 0, 0, 0]), eps=BLOCK_NORM_EPS, is_centred=True)
        self.step_norms = [_of_step(style.norms[:, :, 0, 0], plain) for style in styles]

    def see(self, images_BV3PP: Tensor) -> Tensor:
        return self._model.groot.eagle.vision_features(images_BV3PP)

    def embed(self, inputs: GrootInputs, seen: Tensor) -> GrootPrefix:
        embeds = self._model.groot.eagle.input_embeds(seen, inputs.token_ids)
        prefix, cognition = self._model.cognition_prefix, None
        if prefix is not None:
            cognition = prefix(inputs.cognition, inputs.age_ns, inputs.is_null).to(embeds.dtype)
            if self.config.slot == "embeddings":
                embeds, cognition = torch.cat([cognition, embeds], dim=1), None
        return GrootPrefix(embeds=embeds, cognition=cognition, state=inputs.state)

    def num_text_tokens(self, inputs: GrootInputs) -> int:
        """Tokens of the prompt beside one per patch of the images."""
        return inputs.token_ids.shape[1] - inputs.images.shape[1] * self.config.groot.eagle.vision.num_patches

    def bucket(self, prefix: GrootPrefix, length: int) -> "GrootBucket":
        return GrootBucket(self, prefix, length)


def _layer_norm(norm: Float32LayerNorm) -> Style:
    return Style(norm.weight.data.float(), norm.bias.data.float(), norm.eps, is_centred=True)


def _affine(layer: EmbodimentLinear, robot: int) -> tuple[Tensor, Tensor]:
    """Weight (in, out) and bias of an embodiment."""
    return layer.W.data[robot], layer.b.data[robot]


def _of_step(styles_M2D: Tensor, plain: Style) -> list[Style]:
    """Two norms a block, the second without weights, and the last."""
    *styled, (scale, shift) = styles_M2D
    norms = []
    for block_scale, block_shift in styled:
        norms += [Style(block_scale, block_shift, BLOCK_NORM_EPS, is_centred=True), plain]
    return [*norms, Style(scale, shift, OUT_NORM_EPS, is_centred=True)]


class GrootBucket:
    """Static buffers for features of one shape, and the captured work over them."""

    prefill: Work
    steps: Sequence[Work]

    def __init__(self, network: GrootNetwork, prefix: GrootPrefix, length: int) -> None:
        groot, like = network.config.groot, prefix.embeds
        batch_size, width = len(like), like.shape[2]
        self._network = network
        self._num_beside = 0 if prefix.cognition is None else prefix.cognition.shape[1]
        self._language = LanguageRun(groot.eagle.language, batch_size, length - self._num_beside, like)
        self._features_BFW = like.new_zeros(batch_size, length, width)
        self._mixer = BlockRun(groot.mixer, batch_size, length, like)
        self._bias = like.new_zeros(batch_size, 1, 1, length)
        self._state_BU = torch.zeros_like(prefix.state)
        self._keys_values = like.new_empty(batch_size * length, len(network.read.weight))
        heads = self._keys_values.view(batch_size, length, -1, groot.dit.num_heads, groot.dit.head_dim)
        kept = heads.permute(2, 0, 3, 1, 4).unbind()
        cross = [Read((keys, values), self._bias) for keys, values in zip(kept[::2], kept[1::2], strict=True)]
        self._reads = [Read() if index % 2 else cross[index // 2] for index in range(groot.dit.depth)]
        self._num_context = 1 + groot.num_future_tokens
        self._context = like.new_empty(batch_size, self._num_context, groot.dit.width)
        self._context[:, 1:] = network.future
        self._tokens = BlockRun(groot.dit, batch_size, self._num_context + groot.horizon, like)
        self._out = like.new_empty(len(self._tokens.x), groot.hidden_width)
        self.actions = torch.zeros(batch_size * groot.horizon, groot.action_dim, device=like.device)
        self.velocity = torch.zeros_like(self.actions)

    def try_kernels(self, timer: Timer) -> dict[str, list[Verdict]]:
        """Replaces the network's operations by those that are right and faster at this bucket's shapes."""
        network = self._network
        language = rehearse_language(self._language, network.language.layers[0])
        mixer = rehearse_blocks(self._mixer, network.mixer_norms[0])
        step = rehearse_blocks(self._tokens, network.step_norms[0][0])
        actions, velocity = torch.randn_like(self.actions), torch.randn_like(self.actions)
        step.parts["euler"] = (actions, velocity, network.velocity_out[1], -1)
        return {
            "language": network.language.choose(language, timer),
            "mixer": network.mixer.choose(mixer, timer),
            "step": network.dit.choose(step, timer),
        }

    def capture(self, capture: Capture) -> None:
        """Records the prefill and the flow steps; their runs overwrite the buffers."""
        self.prefill = capture(self._prefill)
        self.steps = [capture(self._step(index)) for index in range(self._network.config.num_steps)]

    def load(self, prefix: GrootPrefix, noise_BNA: Tensor) -> None:
        # Padding is loaded too: as the runs leave it, it would grow from one to the next.
        num_padding = self._features_BFW.shape[1] - prefix.num_tokens
        self._language.x.copy_(F.pad(prefix.embeds, (0, 0, 0, num_padding)).flatten(0, 1))
        if prefix.cognition is not None:
            self._features_BFW[:, : self._num_beside] = prefix.cognition
        self._bias.zero_()[..., prefix.num_tokens :] = float("-inf")
        self._state_BU.copy_(prefix.state)
        self.actions.copy_(noise_BNA.flatten(0, 1))

    def _prefill(self) -> None:
        network, mixer, features = self._network, self._mixer, self._features_BFW
        network.language(self._language)
        after_cognition = features[:, self._num_beside :]
        after_cognition.copy_(self._language.normed.view_as(after_cognition))
        network.mixer.do.norm(features.view(mixer.x.shape), mixer.x, network.features_norm, None)
        network.mixer(mixer, network.mixer_norms, [Read(bias=self._bias)] * len(network.mixer.blocks))
        torch.add(mixer.x, mixer.branch, out=mixer.normed)
        network.mixer.do.product(mixer.normed, network.read.weight, self._keys_values, network.read.bias)
        (weight, bias), (out_weight, out_bias) = network.state_in, network.state_out
        hidden = torch.addmm(bias, self._state_BU, weight).relu()
        self._context[:, 0] = torch.addmm(out_bias, hidden, out_weight)

    def _step(self, index: int) -> Work:
        network, run = self._network, self._tokens
        num_context, styles, bias = self._num_context, network.step_norms[index], network.step_biases[index]
        (out_weight, out_bias), do = network.action_out, network.dit.do
        (hidden_weight, hidden_bias), (velocity_weight, velocity_bias) = network.velocity_in, network.velocity_out

        def step() -> None:
            tokens_BTD = run.x.view(run.batch_size, -1, run.x.shape[1])
            tokens_BTD[:, :num_context] = self._context
            embedded = torch.addmm(out_bias, F.silu(torch.addmm(bias, self.actions, network.action_in)), out_weight)
            actions_BND = tokens_BTD[:, num_context:]
            torch.add(embedded.view(actions_BND.shape), network.positions_ND, out=actions_BND)
            network.dit(run, styles, self._reads)
            do.norm(run.x, run.normed, styles[-1], Residual(run.branch))
            do.product(run.normed, network.dit_out.weight, self._out, network.dit_out.bias)
            out_BTH = self._out.view(run.batch_size, -1, self._out.shape[1])
            acted_RH = out_BTH[:, num_context:].reshape(len(self.actions), -1).float()
            hidden = torch.addmm(hidden_bias, acted_RH, hidden_weight).relu()
            torch.mm(hidden, velocity_weight, out=self.velocity)
            do.euler(self.actions, self.velocity, velocity_bias, -network.config.num_steps)

        return step
