"""The cognition interface: P = [e_age, W_c C_1, ..., W_c C_K], all that passes from System 2 to System 1 (paper 3.1).

Choices the paper leaves open, made here: the age enters as [sin | cos] at log-spaced periods from 0.1 s to
100 s and does not pass W_c (as the equation reads); P precedes the images; fresh W_c and W_a give P the rms of the
text embeddings. That scale matters little to pi0.5, which begins with a scale-free RMSNorm: a small W_c does not
silence the prefix, and even an all-zero token takes part in the softmax. Null is not absent.
"""

# B batch, K carriers, H size of a carrier state, W width of the language stream, P = 1 + K tokens

from dataclasses import dataclass
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from clock.timebase import NS_PER_S
from dual_system.models.sinusoid import sinusoid

MAX_CARRIERS = 16

PrefixAttention = Literal["full", "isolated"]
PrefixOrder = Literal["age_first", "cognition_first"]
PrefixPlace = Literal["before_images", "after_text"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CognitionConfig:
    """Shape and treatment of the cognition prefix."""

    num_carriers: int = 1
    """K; the paper trains 1 and times 8. 0 removes the prefix, age token included: the public pi0.5."""
    cognition_size: int = 4096
    """H, the hidden size of PONDER (4096 for Qwen3.5-9B)."""
    attention: PrefixAttention = "full"
    """full: P is in one bidirectional block with images and text, as a text prefix would be. isolated: P does not
    attend to images and text nor they to P, so their keys do not depend on cognition; the actions attend to both."""
    gradient_scale: float = 0.5
    """Scale of the action gradient that enters PONDER through C (paper A.3)."""
    projector_std: float | None = None
    """Initial std of W_c. None: for C of rms 1, W_c C has the rms of the text embeddings. (The paper's 1e-3
    is for GR00T.)"""
    rounds_places: bool = False
    """Snap the place encoding at the start of every carrier to the nearest valid one (`small_pair.place_code`). Only
    the demo's POUNCE declares it."""
    age_features: int = 64
    age_min_period_s: float = 0.1
    age_max_period_s: float = 100.0
    age_bias: bool = False
    """The age's projection has a bias."""
    order: PrefixOrder = "age_first"
    place: PrefixPlace = "before_images"
    """after_text: P ends the prefix, behind the state's token if there is one; for "full" attention only."""

    def __post_init__(self) -> None:
        if not 0 <= self.num_carriers <= MAX_CARRIERS:
            raise ValueError(f"num_carriers must be 0..{MAX_CARRIERS}, came {self.num_carriers}")
        if self.cognition_size < 1:
            raise ValueError(f"cognition_size must be at least 1, came {self.cognition_size}")
        if self.age_features < 2 or self.age_features % 2:
            raise ValueError(f"age_features must be even and at least 2, came {self.age_features}")
        if self.attention not in ("full", "isolated"):
            raise ValueError(f"attention must be 'full' or 'isolated', came {self.attention!r}")
        if self.place == "after_text" and self.attention != "full":
            raise ValueError("place 'after_text' needs attention 'full': an isolated P stands before the images")

    @property
    def num_tokens(self) -> int:
        """Length of P: one age token and K carriers, or 0 at K = 0."""
        return self.num_carriers + 1 if self.num_carriers else 0


class _ScaleGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, scale: float) -> Tensor:
        ctx.scale = scale
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return grad * ctx.scale, None


def scale_gradient(x: Tensor, scale: float) -> Tensor:
    """Identity in the forward pass; multiplies the gradient by ``scale`` in the backward pass."""
    return cast(Tensor, _ScaleGradient.apply(x, scale))  # type: ignore[no-untyped-call]


def check_channel(cognition: CognitionConfig, reads_subgoal: bool) -> None:
    """Raises ValueError for a POUNCE that reads text and cognition: text takes cognition's place."""
    if reads_subgoal and cognition.num_carriers:
        raise ValueError(
            f"reads_subgoal puts text in place of cognition: expected num_carriers 0, came {cognition.num_carriers}"
        )


