"""PONDER: Qwen3.5 read as a context engine; its hidden states at the carrier positions are the cognition C_t.

Paper, section 3.1. The network is transformers' ``Qwen3_5ForConditionalGeneration`` (Gated DeltaNet and
attention layers, vision tower); this file defines how it is called: explicit positions, whole rows, and the
LM head at selected positions only (at 248,320 rows, logits of a whole episode are gigabytes). Serving runs
the same modules over a few tokens at a time (``ponder_server/decoder.py``).

# B batch, T tokens, H hidden, N selected positions, V vocabulary
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from transformers.models.qwen3_5 import Qwen3_5Config, Qwen3_5ForConditionalGeneration
from transformers.models.qwen3_5.modeling_qwen3_5 import (
    Qwen3_5TextRotaryEmbedding,
    Qwen3_5VisionRotaryEmbedding,
)

from dual_system.models.gpu import generator_for
from dual_system.models.ponder.configs import PonderConfig
from dual_system.models.ponder.context import ContextFormat, Row
from dual_system.models.ponder.gated_delta import GatedDelta
from dual_system.models.ponder.observation import WHOLE_VIEWS
from dual_system.models.ponder.patches import patchify
from dual_system.models.ponder.vision import image_tokens
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.windows import Windows

FLOAT32_PARAMETERS = ("linear_attn.A_log", "linear_attn.norm.weight")
"""Name suffixes of parameters that stay float32 in every dtype, as in public Qwen3.5 checkpoints: A_log is the decay,
whose error accumulates over thousands of tokens."""


class Ponder(nn.Module):
    """System 2. Build it with :meth:`random`, or with ``checkpoint.load_ponder``."""

    def __init__(
        self,
        qwen_config: Qwen3_5Config,
        context_format: ContextFormat,
        *,
        image_px: tuple[int, int],
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Allocates the network and leaves its weights undefined, for :meth:`random` or a checkpoint to fill.

        Raises ValueError if the carriers or the state's tokens do not fit into the embedding table, or if ``image_px``
        contradicts ``context_format``.
        """
        super().__init__()
        text: Any = qwen_config.text_config
        vision: Any = qwen_config.vision_config
        last_row = max([*context_format.carrier_ids, *context_format.reader.state_rows])
        if last_row >= text.vocab_size:
            raise ValueError(
                f"row {last_row} is outside the embedding table of {text.vocab_size} rows; lower first_carrier_id or "
                "num_carriers, or move the state's tokens."
            )
        needed_px = token_px(qwen_config)
        if image_px != context_format.image_px or needed_px != context_format.token_px:
            raise ValueError(
                f"image_px {image_px} does not give an image grid of {context_format.image_grid} tokens of "
                f"{needed_px} px; height and width must be multiples of {needed_px}."
            )
        self.format = context_format
        self.image_px = image_px
        self.is_random = True
        """True if the carriers were never trained: cognition is noise. Training sets it False; checkpoints store it."""
        self.served_hash: str | None = None
        """Hash of the weights when an engine took them over; computed once, because it reads all of them."""
        self.mtp: dict[str, Tensor] = {}
        """The checkpoint's multi-token prediction block, by name: a draft for serving, saved unchanged."""
        qwen: Any = skeleton(qwen_config).to(dtype=dtype)
        for name, parameter in qwen.named_parameters():
            if name.endswith(FLOAT32_PARAMETERS):
                parameter.data = parameter.data.float()
        qwen.to_empty(device=device)
        qwen.tie_weights()  # to_empty gives every name its own tensor
        # Rotary frequencies are buffers that no checkpoint holds; to_empty left them undefined.
        qwen.model.language_model.rotary_emb = Qwen3_5TextRotaryEmbedding(text).to(device)
        qwen.model.visual.rotary_pos_emb = Qwen3_5VisionRotaryEmbedding(vision).to(device)
        self.qwen: Any = qwen.eval()

    def look_at(self, image_px: tuple[int, int]) -> None:
        """Reads images of another size: positions are interpolated to any. Raises ValueError as the constructor."""
        grid = image_grid(self.qwen.config, image_px)
        self.format, self.image_px = replace(self.format, image_grid=grid), image_px

    @classmethod
    def random(
        cls,
        config: PonderConfig,
        vocabulary: Vocabulary | None = None,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> Self:
        """A network whose weights depend on ``config`` and ``seed`` alone, and on whether ``device`` is a GPU; global
        random state is untouched.

        Without a ``vocabulary`` it uses :meth:`Vocabulary.tiny`.
        """
        if vocabulary is None:
            vocabulary = Vocabulary.tiny()
        qwen_config = config.qwen(vocabulary)
        context_format = ContextFormat(
            vocabulary=vocabulary,
            num_carriers=config.num_carriers,
            first_carrier_id=config.first_carrier_id,
            image_grid=image_grid(qwen_config, config.image_px),
            token_px=token_px(qwen_config),
            reader=Windows(config.windows) if config.windows else WHOLE_VIEWS,
        )
        ponder = cls(qwen_config, context_format, image_px=config.image_px, device=device, dtype=dtype)
        fill_randomly(ponder.qwen, seed=seed)
        return ponder

    @torch.no_grad()
    def draw_carriers(self, seed: int) -> None:
        """Draws the carriers' input embeddings anew, with the rms of the tokenizer's (paper, 3.2: at random).

        A public folder has padding rows in their place, which may all be equal.
        """
        table: Tensor = self.qwen.model.language_model.embed_tokens.weight
        tokens = table[: self.format.vocabulary.num_tokens]
        rms = float(torch.linalg.vector_norm(tokens, dtype=torch.float32)) / tokens.numel() ** 0.5
        generator = generator_for(table.device, seed)
        for row in self.format.carrier_ids:
            drawn = torch.empty(table.shape[1], device=generator.device).normal_(0.0, rms, generator=generator)
            table[row].copy_(drawn)

    @property
    def hidden_size(self) -> int:
        return int(self.qwen.config.text_config.hidden_size)

    @property
    def vocab_size(self) -> int:
        """Rows of the embedding table."""
        return int(self.qwen.config.text_config.vocab_size)

    @property
    def layers(self) -> list[Any]:
        """Layers of the vision tower, then of the language model."""
        model = self.qwen.model
        return [*model.visual.blocks, *model.language_model.layers]

    @property
    def device(self) -> torch.device:
        weight: Tensor = self.qwen.lm_head.weight
        return weight.device

    @property
    def dtype(self) -> torch.dtype:
        weight: Tensor = self.qwen.lm_head.weight
        return weight.dtype

    def image_features(self, frames_NHW3: Tensor) -> Tensor:
        """Vision tokens (N * tokens per image, H) of N frames (N, height, width, 3) uint8."""
        vision = self.qwen.config.vision_config
        _, height, width, _ = frames_NHW3.shape
        patches = patchify(
            frames_NHW3,
            patch_px=vision.patch_size,
            merge=vision.spatial_merge_size,
            temporal=vision.temporal_patch_size,
        )
        grid = (height // vision.patch_size, width // vision.patch_size)
        return image_tokens(self.qwen.model.visual, patches.to(self.dtype), grid)

    def embed(
        self,
        ids_T: Sequence[int] | npt.NDArray[np.integer],
        frames_NHW3: Tensor | None = None,
        look: Callable[[Tensor], Tensor] | None = None,
    ) -> Tensor:
        """Input embeddings (T, H): rows of the table, with the frames' vision tokens at the image positions.

        ``look`` gives these tokens in place of `image_features`.

        Raises ValueError unless the frames have as many tokens as ``ids`` has image positions.
        """
        ids = np.asarray(ids_T, np.int64)
        index_T = torch.from_numpy(ids).to(self.device)
        embeds_TH: Tensor = self.qwen.model.language_model.embed_tokens(index_T)
        is_image_T = index_T == self.format.vocabulary.image_pad
        num_places = int((ids == self.format.vocabulary.image_pad).sum())
        num_features = 0 if frames_NHW3 is None else len(frames_NHW3) * self.format.num_image_tokens
        if num_places != num_features:
            raise ValueError(f"tokens hold {num_places} image positions, the frames bring {num_features}")
        if frames_NHW3 is None:
            return embeds_TH
        features = (look or self.image_features)(frames_NHW3).to(embeds_TH.dtype)
        return embeds_TH.masked_scatter(is_image_T[:, None], features)

    def forward(self, embeds_BTH: Tensor, positions_4BT: Tensor) -> Tensor:
        """Final hidden states (B, T, H), after the last norm, of whole contexts; causal.

        Rows may be padded on the right: causality keeps padding from affecting real tokens.
        """
        output = self.qwen.model.language_model(
            inputs_embeds=embeds_BTH,
            position_ids=positions_4BT,
            use_cache=False,
            # A dict is passed to the layers unchanged: transformers builds no mask and does not detect packed rows.
            attention_mask={"full_attention": None, "linear_attention": None},
        )
        hidden_BTH: Tensor = output.last_hidden_state
        return hidden_BTH

    def logits(self, hidden_NH: Tensor, tokens: Sequence[int] | None = None) -> Tensor:
        """LM logits (N, V) for the hidden states of selected positions; (N, len(tokens)) if ``tokens`` are given."""
        head = self.qwen.lm_head
        logits: Tensor = head(hidden_NH) if tokens is None else F.linear(hidden_NH, head.weight[[*tokens]])
        return logits

    def encode_row(self, row: Row, frames_NHW3: Tensor | None) -> Tensor:
        """Final hidden states (T, H) of a whole row in one pass without a cache, as in training."""
        positions_4T, _ = self.format.positions(row.ids)
        positions_4BT = torch.from_numpy(positions_4T)[:, None].to(self.device)
        hidden_BTH: Tensor = self(self.embed(row.ids, frames_NHW3)[None], positions_4BT)
        return hidden_BTH[0]


def token_px(qwen_config: Qwen3_5Config) -> int:
    """Side in pixels of the square that one image token covers."""
    vision: Any = qwen_config.vision_config
    return int(vision.patch_size * vision.spatial_merge_size)


def image_grid(qwen_config: Qwen3_5Config, image_px: tuple[int, int]) -> tuple[int, int]:
    """Tokens of one frame as (rows, columns). ValueError if ``image_px`` is no multiple of the token's side."""
    side_px = token_px(qwen_config)
    height, width = image_px
    if height < side_px or width < side_px or height % side_px or width % side_px:
        raise ValueError(f"image_px {image_px}: height and width must be multiples of {side_px} px")
    return height // side_px, width // side_px


def skeleton(qwen_config: Qwen3_5Config) -> nn.Module:
    """The network on the meta device: names, shapes and parameter counts, no memory."""
    build: Any = Qwen3_5ForConditionalGeneration._from_config
    with torch.device("meta"):
        model: Any = build(qwen_config, attn_implementation="sdpa")
        text: Any = qwen_config.text_config
        for index, layer in enumerate(model.model.language_model.layers):
            if text.layer_types[index] == "linear_attention":
                layer.linear_attn = GatedDelta(text, index)
    return model


@torch.no_grad()
def fill_randomly(qwen: nn.Module, *, seed: int) -> None:
    """Fills every parameter from one generator: an untrained network whose hidden states depend on its whole context.

    Unlike with the usual std of 0.02, activations keep their scale through the layers, and the recurrent layers' decay
    times range from a few tokens to almost endless, so that hidden states depend on images and on the past, and tests
    detect a wrong cache. Drawn in float32, in order of name, by `gpu.generator_for`; on the meta device nothing is.
    """
    parameters = sorted(qwen.named_parameters())
    device = parameters[0][1].device
    if device.type == "meta":
        return
    generator = generator_for(device, seed)
    for name, parameter in parameters:
        value = torch.empty(parameter.shape, device=generator.device)
        leaf = name.rsplit(".", 1)[-1]
        if leaf == "A_log":
            value.uniform_(-4.0, 0.5, generator=generator)
        elif leaf == "dt_bias":
            value.uniform_(-3.0, 1.0, generator=generator)
        elif leaf == "bias":
            value.normal_(0.0, 0.1, generator=generator)
        elif value.ndim == 1:  # norms: Qwen3.5's RMSNorm scales by 1 + w, the gated and the vision norms by w
            is_offset = "language_model" in name and "linear_attn.norm" not in name
            value.normal_(0.0 if is_offset else 1.0, 0.1, generator=generator)
        elif "embed" in name and "patch" not in name:
            value.normal_(0.0, 1.0, generator=generator)
        else:
            value.normal_(0.0, value[0].numel() ** -0.5, generator=generator)
        parameter.copy_(value)
