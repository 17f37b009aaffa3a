"""The laptop pair's head: it points at places of the front picture, and the expert acts on what is there.

Every token of the front picture is scored, as it enters the last language layer, where it has read text and cognition.
The mean of the tokens under the softmax of the scores, with the state's token, is a vector that conditions all adaRMS
norms of the expert beside the flow time; a norm's style is linear in its condition, so the vector's share is added to
styles that are tabulated. With `condition` at zero, its initial value, the network is pi0.5 bit for bit. All of it is
float32.

pi0.5 has no such head. A hand of a few million weights that has hours to learn in needs it (docs/decisions.md).
"""

# B batch, T prefix tokens, S tokens of the front picture, Q places, W language width, E expert width, M norms

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dual_system.models.pi05.gemma import ActionExpert, RmsNorm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pointed:
    """What a pointer chose in one prefix, for all flow steps."""

    scores: Tensor
    """(B, Q, S): logits over the front picture's tokens, row by row."""
    styles: Tensor
    """(M, 3, B, 1, E), to be added to the styles of the flow time."""

    def repeated(self, times: int) -> "Pointed":
        """As `PrefixCache.repeated`."""
        return Pointed(scores=self.scores.repeat(times, 1, 1), styles=self.styles.repeat(1, 1, times, 1, 1))


class Pointer(nn.Module):
    """Points at ``num_places`` places: at what is to be grasped or pressed, and at where it is to go."""

    def __init__(self, num_places: int, *, num_patches: int, width: int, expert_width: int) -> None:
        super().__init__()
        self.num_patches = num_patches
        self.norm = RmsNorm(width)
        self.score = nn.Linear(width, num_places, bias=False)
        self.read = nn.Linear((num_places + 1) * width, expert_width)
        self.condition = nn.Linear(expert_width, expert_width, bias=False)

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draws fresh weights; `condition` is zero, so that the network is pi0.5 at first."""
        for name, parameter in self.named_parameters():
            if parameter.dim() == 1 or name.startswith("condition."):
                parameter.zero_()
            else:
                parameter.normal_(std=parameter.shape[1] ** -0.5, generator=generator)

    def forward(self, hidden_BTW: Tensor, is_real_BT: Tensor, first: int, expert: ActionExpert) -> Pointed:
        """Points in a prefix whose front picture's tokens begin at ``first`` and whose last token is the state.

        Without a front picture there is nothing to point at: its places are zero.
        """
        normed_BTW = self.norm(hidden_BTW.float())
        front_BSW = normed_BTW[:, first : first + self.num_patches]
        is_seen_B1S = is_real_BT[:, None, first : first + self.num_patches]
        scores_BQS = self.score(front_BSW).transpose(1, 2)
        shares_BQS = scores_BQS.masked_fill(~is_seen_B1S, torch.finfo(torch.float32).min).softmax(dim=-1) * is_seen_B1S
        places_BQW = shares_BQS @ front_BSW
        read_BE = self.read(torch.cat([places_BQW.flatten(1), normed_BTW[:, -1]], dim=-1))
        condition_BE = self.condition(nn.functional.silu(read_BE))
        return Pointed(scores=scores_BQS, styles=expert.style_shift(condition_BE))
