"""Complete, named sizes of PONDER: one tiny enough for a laptop core, and Qwen3.5's four.

The four real sizes have exactly the published number of parameters (without the multi-token prediction block,
which transformers omits). Source: Qwen3.5 model cards; tests/models checks them on the meta device.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.windows import LAPTOP_WINDOWS, WHOLE, Box

if TYPE_CHECKING:
    from transformers.models.qwen3_5 import Qwen3_5Config


@dataclass(frozen=True, slots=True, kw_only=True)
class PonderConfig:
    """Sizes of one PONDER. GDN is Gated DeltaNet, the linear attention in three of every four layers."""

    hidden_size: int
    ffn_size: int
    num_layers: int
    num_query_heads: int
    num_kv_heads: int
    head_dim: int = 256
    num_gdn_key_heads: int = 16
    num_gdn_value_heads: int
    gdn_head_dim: int = 128
    tied_embeddings: bool
    vocab_size: int = 248_320
    """Rows of the embedding table; a multiple of 128 beyond the tokenizer's last id."""

    vision_depth: int
    vision_hidden_size: int
    vision_ffn_size: int
    vision_num_heads: int
    vision_patch_px: int = 16
    """Side of a patch; an image token covers 2 x 2 of them."""
    vision_num_positions: int = 2304
    """Size of the learned position grid, a square number; it is interpolated to the image's grid."""

    mrope_section: tuple[int, int, int] = (11, 11, 10)
    """Rotary frequencies for t, h, w; they sum to an eighth of ``head_dim``."""
    rope_theta: float = 1e7

    num_carriers: int = 1
    """K: carriers per query, each giving one row of C_t."""
    first_carrier_id: int = 248_077
    """First unused row of the embedding table; the K carriers start there."""
    image_px: tuple[int, int] = (256, 256)
    """Height and width of every input image, in pixels."""
    windows: tuple[Box, ...] = ()
    """A window for each camera (`windows`); () for whole pictures, as in the paper."""

    def __post_init__(self) -> None:
        if self.first_carrier_id + self.num_carriers > self.vocab_size:
            raise ValueError(
                f"{self.num_carriers} carriers from row {self.first_carrier_id} do not fit into vocab_size "
                f"{self.vocab_size}; lower first_carrier_id or num_carriers."
            )
        if 8 * sum(self.mrope_section) != self.head_dim:
            raise ValueError(f"mrope_section {self.mrope_section} must sum to head_dim / 8 = {self.head_dim / 8}")

    def qwen(self, vocabulary: Vocabulary | None = None) -> Qwen3_5Config:
        """The transformers configuration; token ids come from ``vocabulary`` when there is one."""
        from transformers.models.qwen3_5 import Qwen3_5Config  # here, because POUNCE's server reads these sizes, too

        token_ids: dict[str, Any] = {}
        if vocabulary is not None:
            token_ids = {
                "image_token_id": vocabulary.image_pad,
                "video_token_id": vocabulary.video_pad,
                "vision_start_token_id": vocabulary.vision_start,
                "vision_end_token_id": vocabulary.vision_end,
            }
        return Qwen3_5Config(
            tie_word_embeddings=self.tied_embeddings,
            text_config={
                "vocab_size": self.vocab_size,
                "hidden_size": self.hidden_size,
                "intermediate_size": self.ffn_size,
                "num_hidden_layers": self.num_layers,
                "num_attention_heads": self.num_query_heads,
                "num_key_value_heads": self.num_kv_heads,
                "head_dim": self.head_dim,
                "full_attention_interval": 4,
                "linear_num_key_heads": self.num_gdn_key_heads,
                "linear_num_value_heads": self.num_gdn_value_heads,
                "linear_key_head_dim": self.gdn_head_dim,
                "linear_value_head_dim": self.gdn_head_dim,
                "max_position_embeddings": 262_144,
                "tie_word_embeddings": self.tied_embeddings,
                "rope_parameters": {
                    "rope_type": "default",
                    "rope_theta": self.rope_theta,
                    "partial_rotary_factor": 0.25,
                    "mrope_section": list(self.mrope_section),
                    "mrope_interleaved": True,
                },
            },
            vision_config={
                "depth": self.vision_depth,
                "hidden_size": self.vision_hidden_size,
                "intermediate_size": self.vision_ffn_size,
                "num_heads": self.vision_num_heads,
                "out_hidden_size": self.hidden_size,
                "num_position_embeddings": self.vision_num_positions,
                "patch_size": self.vision_patch_px,
            },
            **token_ids,
        )


