"""L = w1 L_fm + w2 L_ground: both systems in one graph (paper, 3.2).

PONDER reads every episode as one causal row, all queries in one pass. Every POUNCE invocation takes the cognition that
the schedule referred it to, so many invocations share one; their action loss reaches PONDER only through it, scaled
(A.3). The LM head runs only where a token is supervised.

What stands in for pretraining, where networks start from nothing, runs through the same graph with one system left out:
POUNCE alone acts from the stand-in cognition (``stand_in``), PONDER alone learns its words and, by auxiliary losses
that are off otherwise, to carry the stand-in (w3 L_align) and to have places in mind (w4 L_place, ``place_lessons``).
"""

# B episodes, T tokens, H hidden, Q queries, I invocations of all episodes, K carriers, N horizon, A padded action dim
# S flow samples: every invocation once, or the whole list of them several times over

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields, replace
from itertools import accumulate
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from dual_system.models.groot.pounce import GrootInputs
from dual_system.models.pi05.committed import draw_counts
from dual_system.models.pi05.pounce import PounceInputs
from dual_system.models.ponder.context import Row
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.family import AnyPounce, action_loss
from dual_system.models.reader import Reader
from dual_system.models.reader_file import Narrowing, as_stored, confine
from dual_system.models.specialty import Specialty
from dual_system.training.place_lessons import PlaceLessons
from dual_system.training.stand_in import number_weights

Trains = Literal["both", "ponder", "pounce"]
"""Which systems a stage trains. The other one is not even run."""

SampleTimes = Callable[[int, torch.Generator], Tensor]
"""Draws so many flow times."""

NO_QUERY = -1
"""Reference of an invocation for which no cognition was ready: it sees the learned null."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PonderBatch:
    """What PONDER reads of B episodes, or what stands in for it."""

    rows: tuple[Row, ...] = ()
    """() in a stage without PONDER."""
    frames: tuple[Tensor | None, ...] = ()
    """Per row, (num_images, height, width, 3) uint8 in the order of its image positions; None without images."""
    stand_ins: tuple[Tensor, ...] = ()
    """Per row, (its queries, H): `stand_in` of the subgoal in force; () where no stage asks for them."""
    stand_in_weights: tuple[Tensor, ...] = ()
    """Per row, (its queries,): how much alignment with each counts; () for one each."""
    place_lessons: tuple[PlaceLessons, ...] = ()
    """Per row; () where no stage asks for them."""

    def __post_init__(self) -> None:
        if len(self.rows) != len(self.frames):
            raise ValueError(f"{len(self.rows)} rows, frames for {len(self.frames)}")
        if self.stand_ins and self.rows and len(self.stand_ins) != len(self.rows):
            raise ValueError(f"{len(self.rows)} rows, stand-ins for {len(self.stand_ins)}")

    @property
    def num_episodes(self) -> int:
        return len(self.rows or self.stand_ins)

    def to(self, device: torch.device | str) -> PonderBatch:
        frames = iter(_moved([each for each in self.frames if each is not None], device))
        lessons = zip(*(_moved(column, device) for column in zip(*self.place_lessons, strict=True)), strict=True)
        return replace(
            self,
            frames=tuple(None if each is None else next(frames) for each in self.frames),
            stand_ins=tuple(_moved(self.stand_ins, device)),
            stand_in_weights=tuple(_moved(self.stand_in_weights, device)),
            place_lessons=tuple(PlaceLessons(*each) for each in lessons),
        )


def _moved(tensors: Sequence[Tensor], device: torch.device | str) -> Sequence[Tensor]:
    """All of them on the device: each transfer to a GPU waits for the one before, and rows are many."""
    if not tensors or torch.device(device).type == "cpu":
        return tensors
    return torch.cat(list(tensors)).to(device).split([len(each) for each in tensors])


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

    noise_SNA: Tensor
    time_S: Tensor
    is_dropped_I: Tensor
    """bool: cognition dropout."""
    num_committed_S: Tensor | None = None
    """int64: how many rows each chunk is given to continue; None: POUNCE does not learn to."""

    @property
    def num_counted_rows(self) -> int:
        """Rows under the action loss."""
        num_committed = 0 if self.num_committed_S is None else int(self.num_committed_S.sum())
        return self.noise_SNA.shape[0] * self.noise_SNA.shape[1] - num_committed

    @classmethod
    def draw(
        cls,
        batch: PounceBatch,
        times: SampleTimes,
        dropout: float,
        generators: Sequence[torch.Generator],
        *,
        num_samples: int = 1,
        max_committed_rows: int = 0,
    ) -> Draws:
        """One CPU generator for each episode: what is drawn for it depends on no other, nor on the device.

        ``num_samples`` flow samples of each invocation share what POUNCE reads, which is then computed once.
        """
        count, episode_I = len(batch.actions_INA), batch.episode_I.cpu()
        noise_DINA = torch.empty(num_samples, *batch.actions_INA.shape)
        time_DI, chance_I = torch.empty(num_samples, count), torch.empty(count)
        committed_DI = torch.zeros(num_samples, count, dtype=torch.int64)
        for episode, generator in enumerate(generators):
            (mine,) = torch.where(episode_I == episode)
            for sample in range(num_samples):
                noise_DINA[sample, mine] = torch.randn(len(mine), *noise_DINA.shape[2:], generator=generator)
                time_DI[sample, mine] = times(len(mine), generator)
            chance_I[mine] = torch.rand(len(mine), generator=generator)
            if max_committed_rows:
                for sample in range(num_samples):
                    committed_DI[sample, mine] = draw_counts(len(mine), max_committed_rows, generator)
        device = batch.actions_INA.device
        return cls(
            noise_SNA=noise_DINA.flatten(0, 1).to(device),
            time_S=time_DI.flatten().to(device),
            is_dropped_I=(chance_I < dropout).to(device),
            num_committed_S=committed_DI.flatten().to(device) if max_committed_rows else None,
        )


class JointLoss(NamedTuple):
    """The parts of one step's loss, scalars on the graph. A tuple: FSDP2 looks for its tensors."""

    total: Tensor
    flow_matching: Tensor
    grounding: Tensor
    alignment: Tensor
    """Mean squared distance of C from the stand-ins, each times its weights; 0 unless w3 is set."""
    placing: Tensor
    """Mean squared error of places that PONDER has in mind; 0 unless w4 is set."""
    said_N: Tensor
    """int64: at every token under the LM head's cross-entropy, row after row, the likeliest one instead."""
    num_null: int
    """Invocations that saw the null cognition."""
    num_rows: int
    """Rows of chunks that flow matching is the mean over: those that were not given."""
    num_queries: int
    """What alignment is the mean over."""
    num_placed: int
    """What placing is the mean over."""

    @property
    def num_supervised(self) -> int:
        return len(self.said_N)


