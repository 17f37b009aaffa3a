"""The laptop pair's head: it points at places in both pictures, and the expert acts on what is there.

Every token of the front picture is scored, as it enters the last language layer, where it has read text and cognition.
Under the softmax of the scores the tokens, as the vision tower sees them, have a mean: what is there, and where it is.
With the state it asks every token of the second camera's picture whether that place is there; one more score says that
it is out of view. Both means, and the state's token, are a vector that conditions all adaRMS norms of the expert beside
the flow time; a norm's style is linear in its condition, so the vector's share is added to styles that are tabulated.
With `condition` at zero, its initial value, the network is pi0.5 bit for bit. All of it is float32.

Where it is taught places, what it is taught is read instead of what it chose: the expert need not wait for the choice.

pi0.5 has no such head. A hand of a few million weights that has hours to learn in needs it (docs/decisions.md).
"""

# B batch, T prefix tokens, S tokens of a picture, Q places, P = Q or with a second camera 2 Q, W language width,
# E expert width, M norms, H hidden

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dual_system.models.pi05.gemma import ActionExpert, RmsNorm

_NEVER = torch.finfo(torch.float32).min
_HIDDEN = 256


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pointed:
    """What a pointer chose in one prefix, for all flow steps."""

    scores: Tensor
    """(B, P, S + 1): logits over the tokens of the front picture, row by row, for each place; then for each of them
    over those of the second camera's picture. The last logit says that it is out of view, which in front none is."""
    styles: Tensor
    """(M, 3, B, 1, E), to be added to the styles of the flow time."""

    def repeated(self, times: int) -> "Pointed":
        """As `PrefixCache.repeated`."""
        return Pointed(scores=self.scores.repeat(times, 1, 1), styles=self.styles.repeat(1, 1, times, 1, 1))


class Pointer(nn.Module):
    """Points at ``num_places`` places: at what is to be grasped or pressed, and at where it is to go."""

    def __init__(
        self, num_places: int, *, num_patches: int, width: int, expert_width: int, has_second_camera: bool
    ) -> None:
        super().__init__()
        self.num_patches = num_patches
        self.norm, self.seen_norm = RmsNorm(width), RmsNorm(width)
        self.score = nn.Linear(width, num_places, bias=False)
        self.ask = nn.Linear(2 * width, width, bias=False) if has_second_camera else None
        self.out_of_view = nn.Linear(2 * width, 1) if has_second_camera else None
        self.read = nn.Linear((num_places * (2 if has_second_camera else 1) + 1) * width, _HIDDEN)
        self.think = nn.Sequential(nn.SiLU(), nn.Linear(_HIDDEN, _HIDDEN), nn.SiLU(), nn.Linear(_HIDDEN, _HIDDEN))
        self.condition = nn.Linear(_HIDDEN, expert_width, bias=False)

    @torch.no_grad()
    def initialise(self, generator: torch.Generator) -> None:
        """Draws fresh weights; `condition` is zero, so that the network is pi0.5 at first."""
        for name, parameter in self.named_parameters():
            if parameter.dim() == 1 or name.startswith("condition."):
                parameter.zero_()
            else:
                parameter.normal_(std=parameter.shape[1] ** -0.5, generator=generator)

    def forward(
        self,
        embeds_BTW: Tensor,
        hidden_BTW: Tensor,
        is_real_BT: Tensor,
        first: int,
        expert: ActionExpert,
        taught_BP: Tensor | None = None,
    ) -> Pointed:
        """Points in a prefix, as embedded and as it enters the last layer, whose front picture's tokens begin at
        ``first`` and whose last token is the state.

        ``taught_BP``: tokens to read in place of the chosen ones; negative: the chosen ones. Without a front picture
        there is nothing to point at: its places are zero. Without a second one all is out of its view.
        """
        seen_BTW, normed_BTW = self.seen_norm(embeds_BTW.float()), self.norm(hidden_BTW.float())
        state_BW, num_places = seen_BTW[:, -1], self.score.out_features
        front = slice(first, first + self.num_patches)
        never_BQ1 = normed_BTW.new_full((len(normed_BTW), num_places, 1), _NEVER)
        scores_BQS = torch.cat([self.score(normed_BTW[:, front]).transpose(1, 2), never_BQ1], dim=-1)
        taught_BQ = None if taught_BP is None else taught_BP[:, :num_places]
        scores, places_BQW = [scores_BQS], _mean(scores_BQS, seen_BTW[:, front], is_real_BT[:, front], taught_BQ)
        read = [places_BQW.flatten(1), state_BW]
        if self.ask is not None and self.out_of_view is not None:
            second = slice(front.stop, front.stop + self.num_patches)
            asked_BQ2W = torch.cat([places_BQW, state_BW[:, None].expand_as(places_BQW)], dim=-1)
            found_BQS = self.ask(asked_BQ2W) @ normed_BTW[:, second].transpose(1, 2) / normed_BTW.shape[-1] ** 0.5
            scores.append(torch.cat([found_BQS, self.out_of_view(asked_BQ2W)], dim=-1))
            taught_BQ = None if taught_BP is None else taught_BP[:, num_places:]
            read.append(_mean(scores[-1], seen_BTW[:, second], is_real_BT[:, second], taught_BQ).flatten(1))
        read_BH = self.read(torch.cat(read, dim=-1))
        condition_BE = self.condition(nn.functional.silu(read_BH + self.think(read_BH)))
        return Pointed(scores=torch.cat(scores, dim=1), styles=expert.style_shift(condition_BE))


def _mean(scores_BQS: Tensor, tokens_BSW: Tensor, is_real_BS: Tensor, taught_BQ: Tensor | None) -> Tensor:
    """The mean (B, Q, W) of the tokens under the softmax of the scores, of which there is one more; or the token that
    is taught. Zero if unreal."""
    is_seen_B1S = is_real_BS[:, None]
    masked_BQS = torch.cat([scores_BQS[..., :-1].masked_fill(~is_seen_B1S, _NEVER), scores_BQS[..., -1:]], dim=-1)
    share_BQS = masked_BQS.softmax(dim=-1)
    if taught_BQ is not None:
        of_taught_BQS = nn.functional.one_hot(taught_BQ.clamp(min=0), share_BQS.shape[-1]).to(share_BQS.dtype)
        share_BQS = torch.where(taught_BQ[..., None] >= 0, of_taught_BQS, share_BQS)
    return (share_BQS[..., :-1] * is_seen_B1S) @ tokens_BSW