def check_camera_names(names: tuple[str, ...], num_cameras: int) -> None:
    """Raises ValueError unless there is a name for each camera, or none at all."""
    if names and len(names) != num_cameras:
        raise ValueError(f"expected the names of {num_cameras} cameras or none, came {', '.join(names)}")


class CognitionPrefix(nn.Module):
    """Projects cognition and age into the language stream. Needs K >= 1."""

    def __init__(self, config: CognitionConfig, width: int) -> None:
        super().__init__()
        if config.num_carriers == 0:
            raise ValueError("K = 0 has no cognition prefix; leave the module out")
        self.config = config
        self.projector = nn.Linear(config.cognition_size, width)
        self.age_projection = nn.Linear(config.age_features, width, bias=config.age_bias)
        self.null_cognition = nn.Parameter(torch.empty(config.num_carriers, config.cognition_size))

    @torch.no_grad()
    def initialise(self, text_rms: float, generator: torch.Generator) -> None:
        """Draws fresh weights: null cognition and biases zero, W_c and W_a normal so that P has the rms ``text_rms``.

        Args:
            text_rms: rms of the text embeddings as they enter the stream, sqrt(W) included.
        """
        std = self.config.projector_std
        if std is None:
            std = text_rms * self.config.cognition_size**-0.5
        self.projector.weight.normal_(std=std, generator=generator)
        self.projector.bias.zero_()
        # sin^2 + cos^2 = 1 per period: the features' squared length is age_features / 2 at every age.
        age_std = text_rms * (self.config.age_features / 2) ** -0.5
        self.age_projection.weight.normal_(std=age_std, generator=generator)
        if self.age_projection.bias is not None:
            self.age_projection.bias.zero_()
        self.null_cognition.zero_()

    def forward(self, cognition_BKH: Tensor | None, age_ns_B: Tensor, is_null_B: Tensor | None = None) -> Tensor:
        """Returns P, (B, 1 + K, W) float32.

        Args:
            cognition_BKH: carrier states; None means null for every sample.
            age_ns_B: int64 age of each cognition. Null samples get age 0 regardless (paper 3.1).
            is_null_B: bool, samples that get C_null instead: nothing ready yet, or cognition dropout.

        Raises:
            ValueError: cognition has another K or H than configured; the network itself would accept any K.
        """
        null_BKH = self.null_cognition.expand(len(age_ns_B), -1, -1)
        if cognition_BKH is None:
            source_BKH, age_ns_B = null_BKH, torch.zeros_like(age_ns_B)
        elif cognition_BKH.shape != null_BKH.shape:
            raise ValueError(
                f"cognition: expected {tuple(null_BKH.shape)}, came {tuple(cognition_BKH.shape)} "
                "(batch, num_carriers, cognition_size)"
            )
        else:
            # Scaled before the null is chosen: C_null is POUNCE's own parameter and gets its full gradient.
            source_BKH = scale_gradient(cognition_BKH.float(), self.config.gradient_scale)
            if self.config.rounds_places:
                from dual_system.models.small_pair.place_code import snap_to_code  # lazy: only the demo's pair has it

                source_BKH = snap_to_code(source_BKH)
            if is_null_B is not None:
                source_BKH = torch.where(is_null_B[:, None, None], null_BKH, source_BKH)
                age_ns_B = age_ns_B.masked_fill(is_null_B, 0)
        age_features = sinusoid(
            age_ns_B.double() / NS_PER_S,
            self.config.age_features,
            min_period=self.config.age_min_period_s,
            max_period=self.config.age_max_period_s,
        )
        tokens = [self.age_projection(age_features)[:, None], self.projector(source_BKH)]
        return torch.cat(tokens if self.config.order == "age_first" else tokens[::-1], dim=1)
