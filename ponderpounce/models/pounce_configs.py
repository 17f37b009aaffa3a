"""Named complete POUNCE configurations."""

from ponderpounce.models.gemma import GemmaConfig
from ponderpounce.models.interface import CognitionConfig
from ponderpounce.models.pi05 import Pi05Config
from ponderpounce.models.pounce import PounceConfig
from ponderpounce.models.siglip import VisionConfig

ROBOMME_HORIZON = 20
"""One second of 20 Hz playback (paper B.1)."""


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

    Frames are resized to the public 224 px but cut into 28 px patches, 64 a view. With the public 14 px,
    256 a view, attention doubles the time of an invocation.
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