def tiny_cpu() -> PonderConfig:
    """Every kind of layer (6 GDN, 2 attention, 2 vision), small enough to run on one laptop core."""
    return PonderConfig(
        hidden_size=96,
        ffn_size=192,
        num_layers=8,
        num_query_heads=4,
        num_kv_heads=2,
        head_dim=32,
        num_gdn_key_heads=2,
        num_gdn_value_heads=4,
        gdn_head_dim=32,
        tied_embeddings=False,
        vocab_size=512,
        vision_depth=2,
        vision_hidden_size=64,
        vision_ffn_size=128,
        vision_num_heads=4,
        vision_num_positions=256,
        mrope_section=(2, 1, 1),
        first_carrier_id=448,
    )


def laptop() -> PonderConfig:
    """The pair that two CPU cores train: 64 px windows of both cameras, 16 tokens a picture."""
    return PonderConfig(
        hidden_size=160,
        ffn_size=480,
        num_layers=4,
        num_query_heads=4,
        num_kv_heads=2,
        head_dim=32,
        num_gdn_key_heads=2,
        num_gdn_value_heads=4,
        gdn_head_dim=32,
        tied_embeddings=False,
        vocab_size=2048,
        vision_depth=4,
        vision_hidden_size=128,
        vision_ffn_size=256,
        vision_num_heads=4,
        vision_patch_px=8,
        vision_num_positions=64,
        mrope_section=(2, 1, 1),
        first_carrier_id=2000,
        image_px=(64, 64),
        windows=LAPTOP_WINDOWS,
    )


def laptop_kitchen() -> PonderConfig:
    """`laptop` with whole pictures, of three cameras or of a demonstration's one."""
    return replace(laptop(), windows=(WHOLE, WHOLE, WHOLE))


def qwen35_0p8b() -> PonderConfig:
    return PonderConfig(
        hidden_size=1024,
        ffn_size=3584,
        num_layers=24,
        num_query_heads=8,
        num_kv_heads=2,
        num_gdn_value_heads=16,
        tied_embeddings=True,
        vision_depth=12,
        vision_hidden_size=768,
        vision_ffn_size=3072,
        vision_num_heads=12,
    )


def qwen35_2b() -> PonderConfig:
    return PonderConfig(
        hidden_size=2048,
        ffn_size=6144,
        num_layers=24,
        num_query_heads=8,
        num_kv_heads=2,
        num_gdn_value_heads=16,
        tied_embeddings=True,
        vision_depth=24,
        vision_hidden_size=1024,
        vision_ffn_size=4096,
        vision_num_heads=16,
    )


def qwen35_4b() -> PonderConfig:
    return PonderConfig(
        hidden_size=2560,
        ffn_size=9216,
        num_layers=32,
        num_query_heads=16,
        num_kv_heads=4,
        num_gdn_value_heads=32,
        tied_embeddings=True,
        vision_depth=24,
        vision_hidden_size=1024,
        vision_ffn_size=4096,
        vision_num_heads=16,
    )


def qwen35_9b() -> PonderConfig:
    """The paper's PONDER."""
    return PonderConfig(
        hidden_size=4096,
        ffn_size=12288,
        num_layers=32,
        num_query_heads=16,
        num_kv_heads=4,
        num_gdn_value_heads=32,
        tied_embeddings=False,
        vision_depth=27,
        vision_hidden_size=1152,
        vision_ffn_size=4304,
        vision_num_heads=16,
    )
