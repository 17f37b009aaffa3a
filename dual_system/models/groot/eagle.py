"""Eagle, GR00T N1.5's vision-language model: SigLIP2, one linear layer, and the first Qwen3 layers.

The text already holds a slot for every patch: rows whose id is the image token's are overwritten with patch
features, view after view. Text embeddings are not scaled. Positions count the left padding, which does not matter
to RoPE.
"""

# B batch, V views, S patches a view, T tokens, P cognition tokens, W language width

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dual_system.models.groot.qwen3 import Qwen3, Qwen3Config
from dual_system.models.siglip import VisionConfig, VisionTower


@dataclass(frozen=True, slots=True, kw_only=True)
class EagleConfig:
    vision: VisionConfig
    language: Qwen3Config
    image_token_id: int = 151_669
    """Id of ``<IMG_CONTEXT>``, one per patch in the text."""

    def __post_init__(self) -> None:
        if not 0 <= self.image_token_id < self.language.vocab_size:
            raise ValueError(f"image_token_id must be below vocab_size {self.language.vocab_size}")


class Eagle(nn.Module):
    def __init__(self, config: EagleConfig) -> None:
        super().__init__()
        self.config = config
        self.vision = VisionTower(config.vision)
        self.projector = nn.Linear(config.vision.width, config.language.width)
        self.language = Qwen3(config.language)

    @property
    def stream_dtype(self) -> torch.dtype:
        return self.language.embed_tokens.weight.dtype

    def vision_features(self, images_BV3PP: Tensor) -> Tensor:
        """(B, V, 3, px, px) float32 in [-1, 1] -> (B, V, S, W)."""
        features_nSW: Tensor = self.projector(self.vision(images_BV3PP.flatten(0, 1), self.stream_dtype))
        return features_nSW.unflatten(0, images_BV3PP.shape[:2])

    def input_embeds(self, vision_BVSW: Tensor, token_ids_BT: Tensor) -> Tensor:
        """Embeds the text and writes the patches into their slots, (B, T, W).

        Whoever makes the ids checks that they hold one image token per patch (`pounce.reading`): here a GPU would wait.
        """
        is_image_BT = token_ids_BT == self.config.image_token_id
        text_BTW: Tensor = self.language.embed_tokens(token_ids_BT)
        return text_BTW.masked_scatter(is_image_BT[:, :, None], vision_BVSW.to(text_BTW.dtype))

    def features(self, embeds_BTW: Tensor, is_token_BT: Tensor, cognition_BPW: Tensor | None = None) -> Tensor:
        """Runs embeddings through the language layers, (B, P + T, W) after the last norm.

        ``cognition_BPW`` is inserted right before the first real token, after any padding: every real token sees
        it, and the rows of a batch do not depend on the amount of padding.
        """
        positions_BT = torch.arange(embeds_BTW.shape[1], device=embeds_BTW.device).expand_as(is_token_BT)
        if cognition_BPW is not None:
            num_cognition = cognition_BPW.shape[1]
            num_padding_B1 = (~is_token_BT).sum(dim=1, keepdim=True)
            cognition_positions = num_padding_B1 + torch.arange(num_cognition, device=embeds_BTW.device)
            positions_BT = torch.cat([cognition_positions, positions_BT + num_cognition], dim=1)
            embeds_BTW = torch.cat([cognition_BPW.to(embeds_BTW.dtype), embeds_BTW], dim=1)
            is_token_BT = torch.cat([torch.ones_like(cognition_positions, dtype=torch.bool), is_token_BT], dim=1)
        features_BTW: Tensor = self.language(embeds_BTW, positions_BT, is_token_BT)
        return features_BTW