class JointModel(nn.Module):
    """PONDER and POUNCE as one module, with the weights of the losses."""

    def __init__(
        self,
        ponder: Ponder,
        pounce: AnyPounce,
        *,
        w1: float = 1.0,
        w2: float = 0.1,
        w3: float = 0.0,
        w4: float = 0.0,
        aligns_evenly: bool = False,
        trains: Trains = "both",
        keeps_eyes: bool = False,
        reads_apart: bool = False,
        specialty: Specialty | None = None,
        narrowing: Narrowing | None = None,
        reads_together: bool = True,
        num_groups: int = 1,
    ) -> None:
        """With ``keeps_eyes`` PONDER's vision tower stays as it is, with ``reads_apart`` all of it but a `Reader` of
        demonstrations, with a ``specialty`` all but this specialist, whose all rows are then; PONDER is given one if it
        has none, and it learns as what ``narrowing`` would store. ``reads_together`` and ``num_groups`` are
        `encode_rows`'s; ``aligns_evenly``: numbers of C count as `number_weights` says.

        Raises ValueError if POUNCE was built for another cognition than PONDER gives.
        """
        super().__init__()
        wanted = (pounce.config.cognition.num_carriers, pounce.config.cognition.cognition_size)
        given = (ponder.format.num_carriers, ponder.hidden_size)
        if wanted != given and not pounce.config.reads_subgoal:
            raise ValueError(f"POUNCE reads (K, H) = {wanted}, PONDER gives {given}; build them for each other")
        self.ponder = ponder
        self.pounce = pounce
        self.w1, self.w2, self.w3, self.w4 = w1, w2, w3, w4
        self._column_weights_H = torch.from_numpy(number_weights(ponder.hidden_size, evenly=aligns_evenly))
        self.trains = trains
        self.reads_together, self.num_groups = reads_together, num_groups
        self._narrowing = narrowing
        for name, system in (("ponder", ponder), ("pounce", pounce)):
            if trains not in ("both", name):
                system.requires_grad_(False)
        ponder.specialists.requires_grad_(False)
        self._reads_apart, self._specialty = reads_apart, specialty
        if specialty is not None and specialty not in ponder.format.specialties:
            ponder.add_specialist(specialty)
        if reads_apart and ponder.reader is None:
            ponder.add_reader()
        if (learner := self._learner) is not None:
            ponder.requires_grad_(False)
            learner.requires_grad_(True)
            if narrowing is not None:
                confine(learner, ponder.qwen.model.language_model, narrowing)
        if keeps_eyes:
            ponder.qwen.model.visual.requires_grad_(False)

    @property
    def needs_stand_ins(self) -> bool:
        return self.w3 > 0 or self.trains == "pounce"

    def forward(self, episodes: PonderBatch, invocations: PounceBatch, draws: Draws) -> JointLoss:
        if self.needs_stand_ins and not episodes.stand_ins:
            raise ValueError("this stage needs the stand-ins of every row; the batch has none")
        if self.w4 > 0 and not episodes.place_lessons:
            raise ValueError("this stage needs the place lessons of every row; the batch has none")
        device = invocations.actions_INA.device
        zero = torch.zeros((), device=device)
        matching, grounding, alignment, placing = zero, zero, zero, zero
        num_placed = 0
        said_N = torch.zeros(0, dtype=torch.int64)
        num_null = 0
        if self.trains == "pounce":
            cognition_QKH = torch.cat(episodes.stand_ins)[:, None].expand(-1, self.ponder.format.num_carriers, -1)
            first_query = _starts([len(each) for each in episodes.stand_ins], device)
        else:
            with self._as_stored():
                hidden = encode_rows(
                    self.ponder,
                    episodes,
                    together=self.reads_together,
                    num_groups=self.num_groups,
                    specialist=self._specialist,
                )
            grounding, said_N = self._grounding(episodes, hidden)
            cognition_QKH, first_query = gather_cognition(episodes.rows, hidden)
            if self.w3 > 0:
                wanted_QKH = torch.cat(episodes.stand_ins)[:, None].expand_as(cognition_QKH)
                errors_QKH = (cognition_QKH.float() - wanted_QKH).square()
                errors_Q = (errors_QKH * self._column_weights_H.to(device)).mean(dim=(1, 2))
                weights = episodes.stand_in_weights
                alignment = (errors_Q * torch.cat(weights) if weights else errors_Q).mean()
            if self.w4 > 0:
                placing, num_placed = _placing(episodes.place_lessons, hidden)
        if self.trains != "ponder":
            is_null_I = (invocations.query_I == NO_QUERY) | draws.is_dropped_I
            num_null = int(is_null_I.sum())
            index_I = first_query[invocations.episode_I] + invocations.query_I.clamp(min=0)
            inputs = replace(invocations.inputs, cognition=cognition_QKH[index_I], is_null=is_null_I)
            matching = action_loss(
                self.pounce, inputs, invocations.actions_INA, draws.noise_SNA, draws.time_S, draws.num_committed_S
            )
        return JointLoss(
            total=self.weigh(matching, grounding, alignment, placing),
            flow_matching=matching,
            grounding=grounding,
            alignment=alignment,
            placing=placing,
            said_N=said_N,
            num_rows=draws.num_counted_rows if self.trains != "ponder" else 0,
            num_queries=len(cognition_QKH),
            num_placed=num_placed,
            num_null=num_null,
        )

    def _as_stored(self) -> AbstractContextManager[None]:
        learner = self._learner
        if learner is None or self._narrowing is None:
            return nullcontext()
        return as_stored(learner, self.ponder.qwen.model.language_model, self._narrowing)

    @property
    def _specialist(self) -> Reader | None:
        """Whose all rows are; None: everybody's."""
        return None if self._specialty is None else cast(Reader, self.ponder.specialists[self._specialty.name])

    @property
    def _learner(self) -> Reader | None:
        """Who learns alone, if anybody does."""
        return self.ponder.reader if self._reads_apart else self._specialist

    def weigh(self, matching: Tensor, grounding: Tensor, alignment: Tensor, placing: Tensor) -> Tensor:
        """L of its parts."""
        return self.w1 * matching + self.w2 * grounding + self.w3 * alignment + self.w4 * placing

    def _grounding(self, episodes: PonderBatch, hidden: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Mean cross-entropy over every supervised token of the batch; zero, on the graph, if there is none."""
        if self.w2 == 0:  # no annotations: the LM head is not even run
            return hidden[0].new_zeros(()), torch.zeros(0, dtype=torch.int64)
        index = [row.supervised_index for row in episodes.rows]
        wanted = [np.asarray(row.targets)[places + 1] for row, places in zip(episodes.rows, index, strict=True)]
        targets_N = torch.from_numpy(np.concatenate(wanted)).to(hidden[0].device)
        logits_NV = self.ponder.logits(_taken(hidden, index))
        said_N = logits_NV.detach().argmax(dim=-1)
        return F.cross_entropy(logits_NV.float(), targets_N) if len(targets_N) else logits_NV.sum(), said_N


def _placing(lessons: Sequence[PlaceLessons], hidden: Sequence[Tensor]) -> tuple[Tensor, int]:
    """The loss over all lessons of all rows, and how many there were; zero, on the graph, without any."""
    index_M, first_M = (torch.cat(column) for column in ([each[n] for each in lessons] for n in range(2)))
    counts = torch.tensor([len(each.index_M) for each in lessons])
    starts_M = torch.tensor(_begins(hidden)).repeat_interleave(counts).to(index_M.device)
    all_lessons = PlaceLessons(index_M + starts_M, first_M, torch.cat([each.features_MP for each in lessons]))
    answers_MP = all_lessons.answers(torch.cat(list(hidden))).float()
    if not len(answers_MP):
        return answers_MP.sum(), 0
    return F.mse_loss(answers_MP, all_lessons.features_MP), len(answers_MP)


def _taken(hidden: Sequence[Tensor], index: Sequence[NDArray[np.integer]]) -> Tensor:
    """(N, H) of all rows: of each the hidden states at these positions. One look-up: on a GPU each costs a dozen
    launches on the way back."""
    places = [begin + each.reshape(-1) for begin, each in zip(_begins(hidden), index, strict=True)]
    return torch.cat(list(hidden))[torch.from_numpy(np.concatenate(places)).to(hidden[0].device)]


def _begins(parts: Sequence[Tensor]) -> list[int]:
    return [0, *accumulate(len(part) for part in parts)][:-1]


def encode_rows(
    ponder: Ponder,
    episodes: PonderBatch,
    *,
    together: bool = True,
    num_groups: int = 1,
    specialist: Reader | None = None,
) -> list[Tensor]:
    """Final hidden states (T, H) of each row, which are all a ``specialist``'s if one is given.

    All pictures are read in one call, however many rows there are. Rows are read ``together``, padded on the right: a
    row is causal, so what stands behind it cannot reach it and pads are never read. With FSDP2 it has to be so: every
    process must call every layer equally often. One after the other they cost a CPU less: no pads, and what a layer
    leaves for the way back stays small (`benchmarks.training_throughput`). Between the two, rows of like length go
    together, in ``num_groups`` (or as many as there are rows): fewer pads for more calls.
    """
    frames = [each for each in episodes.frames if each is not None]
    ids = np.concatenate([row.ids for row in episodes.rows])
    lengths = [len(row.ids) for row in episodes.rows]
    embeds = ponder.embed(ids, torch.cat(frames) if frames else None).split(lengths)
    positions = [ponder.format.positions(row.ids)[0] for row in episodes.rows]
    num_shown = [row.num_shown for row in episodes.rows]
    if not together:
        return [
            ponder(embed[None], torch.from_numpy(each)[:, None].to(ponder.device), [shown], specialist)[0]
            for embed, each, shown in zip(embeds, positions, num_shown, strict=True)
        ]
    by_length = np.argsort(lengths, kind="stable")
    found: dict[int, Tensor] = {}
    for group in np.array_split(by_length, min(num_groups, len(by_length))):
        longest = lengths[group[-1]]
        positions_4BT = np.zeros((4, len(group), longest), np.int64)
        is_token_BT = np.arange(longest) < np.array(lengths)[group, None]
        for place, row in enumerate(group):
            positions_4BT[:, place, : lengths[row]] = positions[row]
        embeds_BTH = pad_sequence([embeds[row] for row in group], batch_first=True)
        shown_B = [num_shown[row] for row in group]
        hidden_BTH = ponder(embeds_BTH, torch.from_numpy(positions_4BT).to(ponder.device), shown_B, specialist)
        index = torch.from_numpy(np.flatnonzero(is_token_BT)).to(ponder.device)
        parts = hidden_BTH.flatten(0, 1)[index].split([lengths[row] for row in group])
        found |= dict(zip(group.tolist(), parts, strict=True))
    return [found[row] for row in range(len(lengths))]


def gather_cognition(rows: Sequence[Row], hidden: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Cognition of all queries of all rows, (Q, K, H), and the index of each row's first, (B,) int64."""
    device = hidden[0].device
    index = [row.carrier_index for row in rows]
    cognition_QKH = _taken(hidden, index).unflatten(0, (-1, index[0].shape[1]))
    return cognition_QKH, _starts([len(each) for each in index], device)


def _starts(counts: Sequence[int], device: torch.device) -> Tensor:
    """Where each row's queries begin among those of all rows, (B,) int64."""
    if 0 in counts:
        raise ValueError("a row without a query gives no cognition; leave such an episode out")
    return torch.tensor([0, *accumulate(counts)][:-1], device=device)
