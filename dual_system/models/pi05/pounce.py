"""POUNCE, System 1: pi0.5 with the cognition prefix in front of images and text (paper 3.1)."""

# B batch, V views, T text tokens, K carriers, H carrier size, N horizon, A padded action dim, F past frames

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn

from dual_system.models import flow
from dual_system.models.frame_sampling import FrameMemoryConfig
from dual_system.models.interface import CognitionConfig, CognitionPrefix, check_camera_names, check_channel
from dual_system.models.pi05.committed import Committed, first_rows
from dual_system.models.pi05.modulation import NO_FRAME, FrameMemory, pooled
from dual_system.models.pi05.network import Pi05, Pi05Config, Prefix, PrefixCache, StepTable
from dual_system.models.pi05.pointer import Pointer
from dual_system.models.ponder.demo_sampling import FASTEST_HZ
from dual_system.models.windows import Box

Freeze = Literal["none", "vision", "vlm"]
StateInput = Literal["prompt", "token"]
StatelessPrompt = Literal["instruction", "task"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PounceInputs:
    """One batch of network inputs: resized, normalised, tokenised."""

    images: Tensor
    """(B, V, 3, px, px) float32 in [-1, 1]; a missing camera is all -1."""
    has_view: Tensor
    """(B, V) bool"""
    token_ids: Tensor
    """(B, T) int64"""
    is_token: Tensor
    """(B, T) bool; False for padding"""
    age_ns: Tensor
    """(B,) int64 age of the cognition; 0 where null"""
    cognition: Tensor | None = None
    """(B, K, H) float32; None means null cognition everywhere, or K = 0"""
    is_null: Tensor | None = None
    """(B,) bool; samples of ``cognition`` to replace by the learned null"""
    state: Tensor | None = None
    """(B, S) float32, normalised; required if the config's ``state_input`` is "token"."""
    past: Tensor | None = None
    """(B, F, 3, px, px) uint8: front pictures of the past for ``frame_memory``; or (B, F, S, W) as the vision tower
    and its projector embed them; None: none for any sample."""
    past_step: Tensor | None = None
    """(B, F) int64: the step of each (`PastFrame`), or `NO_FRAME` for an empty slot."""
    seen: Tensor | None = None
    """(B, S, W): the images as the vision tower and its projector embed them, if training has stored that; then
    ``images`` is not read."""
    past_features: Tensor | None = None
    """(B, F, C, W) float32: ``past`` as `Pounce.looked_back` embeds it; None: it has not yet."""
    prefilled: PrefixCache | None = None
    """What `Pounce.prefill` returns for all of these; None: it has not been run yet."""

    def forgetting(self, is_null_B: Tensor) -> "PounceInputs":
        """Inputs whose marked samples have no past pictures: the memory's learned null."""
        if self.past_step is None:
            return self
        return replace(self, past_step=self.past_step.masked_fill(is_null_B[:, None], NO_FRAME))


@dataclass(frozen=True, slots=True, kw_only=True)
class PounceConfig:
    """Shapes and options of POUNCE. Named complete configurations are in `pounce.configs`."""

    pi05: Pi05Config
    cognition: CognitionConfig
    robot_action_dim: int = 8
    """The first dims of the padded action: 7 arm joints and the gripper."""
    num_cameras: int = 2
    """front, wrist. 0: it acts on state and cognition alone, whatever cameras the robot has."""
    cameras: tuple[str, ...] = ()
    """Their names in training, in order; () if they are not known."""
    windows: tuple[Box, ...] = ()
    """A window for each camera (`windows`); () for whole pictures, as in the public models."""
    num_steps: int = 10
    """Euler steps per chunk."""
    control_hz: int = 20
    """Rows a second; 0: not known, as of a public folder."""
    max_prompt_tokens: int = 200
    state_input: StateInput = "prompt"
    """prompt: 256 bins written as digits, as pi0.5 does. token: one linearly projected token, as pi0 has in its action
    stream; here it ends the prefix, so that its keys are computed once. It is for networks trained from scratch, which
    would first have to learn to read digits."""
    robot_state_dim: int = 8
    """S, for ``state_input`` "token"; a prompt takes any size."""
    stateless_prompt: StatelessPrompt = "instruction"
    """Prompt for ``state_input`` "token". instruction: the instruction and a newline, as pi0's. task: ``Task: ...;``, a
    newline and ``Action: ``, as the official PonderPounce's."""
    max_committed_rows: int = 0
    """Largest number of committed rows in training (`committed`); 0 if it was not trained with any."""
    reads_subgoal: bool = False
    """Put the newest subgoal's text into the prompt in place of cognition: the paper's subgoal-text reference (3.1)."""
    frame_memory: FrameMemoryConfig | None = None
    """A memory of POUNCE's own past front pictures that modulates the expert (FrameSamp+Modul); None: there is none."""
    num_pointed: int = 0
    """Places of the front picture that a pointer conditions the expert on (`pointer`), and where a second camera sees
    them; 0: pi0.5, which has none."""

    def __post_init__(self) -> None:
        check_channel(self.cognition, self.reads_subgoal)
        check_camera_names(self.cameras, self.num_cameras)
        if self.frame_memory is not None:
            self.frame_memory.grid_side(self.pi05.vision.num_patches)
            if self.control_hz != FASTEST_HZ or not self.num_cameras:
                raise ValueError(
                    f"frame_memory needs a front camera and control_hz {FASTEST_HZ}, that of demonstrations; came "
                    f"{self.num_cameras} cameras and {self.control_hz}"
                )
        has_state_last = self.state_input == "token" and self.cognition.place != "after_text"
        if self.num_pointed and not (self.num_cameras and has_state_last):
            raise ValueError(
                "num_pointed needs a front camera, state_input 'token' and the cognition before the pictures; came "
                f"{self.num_cameras} cameras, {self.state_input!r} and {self.cognition.place!r}"
            )
        if not 0 <= self.max_committed_rows < self.pi05.horizon:
            raise ValueError(f"max_committed_rows must be 0..{self.pi05.horizon - 1}, came {self.max_committed_rows}")
        if not 0 < self.robot_action_dim <= self.pi05.action_dim:
            raise ValueError(f"robot_action_dim must be 1..{self.pi05.action_dim}, came {self.robot_action_dim}")
        for name, least in (("num_cameras", 0), ("num_pointed", 0), ("num_steps", 1), ("max_prompt_tokens", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, came {getattr(self, name)}")

    @property
    def horizon(self) -> int:
        return self.pi05.horizon

    @property
    def padded_action_dim(self) -> int:
        return self.pi05.action_dim

    @property
    def image_px(self) -> int:
        return self.pi05.vision.image_px

    @property
    def vocab_size(self) -> int:
        return self.pi05.vocab_size

    def example_inputs(self, batch_size: int, *, num_tokens: int = 12, seed: int = 0) -> PounceInputs:
        """Makes a valid batch for tests and benchmarks: all views present, cognition 300 ms old."""
        generator = torch.Generator().manual_seed(seed)
        px = self.pi05.vision.image_px
        cognition, has_token = self.cognition, self.state_input == "token"
        image_shape = (batch_size, self.num_cameras, 3, px, px)
        token_shape = (batch_size, num_tokens)
        cognition_BKH = torch.randn((batch_size, cognition.num_carriers, cognition.cognition_size), generator=generator)
        inputs = PounceInputs(
            images=torch.rand(image_shape, generator=generator) * 2 - 1,
            has_view=torch.ones(batch_size, self.num_cameras, dtype=torch.bool),
            token_ids=torch.randint(self.pi05.vocab_size, token_shape, generator=generator),
            is_token=torch.ones(token_shape, dtype=torch.bool),
            age_ns=torch.full((batch_size,), 300_000_000),
            cognition=cognition_BKH if cognition.num_carriers else None,
            state=torch.rand(batch_size, self.robot_state_dim, generator=generator) * 2 - 1 if has_token else None,
        )
        if self.frame_memory is None:
            return inputs
        sampling = self.frame_memory.sampling
        past = torch.randint(256, (batch_size, sampling.num_frames, 3, px, px), generator=generator, dtype=torch.uint8)
        steps_F = torch.arange(sampling.num_frames) * sampling.stride_ticks
        return replace(inputs, past=past, past_step=steps_F.repeat(batch_size, 1))

    def example_actions(self, batch_size: int, *, seed: int = 0) -> Tensor:
        """Makes normalised training targets, (B, N, A) float32, zero beyond the robot's dims."""
        generator = torch.Generator().manual_seed(seed)
        actions = torch.zeros(batch_size, self.pi05.horizon, self.pi05.action_dim)
        actions[..., : self.robot_action_dim].uniform_(-1, 1, generator=generator)
        return actions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Backbone:
    """The pretrained parts that a recipe may freeze."""

    vision: tuple[nn.Module, ...]
    """Image tower and its projector."""
    language: nn.Module


class Freezable(Protocol):
    """The part of either family's POUNCE that `freeze` uses."""

    @property
    def backbone(self) -> Backbone: ...

    def requires_grad_(self, requires_grad: bool = True) -> Any: ...


class Pounce(nn.Module):
    """pi0.5 plus, for K >= 1, the cognition prefix."""

    def __init__(self, config: PounceConfig) -> None:
        super().__init__()
        self.config = config
        self.pi05 = Pi05(config.pi05)
        has_prefix = config.cognition.num_carriers > 0
        width = config.pi05.language.width
        self.cognition_prefix = CognitionPrefix(config.cognition, width) if has_prefix else None
        has_token = config.state_input == "token"
        self.state_projector = nn.Linear(config.robot_state_dim, width) if has_token else None
        self.frame_memory = None
        if config.frame_memory is not None:
            num_patches, expert = config.pi05.vision.num_patches, config.pi05.expert
            self.frame_memory = FrameMemory(
                config.frame_memory, num_patches=num_patches, feature_width=width, expert=expert
            )
        self.pointer = None
        if config.num_pointed:
            num_patches, expert_width = config.pi05.vision.num_patches, config.pi05.expert.width
            self.pointer = Pointer(
                config.num_pointed,
                num_patches=num_patches,
                width=width,
                expert_width=expert_width,
                has_second_camera=config.num_cameras > 1,
            )

    @property
    def backbone(self) -> Backbone:
        return Backbone(vision=(self.pi05.vision, self.pi05.projector), language=self.pi05.language)

    def embed_prefix(self, inputs: PounceInputs, seen_BSW: Tensor | None = None) -> Prefix:
        """Embeds [P][images][text][state], or P last (`CognitionConfig.place`).

        ``seen_BSW``: the images as the vision tower and its projector embed them, if they have.

        Raises:
            ValueError: ``state_input`` is "token" and the state is missing.
        """
        cognition_BPW = None
        if self.cognition_prefix is not None:
            cognition_BPW = self.cognition_prefix(inputs.cognition, inputs.age_ns, inputs.is_null)
        state_B1W = None
        if self.state_projector is not None:
            if inputs.state is None:
                raise ValueError("state_input is 'token' and the inputs hold no state")
            state_B1W = self.state_projector(inputs.state)[:, None]
        return self.pi05.embed_prefix(
            inputs.images,
            inputs.has_view,
            inputs.token_ids,
            inputs.is_token,
            cognition_BPW=cognition_BPW,
            state_B1W=state_B1W,
            is_isolated=self.config.cognition.attention == "isolated",
            is_cognition_last=self.config.cognition.place == "after_text",
            seen_BSW=inputs.seen if seen_BSW is None else seen_BSW,
        )

    def prefill(self, inputs: PounceInputs, taught_BP: Tensor | None = None) -> PrefixCache:
        """Embeds [P][images][text][state] and runs it through the language layers once; encodes the frame memory.

        ``taught_BP``: what a pointer reads in training (`Pointer.forward`).
        """
        if inputs.prefilled is not None:
            return inputs.prefilled
        cache = self.pi05.prefill(self.embed_prefix(inputs), self.pointer, taught_BP)
        if self.frame_memory is None:
            return cache
        return replace(cache, memory=self.frame_memory(*self._past_features(inputs, self.frame_memory.config)))

    def looked_back(self, inputs: PounceInputs) -> tuple[PounceInputs, Tensor, Tensor]:
        """The inputs with their past pictures' features, the frame memory's tokens (B, S, E), and which are visible."""
        if self.frame_memory is None:
            raise ValueError("frame_memory is None: expected a POUNCE with a memory of past pictures")
        features_BFCW, step_BF = self._past_features(inputs, self.frame_memory.config)
        seen = replace(inputs, past_features=features_BFCW, past_step=step_BF)
        return seen, *self.frame_memory.tokens(features_BFCW, step_BF)

    def pointing(self, inputs: PounceInputs, taught_BP: Tensor | None = None) -> tuple[PounceInputs, Tensor]:
        """The inputs with their prefix filled in, and the pointer's scores (B, P, S + 1), see `Pointed`."""
        cache = self.prefill(inputs, taught_BP)
        if cache.pointed is None:
            raise ValueError("num_pointed is 0: expected a POUNCE with a pointer")
        return replace(inputs, prefilled=cache), cache.pointed.scores

    def _past_features(self, inputs: PounceInputs, memory: FrameMemoryConfig) -> tuple[Tensor, Tensor]:
        """The past pictures' features (B, F, C, W) and steps (B, F). No gradient reaches the vision tower here."""
        if inputs.past_features is not None and inputs.past_step is not None:
            return inputs.past_features, inputs.past_step
        device, width = inputs.age_ns.device, self.config.pi05.language.width
        shape = (len(inputs.age_ns), memory.sampling.num_frames)
        features_BFCW = torch.zeros(*shape, memory.tokens_per_frame, width, device=device)
        if inputs.past is None or inputs.past_step is None:
            return features_BFCW, torch.full(shape, NO_FRAME, device=device)
        is_frame_BF = inputs.past_step != NO_FRAME
        if is_frame_BF.any():
            with torch.no_grad():
                past_M = inputs.past[is_frame_BF]
                if not past_M.is_floating_point():
                    past_M = self.pi05.embed_images(past_M[:, None].float() / 127.5 - 1.0)
                features_BFCW[is_frame_BF] = pooled(past_M, memory.pooled_side)
        return features_BFCW, inputs.past_step

    def loss(
        self,
        inputs: PounceInputs,
        actions_BNA: Tensor,
        noise_BNA: Tensor,
        time_B: Tensor,
        *,
        over: flow.LossDims = "real",
        num_committed_B: Tensor | None = None,
    ) -> Tensor:
        """Returns the scalar L_fm, by default over the robot's action dims only (`flow.mean_loss`).

        ``actions_BNA`` are normalised and zero beyond the robot's dims; noise fills all of A, as in sampling. The
        first ``num_committed_B`` rows of each sample are committed and do not contribute (`committed`).
        """
        unreduced_BNA = self.unreduced_loss(inputs, actions_BNA, noise_BNA, time_B, num_committed_B=num_committed_B)
        if num_committed_B is not None:
            unreduced_BNA = unreduced_BNA[~first_rows(num_committed_B, self.config.horizon)]
        return flow.mean_loss(unreduced_BNA, self.config.robot_action_dim, over)

    def unreduced_loss(
        self,
        inputs: PounceInputs,
        actions_BNA: Tensor,
        noise_BNA: Tensor,
        time_B: Tensor,
        *,
        num_committed_B: Tensor | None = None,
    ) -> Tensor:
        """Returns the squared error of the velocity, (S, N, A); it is meaningless on committed rows.

        Noise, times and counts may hold D flow samples per observation, the whole batch repeated D times (S = D * B):
        the prefix is then computed once for all of them.
        """
        num_draws = len(noise_BNA) // len(actions_BNA)
        actions_BNA = actions_BNA.repeat(num_draws, 1, 1)
        x_BNA = flow.noised(actions_BNA, noise_BNA, time_B)
        is_given_BN = None
        if num_committed_B is not None:
            is_given_BN = first_rows(num_committed_B, self.config.horizon)
            x_BNA = Committed(rows=actions_BNA, is_given=is_given_BN).over(x_BNA)
        cache = self.prefill(inputs).repeated(num_draws)
        velocity_BNA = self.pi05.velocity_at(x_BNA, time_B, cache, is_given_BN=is_given_BN)
        return (flow.target_velocity(actions_BNA, noise_BNA) - velocity_BNA).square()

    def step_table(self) -> StepTable:
        return self.pi05.step_table(self.config.num_steps)

    def sample(
        self, inputs: PounceInputs, noise_BNA: Tensor, table: StepTable, *, given: Committed | None = None
    ) -> Iterator[flow.EulerStep]:
        """Yields the sampler's steps; the actions of the last are the normalised chunk."""
        return self.pi05.sample(noise_BNA, self.prefill(inputs), table, given=given)


def freeze(model: Freezable, what: Freeze = "vlm") -> None:
    """Sets ``requires_grad`` of every parameter. Gradients still pass *through* frozen layers to C.

    - ``vlm`` freezes vision, projector and language (the paper, B.1: "including the PaliGemma backbone"; GR00T's own
      recipe freezes its language too).
    - ``vision`` freezes vision and projector (RoboMME's released pi0.5 recipe; the paper's wording differs).
    - ``none`` freezes nothing.

    Never run the prefix under ``no_grad`` or ``detach`` it to save memory: PONDER's gradient passes through it.
    """
    backbone = model.backbone
    frozen: dict[Freeze, tuple[nn.Module, ...]] = {
        "none": (),
        "vision": backbone.vision,
        "vlm": (*backbone.vision, backbone.language),
    }
    if what not in frozen:
        raise ValueError(f"freeze must be one of {', '.join(frozen)}, came {what!r}")
    model.requires_grad_(True)
    for part in frozen[what]:
        part.requires_grad_(False)
