"""L = w1 L_fm + w2 L_ground: both systems in one graph (paper, 3.2).

PONDER reads every episode as one causal row, all queries in one pass. Every POUNCE invocation is conditioned on the
cognition that the schedule assigns to it, so many invocations share one; their action loss reaches PONDER only through
it, scaled (A.3). The LM head runs at supervised tokens only.

One system can be trained alone: PONDER on its texts; POUNCE on the cognition of a frozen PONDER or, without cognition
(K = 0), without PONDER. Dropout takes a frame memory away as it does cognition.
"""

# B episodes, T tokens, H hidden, Q queries, I invocations of all episodes, K carriers, N horizon, A padded action dim
# S flow samples: every invocation once, or the whole list of them several times

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
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
from dual_system.models.pi05.pounce import Pounce, PounceInputs
from dual_system.models.ponder.context import IGNORE, Row
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.family import AnyPounce, action_loss
from dual_system.training.memory_words import MemoryWords, num_wanted
from dual_system.training.own_text import Read, with_own_texts

Trains = Literal["both", "ponder", "pounce"]
"""The systems to train; the other's weights do not change."""

SampleTimes = Callable[[int, torch.Generator], Tensor]
"""Draws the given number of flow times."""

NO_QUERY = -1
"""Reference of an invocation for which no cognition was ready: it gets the learned null."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PonderBatch:
    """PONDER's inputs for B episodes."""

    rows: tuple[Row, ...] = ()
    """() if PONDER is not run. Episode by episode; a PONDER without memory has a row for every query, in order."""
    frames: tuple[Tensor | None, ...] = ()
    """Per row, (num_images, height, width, 3) uint8 in the order of its image positions, or their vision tokens
    (num_images, S, H) in half precision; None without images."""
    rows_per_episode: tuple[int, ...] = ()
    """Number of rows of each episode; () for one row each."""

    def __post_init__(self) -> None:
        if len(self.rows) != len(self.frames):
            raise ValueError(f"{len(self.rows)} rows, frames for {len(self.frames)}")
        if self.rows_per_episode and sum(self.rows_per_episode) != len(self.rows):
            raise ValueError(f"{len(self.rows)} rows, the episodes have {sum(self.rows_per_episode)}")

    @property
    def num_episodes(self) -> int:
        return len(self.rows_per_episode or self.rows)

    @property
    def first_row(self) -> list[int]:
        """Index of each episode's first row, and the number of rows."""
        return [0, *accumulate(self.rows_per_episode or (1,) * len(self.rows))]

    @property
    def first_query_B(self) -> Tensor:
        """int64: index of each episode's first query among the queries of all rows (`gather_cognition`)."""
        first_query = [0, *accumulate(len(row.carrier_index) for row in self.rows)]
        return torch.tensor([first_query[row] for row in self.first_row[:-1]])

    def part(self, begin: int, end: int) -> PonderBatch:
        """Episodes ``begin`` to ``end`` - 1."""
        if not self.rows:
            return self
        rows = slice(self.first_row[begin], self.first_row[end])
        return PonderBatch(
            rows=self.rows[rows], frames=self.frames[rows], rows_per_episode=self.rows_per_episode[begin:end]
        )

    def to(self, device: torch.device | str) -> PonderBatch:
        frames = iter(_moved([each for each in self.frames if each is not None], device))
        return replace(self, frames=tuple(None if each is None else next(frames) for each in self.frames))


