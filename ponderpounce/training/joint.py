"""L = w1 L_fm + w2 L_ground: both systems in one graph (paper, 3.2).

PONDER reads every episode as one causal row, all queries in one pass. Every POUNCE invocation takes the cognition that
the schedule referred it to, so many invocations share one; their action loss reaches PONDER only through it, scaled
(A.3). The LM head runs only where a token is supervised.
"""

# B episodes, T tokens, H hidden, Q queries, I invocations of all episodes, K carriers, N horizon, A padded action dim

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ponderpounce.models.committed import draw_counts
from ponderpounce.models.context import Row
from ponderpounce.models.ponder import Ponder
from ponderpounce.models.pounce import PounceInputs
from ponderpounce.models.pounce_family import AnyPounce, action_loss
from ponderpounce.models.pounce_groot import GrootInputs

SampleTimes = Callable[[int, torch.Generator], Tensor]
"""Draws so many flow times."""

NO_QUERY = -1
"""Reference of an invocation for which no cognition was ready: it sees the learned null."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PonderBatch:
    """What PONDER reads of B episodes."""

    rows: tuple[Row, ...]
    frames: tuple[Tensor | None, ...]
    """Per row, (num_images, height, width, 3) uint8 in the order of its image positions; None without images."""

    def __post_init__(self) -> None:
        if len(self.rows) != len(self.frames):
            raise ValueError(f"{len(self.rows)} rows, frames for {len(self.frames)}")

    def to(self, device: torch.device | str) -> PonderBatch:
        return replace(self, frames=tuple(None if f is None else f.to(device) for f in self.frames))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PounceBatch:
    """I invocations of the same episodes, in any order."""

    inputs: PounceInputs | GrootInputs
    """Images, prompts and ages; its cognition is filled in by the model."""
    actions_INA: Tensor
    """Normalised targets, zero beyond the robot's dims."""
    episode_I: Tensor
    """int64: which row of the PonderBatch."""
    query_I: Tensor
    """int64: which query of that row, or NO_QUERY."""

    def to(self, device: torch.device | str) -> PounceBatch:
        moved: dict[str, Any] = {}
        for each in fields(self.inputs):
            value = getattr(self.inputs, each.name)
            moved[each.name] = None if value is None else value.to(device)
        return PounceBatch(
            inputs=type(self.inputs)(**moved),
            actions_INA=self.actions_INA.to(device),
            episode_I=self.episode_I.to(device),
            query_I=self.query_I.to(device),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Draws:
    """The chance in one step, drawn by one generator: a step repeats exactly, whatever ran before it."""

    noise_INA: Tensor
    time_I: Tensor
    is_dropped_I: Tensor
    """bool: cognition dropout."""
    num_committed_I: Tensor | None = None
    """int64: how many rows each chunk is given to continue; None: POUNCE does not learn to."""

    @property
    def num_counted_rows(self) -> int:
        """Rows under the action loss."""
        num_committed = 0 if self.num_committed_I is None else int(self.num_committed_I.sum())
        return self.noise_INA.shape[0] * self.noise_INA.shape[1] - num_committed

    @classmethod
    def draw(
        cls,
        batch: PounceBatch,
        times: SampleTimes,
        dropout: float,
        generators: Sequence[torch.Generator],
        *,
        max_committed_rows: int = 0,
    ) -> Draws:
        """One CPU generator for each episode: what is drawn for it depends on no other, nor on the device."""
        count, episode_I = len(batch.actions_INA), batch.episode_I.cpu()
        noise_INA, time_I, chance_I = torch.empty(batch.actions_INA.shape), torch.empty(count), torch.empty(count)
        committed_I = torch.zeros(count, dtype=torch.int64)
        for episode, generator in enumerate(generators):
            (mine,) = torch.where(episode_I == episode)
            noise_INA[mine] = torch.randn(len(mine), *noise_INA.shape[1:], generator=generator)
            time_I[mine] = times(len(mine), generator)
            chance_I[mine] = torch.rand(len(mine), generator=generator)
            if max_committed_rows:
                committed_I[mine] = draw_counts(len(mine), max_committed_rows, generator)
        device = batch.actions_INA.device
        return cls(
            noise_INA=noise_INA.to(device),
            time_I=time_I.to(device),
            is_dropped_I=(chance_I < dropout).to(device),
            num_committed_I=committed_I.to(device) if max_committed_rows else None,
        )


class JointLoss(NamedTuple):
    """The parts of one step's loss, scalars on the graph. A tuple: FSDP2 looks for its tensors."""

    total: Tensor
    flow_matching: Tensor
    grounding: Tensor
    said_N: Tensor
    """int64: at every token under the LM head's cross-entropy, row after row, the likeliest one instead."""
    num_null: int
    """Invocations that saw the null cognition."""
    num_rows: int
    """Rows of chunks that flow matching is the mean over: those that were not given."""

    @property
    def num_supervised(self) -> int:
        return len(self.said_N)


class JointModel(nn.Module):
    """PONDER and POUNCE as one module, with the weights of the two losses."""

    def __init__(self, ponder: Ponder, pounce: AnyPounce, *, w1: float = 1.0, w2: float = 0.1) -> None:
        """Raises ValueError if POUNCE was built for another cognition than PONDER gives."""
        super().__init__()
        wanted = (pounce.config.cognition.num_carriers, pounce.config.cognition.cognition_size)
        given = (ponder.format.num_carriers, ponder.hidden_size)
        if wanted != given and not pounce.config.reads_subgoal:
            raise ValueError(f"POUNCE reads (K, H) = {wanted}, PONDER gives {given}; build them for each other")
        self.ponder = ponder
        self.pounce = pounce
        self.w1, self.w2 = w1, w2

    def forward(self, episodes: PonderBatch, invocations: PounceBatch, draws: Draws) -> JointLoss:
        hidden = encode_rows(self.ponder, episodes)
        grounding, said_N = self._grounding(episodes, hidden)
        cognition_QKH, first_query = gather_cognition(episodes.rows, hidden)
        is_null_I = (invocations.query_I == NO_QUERY) | draws.is_dropped_I
        index_I = first_query[invocations.episode_I] + invocations.query_I.clamp(min=0)
        inputs = replace(invocations.inputs, cognition=cognition_QKH[index_I], is_null=is_null_I)
        matching = action_loss(
            self.pounce, inputs, invocations.actions_INA, draws.noise_INA, draws.time_I, draws.num_committed_I
        )
        return JointLoss(
            total=self.weigh(matching, grounding),
            flow_matching=matching,
            grounding=grounding,
            said_N=said_N,
            num_null=int(is_null_I.sum()),
            num_rows=draws.num_counted_rows,
        )

    def weigh(self, matching: Tensor, grounding: Tensor) -> Tensor:
        """L of its two parts."""
        return self.w1 * matching + self.w2 * grounding

    def _grounding(self, episodes: PonderBatch, hidden: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Mean cross-entropy over every supervised token of the batch; zero, on the graph, if there is none."""
        if self.w2 == 0:  # no annotations: the LM head is not even run
            return hidden[0].new_zeros(()), torch.zeros(0, dtype=torch.int64)
        read, wanted = [], []
        for row, hidden_TH in zip(episodes.rows, hidden, strict=True):
            index = torch.from_numpy(row.supervised_index).to(hidden_TH.device)
            read.append(hidden_TH[index])
            wanted.append(torch.tensor(row.targets, device=hidden_TH.device)[index + 1])
        targets_N = torch.cat(wanted)
        logits_NV = self.ponder.logits(torch.cat(read))
        said_N = logits_NV.detach().argmax(dim=-1)
        return F.cross_entropy(logits_NV.float(), targets_N) if len(targets_N) else logits_NV.sum(), said_N


def encode_rows(ponder: Ponder, episodes: PonderBatch) -> list[Tensor]:
    """Final hidden states (T, H) of each row, encoded together, padded on the right.

    A row is causal, so what stands behind it cannot reach it: pads are never read. All pictures are read in one call,
    however many rows there are: with FSDP2 every process must call the vision tower equally often.
    """
    frames = [each for each in episodes.frames if each is not None]
    ids = [token for row in episodes.rows for token in row.ids]
    embeds = ponder.embed(ids, torch.cat(frames) if frames else None).split([len(row.ids) for row in episodes.rows])
    longest = max(len(row.ids) for row in episodes.rows)
    embeds_BTH = torch.stack([F.pad(embed, (0, 0, 0, longest - len(embed))) for embed in embeds])
    positions = [torch.from_numpy(ponder.format.positions(row.ids)[0]).to(ponder.device) for row in episodes.rows]
    positions_4BT = torch.stack([F.pad(p, (0, longest - p.shape[1])) for p in positions], dim=1)
    hidden_BTH = ponder(embeds_BTH, positions_4BT)
    return [hidden[: len(row.ids)] for hidden, row in zip(hidden_BTH, episodes.rows, strict=True)]


def gather_cognition(rows: Sequence[Row], hidden: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Cognition of all queries of all rows, (Q, K, H), and the index of each row's first, (B,) int64."""
    device = hidden[0].device
    parts = [h[torch.from_numpy(row.carrier_index).to(device)] for row, h in zip(rows, hidden, strict=True)]
    starts = [0]
    for part in parts:
        starts.append(starts[-1] + len(part))
    if any(start == end for start, end in pairwise(starts)):
        raise ValueError("a row without a query gives no cognition; leave such an episode out")
    return torch.cat(parts), torch.tensor(starts[:-1], device=device)
