"""pi0.5: PaliGemma, and an action expert that attends to its keys and values.

The token stream is [cognition P][view 0]...[view V-1][text], then the action tokens. Everything before the actions
is the "prefix" here, as in the pi0 literature; the paper's prefix P is "cognition". The prefix never attends to the
actions, so its keys and values are computed once (`prefill`), and every evaluation of the velocity, in training as
in sampling, reads them (`velocity`).
"""

# B batch, V views, P cognition tokens, T prefix tokens, N horizon, A action dim
# W language width, E expert width, h/g query/key heads, D head dim, M norms of the expert

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.models import flow
from dual_system.models.pi05 import committed as committed
from dual_system.models.pi05.committed import Committed, pinned, row_styles
from dual_system.models.pi05.gemma import ActionExpert, GemmaConfig, LanguageModel, Rotation, attend
from dual_system.models.pi05.modulation import MemoryCache
from dual_system.models.pi05.pointer import Pointed, Pointer
from dual_system.models.siglip import VisionConfig, VisionTower
from dual_system.models.sinusoid import sinusoid

TIME_MIN_PERIOD = 4e-3
TIME_MAX_PERIOD = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Pi05Config:
    """Sizes of the public model, without the cognition prefix."""

    vision: VisionConfig
    language: GemmaConfig
    expert: GemmaConfig
    vocab_size: int = 257_152
    action_dim: int = 32
    """Padded width of an action; a robot uses the first few."""
    horizon: int = 50

    def __post_init__(self) -> None:
        for name in ("depth", "num_heads", "num_kv_heads", "head_dim"):
            language, expert = getattr(self.language, name), getattr(self.expert, name)
            if language != expert:
                raise ValueError(f"both streams attend jointly: language.{name} {language} != expert.{name} {expert}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prefix:
    """The embedded prefix stream before the first layer."""

    embeds: Tensor
    """(B, T, W)"""
    is_real: Tensor
    """(B, T) bool; False for padding and missing cameras: such tokens are masked and take no position."""
    num_cognition: int = 0
    """The first tokens are P; the rest are images and text."""
    is_isolated: bool = False
    """P and (images, text) do not attend to each other; the actions attend to both."""

    @property
    def num_tokens(self) -> int:
        return self.is_real.shape[1]

    def positions(self) -> Tensor:
        """Returns (B, T) int64, counting real tokens only. P gets negative positions, so it does not shift the rest."""
        return self.is_real.long().cumsum(dim=1) - 1 - self.num_cognition

    def streams(self) -> tuple["Prefix", ...]:
        """Returns the parts that attend only to themselves, in order: the whole, or P and the rest.

        Isolated parts run separately rather than masked: images and text then go through exactly the same
        products as without P, bit for bit.
        """
        count = self.num_cognition
        if not (self.is_isolated and count):
            return (self,)
        cognition = Prefix(embeds=self.embeds[:, :count], is_real=self.is_real[:, :count], num_cognition=count)
        return cognition, Prefix(embeds=self.embeds[:, count:], is_real=self.is_real[:, count:])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PrefixCache:
    """Keys and values of the prefix, for the action stream."""

    keys: tuple[Tensor, ...]
    """Rotated, one (B, g, T, D) per layer."""
    values: tuple[Tensor, ...]
    visible: Tensor
    """(B, T) bool: prefix tokens that the actions may attend to."""
    next_position: Tensor
    """(B,) int64: position of the first action token."""
    memory: MemoryCache | None = None
    """What modulates the action stream's FFNs; None: nothing does."""
    pointed: Pointed | None = None
    """What conditions the expert beside the flow time; None: nothing does."""

    def repeated(self, times: int) -> "PrefixCache":
        """The batch repeated ``times``: several action streams against one prefix."""
        if times == 1:
            return self
        return PrefixCache(
            keys=tuple(key.repeat(times, 1, 1, 1) for key in self.keys),
            values=tuple(value.repeat(times, 1, 1, 1) for value in self.values),
            visible=self.visible.repeat(times, 1),
            next_position=self.next_position.repeat(times),
            memory=None if self.memory is None else self.memory.repeated(times),
            pointed=None if self.pointed is None else self.pointed.repeated(times),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepTable:
    """The adaRMS styles at every time of the Euler sampler: constants of the weights, computed once.

    At full size this saves 37 dense layers in each of the 10 steps.
    """

    num_steps: int
    styles: tuple[Tensor, ...]
    """One (M, 3, 1, 1, E) per step; broadcasts over the batch."""
    done: Tensor
    """(M, 3, 1, 1, E): styles of committed rows, which are data already (`committed`)."""


class Pi05(nn.Module):
    """The public pi0.5 network, which takes cognition tokens at the front of its prefix."""

    def __init__(self, config: Pi05Config) -> None:
        super().__init__()
        self.config = config
        expert_width = config.expert.width
        self.vision = VisionTower(config.vision)
        self.projector = nn.Linear(config.vision.width, config.language.width)
        self.language = LanguageModel(config.language, config.vocab_size)
        self.expert = ActionExpert(config.expert)
        self.action_in_proj = nn.Linear(config.action_dim, expert_width)
        self.action_out_proj = nn.Linear(expert_width, config.action_dim)
        self.time_mlp_in = nn.Linear(expert_width, expert_width)
        self.time_mlp_out = nn.Linear(expert_width, expert_width)

    @property
    def stream_dtype(self) -> torch.dtype:
        return self.language.embed_tokens.weight.dtype

    def embed_images(self, images_BV3PP: Tensor) -> Tensor:
        """(B, V, 3, px, px) -> (B, V * patches, W). Not divided by sqrt(W), unlike stock PaliGemma."""
        batch_size, num_views = images_BV3PP.shape[:2]
        if num_views == 0:
            return images_BV3PP.new_zeros(batch_size, 0, self.config.language.width)
        features: Tensor = self.projector(self.vision(images_BV3PP.flatten(0, 1), self.stream_dtype))
        return features.reshape(batch_size, num_views * features.shape[1], -1)

    def embed_prefix(
        self,
        images_BV3PP: Tensor,
        has_view_BV: Tensor,
        token_ids_BT: Tensor,
        is_token_BT: Tensor,
        *,
        cognition_BPW: Tensor | None = None,
        state_B1W: Tensor | None = None,
        is_isolated: bool = False,
        is_cognition_last: bool = False,
        seen_BSW: Tensor | None = None,
    ) -> Prefix:
        """Assembles [P][views][text][state], or [views][text][state][P] if ``is_cognition_last``.

        ``seen_BSW``: :meth:`embed_images` of the images, if they have been embedded.

        A missing camera keeps its slots but is masked and takes no positions.

        ``cognition_BPW`` and ``state_B1W`` are not multiplied by sqrt(W): like image tokens and unlike text.
        """
        image_embeds = self.embed_images(images_BV3PP) if seen_BSW is None else seen_BSW  # no tokens without a view
        is_image = has_view_BV.repeat_interleave(self.config.vision.num_patches, dim=1)
        parts = [image_embeds, self.language.embed(token_ids_BT)]
        is_real = [is_image, is_token_BT]
        num_cognition = 0
        if state_B1W is not None:
            parts.append(state_B1W)
            is_real.append(is_token_BT.new_ones(state_B1W.shape[:2]))
        if cognition_BPW is not None:
            at = len(parts) if is_cognition_last else 0
            num_cognition = 0 if is_cognition_last else cognition_BPW.shape[1]  # at the end: positions like any other's
            parts.insert(at, cognition_BPW)
            is_real.insert(at, is_token_BT.new_ones(cognition_BPW.shape[:2]))
        return Prefix(
            embeds=torch.cat([part.to(self.stream_dtype) for part in parts], dim=1),
            is_real=torch.cat(is_real, dim=1),
            num_cognition=num_cognition,
            is_isolated=is_isolated,
        )

    def prefill(self, prefix: Prefix, pointer: Pointer | None = None, taught_BP: Tensor | None = None) -> PrefixCache:
        """Runs the prefix through the language layers and keeps every layer's keys and values.

        The last layer computes only keys and values, because nothing uses its output. A ``pointer`` reads its input,
        and is told ``taught_BP`` in training (`Pointer.forward`).
        """
        runs = [self._run_prefix(stream, last_layer_output=False) for stream in prefix.streams()]
        keys, values = (
            tuple(torch.cat(parts, dim=2) if len(parts) > 1 else parts[0] for parts in zip(*layers, strict=True))
            for layers in ([run[0] for run in runs], [run[1] for run in runs])
        )
        next_position_B = prefix.is_real.sum(dim=1) - prefix.num_cognition
        pointed = None
        if pointer is not None:
            hidden_BTW = torch.cat([run[2] for run in runs], dim=1)
            pointed = pointer(prefix.embeds, hidden_BTW, prefix.is_real, prefix.num_cognition, self.expert, taught_BP)
        return PrefixCache(
            keys=keys, values=values, visible=prefix.is_real, next_position=next_position_B, pointed=pointed
        )

    def prefix_hidden(self, prefix: Prefix) -> Tensor:
        """Returns (B, T, W) after the last norm: for parity tests and probes, not for acting."""
        runs = [self._run_prefix(stream, last_layer_output=True) for stream in prefix.streams()]
        hidden_BTW = torch.cat([hidden for _, _, hidden in runs], dim=1)
        normed_BTW: Tensor = self.language.norm(hidden_BTW)
        return normed_BTW

    def _run_prefix(
        self, prefix: Prefix, *, last_layer_output: bool
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...], Tensor]:
        rotation = Rotation.at(prefix.positions(), self.config.language.head_dim)
        # Padding rows attend to the real keys too: their outputs are unused, and a fully masked row would be NaN.
        visible_B11T = prefix.is_real[:, None, None, :]
        hidden_BTW = prefix.embeds
        keys: list[Tensor] = []
        values: list[Tensor] = []
        for layer in self.language.layers:
            q_BhTD, k_BgTD, v_BgTD = layer.self_attn.qkv(layer.input_layernorm(hidden_BTW), rotation)
            keys.append(k_BgTD)
            values.append(v_BgTD)
            if len(keys) == self.config.language.depth and not last_layer_output:
                break
            hidden_BTW = hidden_BTW + layer.self_attn.o_proj(attend(q_BhTD, k_BgTD, v_BgTD, visible_B11T))
            hidden_BTW = hidden_BTW + layer.mlp(layer.post_attention_layernorm(hidden_BTW))
        return tuple(keys), tuple(values), hidden_BTW

    def time_condition(self, time_B: Tensor) -> Tensor:
        """Returns (B, E): the vector on which every adaRMS norm of the expert is conditioned."""
        features_BE = sinusoid(time_B, self.config.expert.width, min_period=TIME_MIN_PERIOD, max_period=TIME_MAX_PERIOD)
        return F.silu(self.time_mlp_out(F.silu(self.time_mlp_in(features_BE))))

    def step_table(self, num_steps: int) -> StepTable:
        """Tabulates the styles at the times of the Euler sampler; stale once a weight changes."""
        device = self.time_mlp_in.weight.device
        times = torch.tensor(flow.euler_times(num_steps), dtype=torch.float32, device=device)
        styles_M3S1E = self.expert.styles(self.time_condition(times))
        return StepTable(num_steps=num_steps, styles=torch.split(styles_M3S1E, 1, dim=2), done=self._done_styles())

    def _done_styles(self) -> Tensor:
        device = self.time_mlp_in.weight.device
        return self.expert.styles(self.time_condition(torch.full((1,), committed.DONE, device=device)))

    def velocity(self, x_BNA: Tensor, styles_M3B1E: Tensor, cache: PrefixCache) -> Tensor:
        """Returns v(x_t, t | prefix), (B, N, A) float32; ``styles_M3B1E`` carries t, or (M, 3, B, N, E) one per row.

        Action tokens attend to every visible prefix token and to each other. pi0.5 has no state token.
        """
        num_actions = x_BNA.shape[1]
        offsets_N = torch.arange(num_actions, device=x_BNA.device)
        rotation = Rotation.at(cache.next_position[:, None] + offsets_N, self.config.expert.head_dim)
        is_action_BN = cache.visible.new_ones(x_BNA.shape[:2])
        visible = torch.cat([cache.visible, is_action_BN], dim=1)[:, None, None, :]
        x_BNE = self.action_in_proj(x_BNA).to(self.stream_dtype)
        styles = iter(styles_M3B1E if cache.pointed is None else styles_M3B1E + cache.pointed.styles)
        stack = zip(self.expert.layers, cache.keys, cache.values, strict=True)
        for index, (layer, prefix_key, prefix_value) in enumerate(stack):
            normed_BNE, gate = layer.input_layernorm(x_BNE, next(styles))
            q_BhND, k_BgND, v_BgND = layer.self_attn.qkv(normed_BNE, rotation)
            keys = torch.cat([prefix_key, k_BgND], dim=2)
            values = torch.cat([prefix_value, v_BgND], dim=2)
            x_BNE = x_BNE + gate * layer.self_attn.o_proj(attend(q_BhND, keys, values, visible))
            branch_BNE = x_BNE if cache.memory is None else cache.memory.modulated(index, x_BNE)
            normed_BNE, gate = layer.post_attention_layernorm(branch_BNE, next(styles))
            x_BNE = x_BNE + gate * layer.mlp(normed_BNE)
        final_BNE, _ = self.expert.norm(x_BNE, next(styles))  # the last norm has no residual to gate
        velocity_BNA: Tensor = self.action_out_proj(final_BNE.float())
        return velocity_BNA

    def velocity_at(
        self, x_BNA: Tensor, time_B: Tensor, cache: PrefixCache, *, is_given_BN: Tensor | None = None
    ) -> Tensor:
        """`velocity` with one flow time per sample, as in training. ``is_given_BN`` marks committed rows."""
        styles = self.expert.styles(self.time_condition(time_B))
        if is_given_BN is not None:
            styles = row_styles(styles, self._done_styles(), is_given_BN)
        return self.velocity(x_BNA, styles, cache)

    def sample(
        self, noise_BNA: Tensor, cache: PrefixCache, table: StepTable, *, given: Committed | None = None
    ) -> Iterator[flow.EulerStep]:
        """Integrates from noise to actions against one prefilled prefix; yields after every step.

        Rows that are ``given`` appear unchanged, bit for bit, in the actions of every step.
        """
        if given is None:
            return flow.euler(
                lambda index, x_BNA: self.velocity(x_BNA, table.styles[index], cache), noise_BNA, table.num_steps
            )
        styles = [row_styles(styles, table.done, given.is_given) for styles in table.styles]
        flowing = pinned(lambda index, x_BNA: self.velocity(x_BNA, styles[index], cache), given)
        return flow.euler(flowing, given.over(noise_BNA), table.num_steps)