def _moved(tensors: Sequence[Tensor], device: torch.device | str) -> Sequence[Tensor]:
    """Moves all tensors to the device in one transfer, which is faster than one transfer per row."""
    if not tensors or torch.device(device).type == "cpu":
        return tensors
    return torch.cat(list(tensors)).to(device).split([len(each) for each in tensors])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PounceBatch:
    """I invocations of the same episodes, in any order."""

    inputs: PounceInputs | GrootInputs
    """Images, prompts and ages; the model adds the cognition."""
    actions_INA: Tensor
    """Normalised targets, zero beyond the robot's dims."""
    episode_I: Tensor
    """int64: index of the episode in the PonderBatch."""
    query_I: Tensor
    """int64: query index in that episode, or NO_QUERY."""
    words_IL: Tensor | None = None
    """int64: the texts that a frame memory is taught (`memory_words`); None: it is taught none."""
    places_IQ: Tensor | None = None
    """int64: the patches that a pointer is taught (`pointed_places`), or `IGNORE`; None: it is taught none."""
    lessons: PounceBatch | None = None
    """Invocations of the same episodes that the pointer alone learns from (`pointed_places.lesson`)."""

    @property
    def num_episodes(self) -> int:
        """Number of episodes up to the last one with an invocation."""
        return 1 + int(self.episode_I.max())

    def part(self, begin: int, end: int) -> PounceBatch:
        """Invocations of the episodes ``begin`` to ``end`` - 1, which are numbered from 0 then. Padding stays.

        Raises ValueError if these episodes have no invocation.
        """
        is_here_I = (self.episode_I >= begin) & (self.episode_I < end)
        if not is_here_I.any():
            raise ValueError(f"episodes {begin} to {end - 1} of a batch have no invocation to learn from")
        found = self._each(lambda tensor: tensor[is_here_I])
        lessons = None if self.lessons is None else self.lessons.part(begin, end)
        return replace(found, episode_I=found.episode_I - begin, lessons=lessons)

    def pointing_tasks(self) -> Iterator[tuple[PounceInputs, Tensor]]:
        """What a pointer is taught, if it is: these invocations first, then the lessons."""
        for batch in (self, self.lessons):
            if batch is not None and batch.places_IQ is not None:
                yield cast(PounceInputs, batch.inputs), batch.places_IQ

    def to(self, device: torch.device | str) -> PounceBatch:
        lessons = None if self.lessons is None else self.lessons.to(device)
        return replace(self._each(lambda tensor: tensor.to(device)), lessons=lessons)

    def _each(self, change: Callable[[Tensor], Tensor]) -> PounceBatch:
        """The batch with every tensor but the lessons' changed."""
        inputs = {each.name: getattr(self.inputs, each.name) for each in fields(self.inputs)}
        changed: dict[str, Any] = {name: None if tensor is None else change(tensor) for name, tensor in inputs.items()}
        return PounceBatch(
            inputs=type(self.inputs)(**changed),
            actions_INA=change(self.actions_INA),
            episode_I=change(self.episode_I),
            query_I=change(self.query_I),
            words_IL=None if self.words_IL is None else change(self.words_IL),
            places_IQ=None if self.places_IQ is None else change(self.places_IQ),
            lessons=self.lessons,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Draws:
    """The random draws of one step, from generators of its own: a step repeats exactly, whatever ran before it."""

    noise_SNA: Tensor
    time_S: Tensor
    is_dropped_I: Tensor
    """bool: cognition dropout."""
    num_committed_S: Tensor | None = None
    """int64: number of committed rows of each chunk; None: training without committed rows."""

    @property
    def num_counted_rows(self) -> int:
        """Number of chunk rows that contribute to the action loss."""
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
        """Draws with one CPU generator per episode: an episode's draws depend on no other episode, nor on the device.

        ``num_samples`` flow samples of each invocation share one prefix, which is computed once.
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
    """The parts of one step's loss, scalars on the graph. A tuple, because FSDP2 must find its tensors."""

    total: Tensor
    flow_matching: Tensor
    grounding: Tensor
    predicted_N: Tensor
    """int64: PONDER's most likely token at every supervised position, row after row."""


class Counts(NamedTuple):
    """What a loss is the mean over."""

    num_rows: int
    """Number of chunk rows over which flow matching is the mean: those that are not committed."""
    num_supervised: int
    """Number of supervised tokens, over which grounding is the mean."""
    num_null: int
    """Number of invocations with null cognition."""


class JointModel(nn.Module):
    """PONDER and POUNCE as one module, with the weights of the losses."""

    def __init__(
        self,
        ponder: Ponder,
        pounce: AnyPounce,
        *,
        w1: float = 1.0,
        w2: float = 0.1,
        trains: Trains = "both",
        reads_together: bool = True,
        num_groups: int = 1,
        memory_words: MemoryWords | None = None,
    ) -> None:
        """``reads_together`` and ``num_groups`` are `encode_rows`'s ``together`` and ``num_groups``; ``memory_words``
        grounds POUNCE's frame memory.

        Raises ValueError if POUNCE was built for another (K, H) than PONDER's.
        """
        super().__init__()
        wanted = (pounce.config.cognition.num_carriers, pounce.config.cognition.cognition_size)
        given = (ponder.format.num_carriers, ponder.hidden_size)
        if wanted != given and wanted[0]:
            raise ValueError(f"POUNCE reads (K, H) = {wanted}, PONDER gives {given}; build them for each other")
        self.ponder = ponder
        self.pounce = pounce
        self.w1, self.w2 = w1, w2
        self.trains = trains
        self.reads_together, self.num_groups = reads_together, num_groups
        self.memory_words = memory_words
        for name, system in (("ponder", ponder), ("pounce", pounce)):
            if trains not in ("both", name):
                system.requires_grad_(False)

    @property
    def runs_ponder(self) -> bool:
        """Whether a step runs PONDER: to train it, or for POUNCE's cognition."""
        return runs_ponder(self.trains, self.pounce.config.cognition.num_carriers)

    def counts(self, episodes: PonderBatch, invocations: PounceBatch, draws: Draws) -> Counts:
        """What `forward`'s losses will be means over."""
        is_grounded, acts = self.trains != "pounce" and self.w2 != 0, self.trains != "ponder"
        num_supervised = sum(len(row.supervised_index) for row in episodes.rows) if is_grounded else 0
        if self.memory_words is not None and invocations.words_IL is not None:
            num_supervised += num_wanted(invocations.words_IL)
        num_supervised += sum(int((places_IQ != IGNORE).sum()) for _, places_IQ in invocations.pointing_tasks())
        return Counts(
            num_rows=draws.num_counted_rows if acts else 0,
            num_supervised=num_supervised,
            num_null=int(_is_null(invocations, draws).sum()) if acts else 0,
        )

    def forward(self, episodes: PonderBatch, invocations: PounceBatch, draws: Draws) -> JointLoss:
        zero = torch.zeros((), device=invocations.actions_INA.device)
        matching, grounding = zero, zero
        predicted_N = torch.zeros(0, dtype=torch.int64)
        cognition_IKH = None
        if self.runs_ponder:
            read = partial(_read, self.ponder, together=self.reads_together, num_groups=self.num_groups)
            with torch.set_grad_enabled(self.trains != "pounce"):
                embeds = embed_rows(self.ponder, episodes)
                hidden = read([row.ids for row in episodes.rows], embeds)
                if self.trains != "ponder":
                    first_I = episodes.first_query_B.to(zero.device)[invocations.episode_I]
                    index_I = first_I + invocations.query_I.clamp(min=0)
                    cognition_IKH = cognition_of(self.ponder, episodes.rows, embeds, hidden, index_I, read)
            if self.trains != "pounce":
                grounding, predicted_N = self._grounding(episodes, hidden)
        if self.trains != "ponder":
            inputs = invocations.inputs
            if cognition_IKH is not None:
                inputs = replace(inputs, cognition=cognition_IKH, is_null=_is_null(invocations, draws))
            if isinstance(inputs, PounceInputs):
                inputs = inputs.forgetting(draws.is_dropped_I)
                if self.memory_words is not None and invocations.words_IL is not None:
                    inputs, memory_ISE, visible_IS = cast(Pounce, self.pounce).looked_back(inputs)
                    logits_NV, targets_N = self.memory_words(memory_ISE, visible_IS, invocations.words_IL)
                    grounding = _mean_cross_entropy(logits_NV, targets_N)
                if invocations.places_IQ is not None:
                    inputs, grounding = _pointing(cast(Pounce, self.pounce), replace(invocations, inputs=inputs))
            matching = action_loss(
                self.pounce, inputs, invocations.actions_INA, draws.noise_SNA, draws.time_S, draws.num_committed_S
            )
        return JointLoss(self.weigh(matching, grounding), matching, grounding, predicted_N=predicted_N)

    def weigh(self, matching: Tensor, grounding: Tensor) -> Tensor:
        """Returns L, the weighted sum of its parts."""
        return self.w1 * matching + self.w2 * grounding

    def _grounding(self, episodes: PonderBatch, hidden: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Mean cross-entropy over every supervised token of the batch; zero, on the graph, if there is none."""
        if self.w2 == 0:  # no annotations: skip the LM head
            return hidden[0].new_zeros(()), torch.zeros(0, dtype=torch.int64)
        index = [row.supervised_index for row in episodes.rows]
        wanted = [np.asarray(row.targets)[places + 1] for row, places in zip(episodes.rows, index, strict=True)]
        targets_N = torch.from_numpy(np.concatenate(wanted)).to(hidden[0].device)
        logits_NV = self.ponder.logits(_taken(hidden, index))
        predicted_N = logits_NV.detach().argmax(dim=-1)
        return _mean_cross_entropy(logits_NV, targets_N), predicted_N


def _pointing(pounce: Pounce, invocations: PounceBatch) -> tuple[PounceInputs, Tensor]:
    """The invocations' inputs, their prefix filled in, and the loss of the places that they and their lessons teach."""
    read, scores, targets = [], [], []
    for inputs, places_IQ in invocations.pointing_tasks():
        filled, scores_IQS = pounce.pointing(inputs, places_IQ)
        is_known_IQ = places_IQ != IGNORE
        read.append(filled)
        scores.append(scores_IQS[is_known_IQ])
        targets.append(places_IQ[is_known_IQ])
    return read[0], _mean_cross_entropy(torch.cat(scores), torch.cat(targets))


def _mean_cross_entropy(logits_NV: Tensor, targets_N: Tensor) -> Tensor:
    """Zero, on the graph, if there is no target."""
    return F.cross_entropy(logits_NV.float(), targets_N) if len(targets_N) else logits_NV.sum()


def _is_null(invocations: PounceBatch, draws: Draws) -> Tensor:
    """(I,) bool: invocations that get the learned null."""
    return (invocations.query_I == NO_QUERY) | draws.is_dropped_I


def runs_ponder(trains: Trains, num_carriers: int) -> bool:
    """Whether a step runs PONDER: always, except when POUNCE without cognition (K = 0) is trained alone."""
    return trains != "pounce" or num_carriers > 0


def _taken(hidden: Sequence[Tensor], index: Sequence[NDArray[np.integer]]) -> Tensor:
    """Hidden states (N, H) at each row's positions. One look-up for all rows, because on a GPU each costs a dozen
    kernel launches in the backward pass."""
    places = [begin + each.reshape(-1) for begin, each in zip(_begins(hidden), index, strict=True)]
    return torch.cat(list(hidden))[torch.from_numpy(np.concatenate(places)).to(hidden[0].device)]


def _begins(parts: Sequence[Tensor]) -> list[int]:
    return [0, *accumulate(len(part) for part in parts)][:-1]


def encode_rows(ponder: Ponder, episodes: PonderBatch, *, together: bool = True, num_groups: int = 1) -> list[Tensor]:
    """Final hidden states (T, H) of each row. The images of all rows are encoded in one call.

    With ``together`` the rows are one batch, padded on the right, where padding cannot affect a causal row. FSDP2 needs
    it: every process must call every layer equally often. One call per row is cheaper on a CPU: no padding, and fewer
    activations alive at once (`benchmarks.training_throughput`). ``num_groups`` is the middle way: batches of rows of
    similar length (at most one per row), with less padding and more calls.
    """
    ids = [row.ids for row in episodes.rows]
    return _read(ponder, ids, embed_rows(ponder, episodes), together=together, num_groups=num_groups)


def embed_rows(ponder: Ponder, episodes: PonderBatch) -> list[Tensor]:
    """Input embeddings (T, H) of each row."""
    frames = [each for each in episodes.frames if each is not None]
    ids = np.concatenate([row.ids for row in episodes.rows])
    images = torch.cat(frames) if frames else None
    look = _as_stored if images is not None and images.is_floating_point() else None
    embeds = ponder.embed(ids, images, look)
    return list(embeds.split([len(row.ids) for row in episodes.rows]))


def _as_stored(tokens_NSH: Tensor) -> Tensor:
    """Vision tokens (N S, H) that were computed before (`frozen_towers`)."""
    return tokens_NSH.flatten(0, 1)


def _read(
    ponder: Ponder, ids: Sequence[Sequence[int]], embeds: Sequence[Tensor], *, together: bool, num_groups: int
) -> list[Tensor]:
    """`encode_rows` of rows that are embedded already."""
    lengths = [len(each) for each in ids]
    positions = [ponder.format.positions(each)[0] for each in ids]
    if not together and ponder.format.remembers:  # a query's rows are short and alike: padding is cheaper than calls
        return [
            ponder(embed[None], torch.from_numpy(each)[:, None].to(ponder.device))[0]
            for embed, each in zip(embeds, positions, strict=True)
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
        hidden_BTH = ponder(embeds_BTH, torch.from_numpy(positions_4BT).to(ponder.device))
        index = torch.from_numpy(np.flatnonzero(is_token_BT)).to(ponder.device)
        parts = hidden_BTH.flatten(0, 1)[index].split([lengths[row] for row in group])
        found |= dict(zip(group.tolist(), parts, strict=True))
    return [found[row] for row in range(len(lengths))]


def gather_cognition(rows: Sequence[Row], hidden: Sequence[Tensor]) -> Tensor:
    """Cognition of all queries of all rows, (Q, K, H)."""
    index = [row.carrier_index for row in rows]
    if 0 in [len(each) for each in index]:
        raise ValueError("a row without a query gives no cognition; leave such an episode out")
    return _taken(hidden, index).unflatten(0, (-1, index[0].shape[1]))


def cognition_of(
    ponder: Ponder, rows: Sequence[Row], embeds: Sequence[Tensor], hidden: Sequence[Tensor], index_I: Tensor, read: Read
) -> Tensor:
    """Cognition (I, K, H) of the given queries of all rows, as PONDER is trained on it.

    A PONDER that remembers reads the recorded texts before its carriers (teacher forcing). One without memory reads
    what it writes itself, because a recorded text may tell what only the past showed (`own_text`).
    """
    if ponder.format.remembers or not ponder.format.speaks:
        return gather_cognition(rows, hidden)[index_I]
    places, place_I = index_I.unique(return_inverse=True)  # a row has one query: their indices are the same
    asked = places.tolist()
    chosen, chosen_embeds, chosen_hidden = ([each[place] for place in asked] for each in (rows, embeds, hidden))
    own, own_embeds = with_own_texts(ponder, chosen, chosen_embeds, chosen_hidden, read)
    return gather_cognition(own, read([row.ids for row in own], own_embeds))[place_I]


def read_cognition(ponder: Ponder, episodes: PonderBatch) -> Tensor:
    """Cognition (Q, K, H) of all queries of all rows, as in training."""
    read = partial(_read, ponder, together=True, num_groups=1)
    embeds = embed_rows(ponder, episodes)
    hidden = read([row.ids for row in episodes.rows], embeds)
    every = torch.arange(sum(len(row.carrier_index) for row in episodes.rows), device=ponder.device)
    return cognition_of(ponder, episodes.rows, embeds, hidden, every, read)
