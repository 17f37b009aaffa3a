"""POUNCE with GR00T N1.5 in place of pi0.5: the cognition prefix in front of Eagle's features, or of its text.

There are two slots; the paper specifies neither (for GR00T it gives only W_c's std, 1e-3):

- ``features`` (default): P joins the features before the mixer, whose four layers are trainable; the frozen language
  model is unchanged. The norm in front of the mixer makes the scale of P irrelevant.
- ``embeddings``: P precedes the text and images of the causal language model, so all of them attend to it.
"""

# B batch, V views, T text tokens, K carriers, H carrier size, N horizon, A padded action dim, U padded state dim

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from dual_system.models.flow import EulerStep
from dual_system.models.groot import flow as groot_flow
from dual_system.models.groot.network import Groot, GrootCache, GrootConfig, GrootStepTable
from dual_system.models.interface import CognitionConfig, CognitionPrefix, check_camera_names, check_channel
from dual_system.models.pi05.pounce import Backbone

PrefixSlot = Literal["features", "embeddings"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GrootInputs:
    """One batch of network inputs: resized, normalised, tokenised. The public model has no view mask."""

    images: Tensor
    """(B, V, 3, px, px) float32 in [-1, 1]"""
    token_ids: Tensor
    """(B, T) int64, an image token for every patch among them; padded on the left"""
    is_token: Tensor
    """(B, T) bool; False for padding, which still affects the actions (`groot.network`)"""
    state: Tensor
    """(B, U) float32, zero beyond the robot's dims"""
    embodiment: Tensor
    """(B,) int64: the embodiment whose encoders and decoder are used"""
    age_ns: Tensor
    """(B,) int64 age of the cognition; 0 where null"""
    cognition: Tensor | None = None
    """(B, K, H) float32; None means null cognition everywhere, or K = 0"""
    is_null: Tensor | None = None
    """(B,) bool; samples of ``cognition`` to replace by the learned null"""


@dataclass(frozen=True, slots=True, kw_only=True)
class GrootPounceConfig:
    """Shapes and options of POUNCE with GR00T inside."""

    groot: GrootConfig
    cognition: CognitionConfig
    slot: PrefixSlot = "features"
    embodiment: int = 31
    """The robot's index among the embodiments; 31 is the public model's slot for a new one."""
    robot_action_dim: int = 8
    """The first dims of the padded action: 7 arm joints and the gripper."""
    robot_state_dim: int = 8
    num_cameras: int = 2
    """front, wrist"""
    cameras: tuple[str, ...] = ()
    """Their names in training, in order; () if they are not known."""
    num_steps: int = 4
    """Euler steps per chunk."""
    control_hz: int = 20
    """Rows a second; 0: not known, as of a public folder."""
    max_prompt_tokens: int = 200
    """Limit of the text's tokens, without the image tokens."""
    reads_subgoal: bool = False
    """Put the newest subgoal's text into the prompt in place of cognition: the paper's subgoal-text reference (3.1)."""

    def __post_init__(self) -> None:
        check_channel(self.cognition, self.reads_subgoal)
        check_camera_names(self.cameras, self.num_cameras)
        if self.cognition.place != "before_images":
            raise ValueError(f"GR00T reads P before the images only, came place {self.cognition.place!r}")
        groot = self.groot
        for name, limit in (("robot_action_dim", groot.action_dim), ("robot_state_dim", groot.state_dim)):
            if not 0 < getattr(self, name) <= limit:
                raise ValueError(f"{name} must be 1..{limit}, came {getattr(self, name)}")
        if not 0 <= self.embodiment < groot.num_embodiments:
            raise ValueError(f"embodiment must be 0..{groot.num_embodiments - 1}, came {self.embodiment}")
        for name in ("num_cameras", "num_steps", "max_prompt_tokens"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, came {getattr(self, name)}")
        if self.slot not in ("features", "embeddings"):
            raise ValueError(f"slot must be 'features' or 'embeddings', came {self.slot!r}")
        if self.cognition.attention != "full":
            raise ValueError("cognition.attention 'isolated' is pi0.5's; GR00T's choice is the slot")

    @property
    def horizon(self) -> int:
        return self.groot.horizon

    @property
    def padded_action_dim(self) -> int:
        return self.groot.action_dim

    @property
    def image_px(self) -> int:
        return self.groot.eagle.vision.image_px

    @property
    def vocab_size(self) -> int:
        return self.groot.eagle.language.vocab_size

    def example_inputs(self, batch_size: int, *, num_tokens: int = 12, seed: int = 0) -> GrootInputs:
        """Makes a valid batch for tests and benchmarks: images, then text, cognition 300 ms old."""
        generator = torch.Generator().manual_seed(seed)
        groot, cognition = self.groot, self.cognition
        image_id = groot.eagle.image_token_id
        text_ids = torch.randint(groot.eagle.language.vocab_size - 1, (batch_size, num_tokens), generator=generator)
        text_ids += text_ids >= image_id  # every id but the image token's
        num_patches = self.num_cameras * groot.eagle.vision.num_patches
        token_ids = torch.cat([torch.full((batch_size, num_patches), image_id), text_ids], dim=1)
        state = torch.zeros(batch_size, groot.state_dim)
        state[:, : self.robot_state_dim].uniform_(-1, 1, generator=generator)
        cognition_BKH = torch.randn((batch_size, cognition.num_carriers, cognition.cognition_size), generator=generator)
        image_shape = (batch_size, self.num_cameras, 3, self.image_px, self.image_px)
        return GrootInputs(
            images=torch.rand(image_shape, generator=generator) * 2 - 1,
            token_ids=token_ids,
            is_token=torch.ones_like(token_ids, dtype=torch.bool),
            state=state,
            embodiment=torch.full((batch_size,), self.embodiment),
            age_ns=torch.full((batch_size,), 300_000_000),
            cognition=cognition_BKH if cognition.num_carriers else None,
        )

    def example_actions(self, batch_size: int, *, seed: int = 0) -> Tensor:
        """Makes normalised training targets, (B, N, A) float32, zero beyond the robot's dims."""
        generator = torch.Generator().manual_seed(seed)
        actions = torch.zeros(batch_size, self.horizon, self.padded_action_dim)
        actions[..., : self.robot_action_dim].uniform_(-1, 1, generator=generator)
        return actions


class GrootPounce(nn.Module):
    """GR00T N1.5 plus, for K >= 1, the cognition prefix. Has the interface of `pi05.pounce.Pounce`."""

    def __init__(self, config: GrootPounceConfig) -> None:
        super().__init__()
        self.config = config
        self.groot = Groot(config.groot)
        has_prefix = config.cognition.num_carriers > 0
        width = config.groot.eagle.language.width
        self.cognition_prefix = CognitionPrefix(config.cognition, width) if has_prefix else None

    @property
    def backbone(self) -> Backbone:
        eagle = self.groot.eagle
        return Backbone(vision=(eagle.vision, eagle.projector), language=eagle.language)

    def features(self, inputs: GrootInputs) -> Tensor:
        """Returns the mixer's input, (B, 1 + K + T, W), with the prefix in front in either slot."""
        cognition_BPW = None
        if self.cognition_prefix is not None:
            cognition_BPW = self.cognition_prefix(inputs.cognition, inputs.age_ns, inputs.is_null)
        is_embedded = self.config.slot == "embeddings"
        features_BTW = self.groot.features(
            inputs.images,
            inputs.token_ids,
            inputs.is_token,
            cognition_BPW=cognition_BPW if is_embedded else None,
        )
        if cognition_BPW is None or is_embedded:
            return features_BTW
        return torch.cat([cognition_BPW.to(features_BTW.dtype), features_BTW], dim=1)

    def prefill(self, inputs: GrootInputs) -> GrootCache:
        """Computes all that does not depend on the flow step: features, mixer, cross-attention keys, state."""
        return self.groot.prefill(self.features(inputs), inputs.state, inputs.embodiment)

    def loss(
        self,
        inputs: GrootInputs,
        actions_BNA: Tensor,
        noise_BNA: Tensor,
        time_B: Tensor,
        *,
        action_mask_BNA: Tensor | None = None,
    ) -> Tensor:
        """Returns the scalar L_fm over the masked action dims; default mask: the robot's dims."""
        if action_mask_BNA is None:
            action_mask_BNA = torch.zeros_like(actions_BNA)
            action_mask_BNA[..., : self.config.robot_action_dim] = 1.0
        unreduced_BNA = self.unreduced_loss(inputs, actions_BNA, noise_BNA, time_B)
        return groot_flow.masked_mean(unreduced_BNA * action_mask_BNA, action_mask_BNA)

    def unreduced_loss(self, inputs: GrootInputs, actions_BNA: Tensor, noise_BNA: Tensor, time_B: Tensor) -> Tensor:
        """Returns the squared error of the velocity, (B, N, A), not masked."""
        x_BNA = groot_flow.noised(actions_BNA, noise_BNA, time_B)
        velocity_BNA = self.groot.velocity_at(x_BNA, time_B, self.prefill(inputs))
        return (groot_flow.target_velocity(actions_BNA, noise_BNA) - velocity_BNA).square()

    def step_table(self) -> GrootStepTable:
        return self.groot.step_table(self.config.num_steps)

    def sample(self, inputs: GrootInputs, noise_BNA: Tensor, table: GrootStepTable) -> Iterator[EulerStep]:
        """Yields the sampler's steps; the actions of the last are the normalised chunk."""
        return self.groot.sample(noise_BNA, self.prefill(inputs), table)
