"""GR00T N1.5: the vision-language model Eagle, a mixer over its features, and a diffusion transformer for actions.

Features of the observation are mixed once (`prefill`); every evaluation of the velocity, in training as in
sampling, reads them (`velocity`). Neither mixer nor transformer has a mask: padding is attended to like any other
token and changes the actions, here as in the public model. Serve one request at a time.
"""

# B batch, V views, T tokens, P cognition tokens, N horizon, A padded action dim, U padded state dim
# W width of the features, D width of the transformer

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models.embedding import Embedding
from dual_system.models.flow import EulerStep
from dual_system.models.groot import flow as groot_flow
from dual_system.models.groot.blocks import (
    BLOCK_NORM_EPS,
    Affine,
    BlockConfig,
    EmbodimentLinear,
    EmbodimentMlp,
    MixerBlock,
)
from dual_system.models.groot.dit import Dit, action_time_features
from dual_system.models.groot.eagle import Eagle, EagleConfig
from dual_system.models.siglip import Float32LayerNorm
from dual_system.models.stack import Stack


@dataclass(frozen=True, slots=True, kw_only=True)
class GrootConfig:
    """Sizes of the public model, without the cognition prefix."""

    eagle: EagleConfig
    mixer: BlockConfig
    dit: BlockConfig
    hidden_width: int = 1024
    """Hidden width of the embodiments' MLPs, and output width of the transformer, which the action decoder reads."""
    num_embodiments: int = 32
    num_future_tokens: int = 32
    """Learned tokens between state and actions."""
    max_actions: int = 1024
    time_channels: int = 256
    num_time_buckets: int = 1000
    state_dim: int = 64
    """Padded width of the state."""
    action_dim: int = 32
    """Padded width of an action; a robot uses the first few."""
    horizon: int = 16

    def __post_init__(self) -> None:
        if self.mixer.width != self.eagle.language.width:
            raise ValueError(
                f"the mixer's num_heads * head_dim {self.mixer.width} must be the language width "
                f"{self.eagle.language.width}"
            )
        if not 0 < self.horizon <= self.max_actions:
            raise ValueError(f"horizon must be 1..{self.max_actions} (max_actions), came {self.horizon}")
        if self.dit.width % 2 or self.time_channels % 2:
            raise ValueError("the width of the transformer and time_channels must be even: sines and cosines")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrootCache:
    """Tensors that do not depend on the flow step."""

    features_read: tuple[tuple[Tensor, Tensor], ...]
    """Keys and values of the cross-attention, (B, h, P + T, d) per even block."""
    context: Tensor
    """(B, 1 + future, D): [state][future tokens]."""
    action_in: tuple[Affine, Affine, Affine]
    action_out: tuple[Affine, Affine]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimeStyle:
    """Tensors that depend on the time bucket only."""

    norms: Tensor
    """(M, 2, B, 1, D)"""
    action_time: Tensor
    """(B, 1, D)"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrootStepTable:
    """The styles at every step of the Euler sampler: constants of the weights, with a batch of one."""

    num_steps: int
    styles: tuple[TimeStyle, ...]


class ActionEncoder(nn.Module):
    """Embeds noised actions and the flow time, with the weights of their embodiment."""

    def __init__(self, num_embodiments: int, action_dim: int, width: int) -> None:
        super().__init__()
        self.W1 = EmbodimentLinear(num_embodiments, action_dim, width)
        self.W2 = EmbodimentLinear(num_embodiments, 2 * width, width)
        self.W3 = EmbodimentLinear(num_embodiments, width, width)

    def of(self, embodiment_B: Tensor) -> tuple[Affine, Affine, Affine]:
        return self.W1.of(embodiment_B), self.W2.of(embodiment_B), self.W3.of(embodiment_B)


class Groot(nn.Module):
    """The public GR00T N1.5 network, which takes cognition tokens in front of its features or its text."""

    def __init__(self, config: GrootConfig) -> None:
        super().__init__()
        self.config = config
        width, hidden = config.dit.width, config.hidden_width
        self.eagle = Eagle(config.eagle)
        self.vl_norm = Float32LayerNorm(config.mixer.width, BLOCK_NORM_EPS)
        self.mixer = Stack[MixerBlock](MixerBlock(config.mixer) for _ in range(config.mixer.depth))
        self.state_encoder = EmbodimentMlp(config.num_embodiments, config.state_dim, hidden, width)
        self.action_encoder = ActionEncoder(config.num_embodiments, config.action_dim, width)
        self.action_decoder = EmbodimentMlp(config.num_embodiments, hidden, hidden, config.action_dim)
        self.future_tokens = Embedding(config.num_future_tokens, width)
        self.position_embedding = Embedding(config.max_actions, width)
        self.dit = Dit(
            config.dit, source_width=config.mixer.width, width_out=hidden, time_channels=config.time_channels
        )

    def features(
        self,
        images_BV3PP: Tensor,
        token_ids_BT: Tensor,
        is_token_BT: Tensor,
        *,
        cognition_BPW: Tensor | None = None,
    ) -> Tensor:
        """Returns Eagle's features, (B, P + T, W), before the mixer; cognition enters as input embeddings."""
        embeds_BTW = self.eagle.input_embeds(self.eagle.vision_features(images_BV3PP), token_ids_BT)
        return self.eagle.features(embeds_BTW, is_token_BT, cognition_BPW)

    def mixed(self, features_BTW: Tensor) -> Tensor:
        """Returns the features after norm and mixer, as the transformer reads them."""
        mixed_BTW: Tensor = self.vl_norm(features_BTW)
        for block in self.mixer:
            mixed_BTW = block(mixed_BTW)
        return mixed_BTW

    def state_features(self, state_BU: Tensor, embodiment_B: Tensor) -> Tensor:
        """Returns the state token, (B, 1, D) float32."""
        hidden, out = self.state_encoder.of(embodiment_B)
        return out(F.relu(hidden(state_BU[:, None])))

    def prefill(self, features_BTW: Tensor, state_BU: Tensor, embodiment_B: Tensor) -> GrootCache:
        """Mixes Eagle's features (with any cognition in front) and computes all tensors that the steps share."""
        state_B1D = self.state_features(state_BU, embodiment_B)
        future_BFD = self.future_tokens.weight.expand(len(state_BU), -1, -1)
        return GrootCache(
            features_read=self.dit.read(self.mixed(features_BTW).to(self.dit.stream_dtype)),
            context=torch.cat([state_B1D, future_BFD], dim=1),
            action_in=self.action_encoder.of(embodiment_B),
            action_out=self.action_decoder.of(embodiment_B),
        )

    def style(self, bucket_B: Tensor) -> TimeStyle:
        return TimeStyle(
            norms=self.dit.styles(bucket_B), action_time=action_time_features(bucket_B, self.config.dit.width)
        )

    def velocity(self, x_BNA: Tensor, style: TimeStyle, cache: GrootCache) -> Tensor:
        """Returns (B, N, A) float32. The tokens are [state][future][actions]; only the actions have positions."""
        num_actions = x_BNA.shape[1]
        embed, with_time, out = cache.action_in
        action_BND = embed(x_BNA)
        timed = torch.cat([action_BND, style.action_time.expand_as(action_BND)], dim=-1)
        action_BND = out(F.silu(with_time(timed))) + self.position_embedding.weight[:num_actions]
        tokens_BTD = torch.cat([cache.context, action_BND], dim=1).to(self.dit.stream_dtype)
        out_BTH = self.dit(tokens_BTD, style.norms, cache.features_read)
        hidden, last = cache.action_out
        return last(F.relu(hidden(out_BTH[:, -num_actions:].float())))

    def velocity_at(self, x_BNA: Tensor, time_B: Tensor, cache: GrootCache) -> Tensor:
        """`velocity` with one flow time per sample, as in training."""
        bucket_B = groot_flow.time_buckets(time_B, self.config.num_time_buckets)
        return self.velocity(x_BNA, self.style(bucket_B), cache)

    def step_table(self, num_steps: int) -> GrootStepTable:
        device = self.future_tokens.weight.device
        buckets = groot_flow.euler_buckets(num_steps, self.config.num_time_buckets)
        styles = tuple(self.style(torch.full((1,), bucket, device=device)) for bucket in buckets)
        return GrootStepTable(num_steps=num_steps, styles=styles)

    def sample(self, noise_BNA: Tensor, cache: GrootCache, table: GrootStepTable) -> Iterator[EulerStep]:
        """Integrates from noise to actions against one cache; yields after every step."""
        return groot_flow.euler(
            lambda index, x_BNA: self.velocity(x_BNA, table.styles[index], cache), noise_BNA, table.num_steps
        )
