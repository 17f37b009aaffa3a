"""Named complete POUNCE configurations."""

from dataclasses import replace
from typing import TypeVar

from dual_system.models.action_space import ActionSpace, num_dims
from dual_system.models.frame_sampling import FrameMemoryConfig, FrameSampling
from dual_system.models.groot.blocks import BlockConfig
from dual_system.models.groot.eagle import EagleConfig
from dual_system.models.groot.network import GrootConfig
from dual_system.models.groot.pounce import GrootPounceConfig
from dual_system.models.groot.qwen3 import Qwen3Config
from dual_system.models.interface import CognitionConfig
from dual_system.models.pi05.gemma import GemmaConfig
from dual_system.models.pi05.network import Pi05Config
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.siglip import VisionConfig
from dual_system.models.windows import LAPTOP_WINDOWS

Config = TypeVar("Config", bound=PounceConfig | GrootPounceConfig)

ROBOMME_HORIZON = 20
"""One second of 20 Hz playback (paper B.1)."""
GROOT_HORIZON = 16
GROOT_PROJECTOR_STD = 1e-3
"""Initial std of W_c (the paper gives it for GR00T)."""
TINY_IMAGE_TOKEN_ID = 261
"""Id of ``<IMG_CONTEXT>`` in `groot.prompt.tiny_eagle_tokenizer_for_random_weights`."""


def pi05_base(*, num_carriers: int = 1, cognition_size: int = 4096, horizon: int = ROBOMME_HORIZON) -> PounceConfig:
    """The 3.35 B public pi0.5 with the paper's prefix: two views, K = 1 from a 9B PONDER, 20-step chunks."""
    return PounceConfig(
        pi05=Pi05Config(
            vision=VisionConfig(width=1152, depth=27, num_heads=16, mlp_width=4304),
            language=GemmaConfig(width=2048, depth=18, mlp_width=16_384),
            expert=GemmaConfig(width=1024, depth=18, mlp_width=4096),
            horizon=horizon,
        ),
        cognition=CognitionConfig(num_carriers=num_carriers, cognition_size=cognition_size),
    )


def tiny_cpu(*, num_carriers: int = 1, cognition_size: int = 64, horizon: int = ROBOMME_HORIZON) -> PounceConfig:
    """A network of the same parts that one CPU thread runs at 20 Hz; for random weights and tests.

    Frames are resized to the public 224 px but cut into 28 px patches, 64 per view. With the public 14 px,
    256 per view, attention doubles the time of an invocation.
    """
    return PounceConfig(
        pi05=Pi05Config(
            vision=VisionConfig(width=48, depth=2, num_heads=3, mlp_width=96, patch_px=28),
            language=GemmaConfig(width=64, depth=3, mlp_width=128, head_dim=16),
            expert=GemmaConfig(width=48, depth=3, mlp_width=96, head_dim=16),
            vocab_size=512,
            horizon=horizon,
        ),
        cognition=CognitionConfig(num_carriers=num_carriers, cognition_size=cognition_size),
    )


def laptop(*, num_carriers: int = 1, cognition_size: int = 160) -> PounceConfig:
    """The pair that two CPU cores train: 64 px windows of both cameras, state as one token, tool deltas, a pointer."""
    network = PounceConfig(
        pi05=Pi05Config(
            vision=VisionConfig(width=128, depth=4, num_heads=4, mlp_width=256, image_px=64, patch_px=8),
            language=GemmaConfig(width=128, depth=2, mlp_width=256, head_dim=32, num_heads=4),
            expert=GemmaConfig(width=128, depth=2, mlp_width=256, head_dim=32, num_heads=4),
            vocab_size=1024,
            action_dim=8,
            horizon=ROBOMME_HORIZON,
        ),
        cognition=CognitionConfig(num_carriers=num_carriers, cognition_size=cognition_size),
        windows=LAPTOP_WINDOWS,
        max_prompt_tokens=64,
        state_input="token",
        num_pointed=2,
    )
    return in_space(network, "ee_delta")


def laptop_kitchen(*, num_carriers: int = 1, cognition_size: int = 160) -> PounceConfig:
    """`laptop` for the kitchen's PandaOmron: three whole views, chunks of 16 rows, and no pointer."""
    network = laptop(num_carriers=num_carriers, cognition_size=cognition_size)
    pi05 = replace(network.pi05, action_dim=12, horizon=GROOT_HORIZON)
    return replace(network, pi05=pi05, windows=(), num_cameras=3, num_pointed=0)


def groot_n1_5(*, num_carriers: int = 1, cognition_size: int = 4096, horizon: int = GROOT_HORIZON) -> GrootPounceConfig:
    """The public GR00T N1.5 (2.72 B with its unused LM head) with a prefix from a 9B PONDER."""
    return GrootPounceConfig(
        groot=GrootConfig(
            eagle=EagleConfig(
                vision=VisionConfig(width=1152, depth=27, num_heads=16, mlp_width=4304),
                language=Qwen3Config(width=2048, depth=12, mlp_width=6144),
            ),
            mixer=BlockConfig(depth=4, num_heads=32, head_dim=64, mlp_width=8192),
            dit=BlockConfig(depth=16, num_heads=32, head_dim=48, mlp_width=6144),
            horizon=horizon,
        ),
        cognition=CognitionConfig(
            num_carriers=num_carriers, cognition_size=cognition_size, projector_std=GROOT_PROJECTOR_STD
        ),
    )


def tiny_groot(*, num_carriers: int = 1, cognition_size: int = 64, horizon: int = ROBOMME_HORIZON) -> GrootPounceConfig:
    """`tiny_cpu` with GR00T's parts, and the same horizon, so that it fits the same schedules."""
    return GrootPounceConfig(
        groot=GrootConfig(
            eagle=EagleConfig(
                vision=VisionConfig(width=48, depth=2, num_heads=3, mlp_width=96, patch_px=28),
                language=Qwen3Config(
                    width=64, depth=2, mlp_width=128, num_heads=4, num_kv_heads=2, head_dim=16, vocab_size=512
                ),
                image_token_id=TINY_IMAGE_TOKEN_ID,
            ),
            mixer=BlockConfig(depth=1, num_heads=4, head_dim=16, mlp_width=128),
            dit=BlockConfig(depth=4, num_heads=4, head_dim=12, mlp_width=96),
            hidden_width=48,
            num_embodiments=2,
            num_future_tokens=4,
            max_actions=64,
            horizon=horizon,
        ),
        cognition=CognitionConfig(
            num_carriers=num_carriers, cognition_size=cognition_size, projector_std=GROOT_PROJECTOR_STD
        ),
        embodiment=1,
    )


def tiny_frame_memory() -> FrameMemoryConfig:
    """`FrameMemoryConfig` at the size of `tiny_cpu`: eight pictures, one a second."""
    sampling = FrameSampling(num_frames=8, stride_ticks=20)
    return FrameMemoryConfig(sampling=sampling, position_size=48, head_dim=16)


def in_space(config: Config, space: ActionSpace) -> Config:
    """Returns the configuration for another of the Panda's action spaces; the shapes of the weights do not change."""
    dims = num_dims(space)
    if dims is None:
        raise ValueError(f"the data decide the dims in space {space!r}: see `training.build`")
    return replace(config, robot_action_dim=dims, robot_state_dim=dims)
