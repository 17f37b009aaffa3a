"""An episode as one row of tokens: what PONDER reads, in which order, and where the LM head is supervised.

The row is built from segments, and only ever grows: training concatenates them, serving appends them one by
one, and both get them from here (the official chat template rewrites earlier turns, so it cannot be used).
One episode is

    <|im_start|>user\\n Ins [demo frames, 1 Hz] <|im_end|>\\n<|im_start|>assistant\\n     once, at opening
    O_t  [ T_yes S_t | T_yes DR T_yes S_t ]  K carriers                               per query t

where a frame is ``<|vision_start|> <|image_pad|> * n <|vision_end|>`` (n = 64 at 256 px), one per view or, where a
PONDER has ``eyes``, one per eye; where it has ``proprioception``, O_t ends with tokens of the robot's state. One that
``takes_notes`` may write ``T_yes`` and words after every frame of the demonstration, too.
**T_no is never in the row.** It is only the LM *target* at the first carrier position (paper, appendix A.2), so T_t is
always decided by the logits of the token before: the last one of O_t, or the last one of the text. Carriers are rows
of the embedding table that no real token uses; their ids are ordinary ids.

A target belongs to the position it labels: the logits that must predict ``targets[i]`` are those of position
i - 1.

Pure: integers in, integers out. # T tokens of a row, K carriers, Q queries
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from dual_system.models.counsel import Counsel
from dual_system.models.eyes import Eyes, num_seen
from dual_system.models.ponder.showing import AS_IN_THE_PAPER, Showing
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.proprioception import Proprioception, check_rows
from dual_system.models.second_look import SecondLook
from dual_system.models.specialty import Specialty, check_specialties

IGNORE = -100
"""Target of a position that is not supervised (the ignore index of torch's cross-entropy)."""


class SegmentKind(StrEnum):
    INSTRUCTION = "instruction"
    DEMO = "demo"
    EXECUTION = "execution"  # the header after which observations begin
    OBSERVATION = "observation"
    TEXT = "text"  # T_yes and what it opens
    CARRIERS = "carriers"


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """Consecutive tokens of one kind. ``ids`` and ``targets`` have the same length."""

    kind: SegmentKind
    ids: tuple[int, ...]
    targets: tuple[int, ...]
    num_images: int = 0

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True, kw_only=True)
class Transition:
    """Text of one transition query, as token ids; ``reasoning`` (DR) only at the first of a demo episode."""

    subgoal: tuple[int, ...]
    reasoning: tuple[int, ...] | None = None
    is_learned: bool = True
    """False: words that stand there to be read, as a slip of PONDER's own would; that there are any is learned."""
    is_due: bool = True
    """False: there should be none, and that is learned: the label of T_yes is T_no."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Row:
    """Segments laid end to end: one causal training row, or the contents of a serving session."""

    ids: tuple[int, ...]
    targets: tuple[int, ...]
    carrier_index: npt.NDArray[np.int64]
    """(Q, K): where each query's carriers are; their final hidden states are C_t."""
    gate_index: npt.NDArray[np.int64]
    """(Q,): the last token of each query's observation; its logits say whether text comes."""
    num_images: int
    num_shown: int = 0
    """Of a row with a demonstration, its tokens up to the end of the first query: what a `Reader` reads; else 0."""

    @property
    def supervised_index(self) -> npt.NDArray[np.int64]:
        """Positions whose logits predict the targets (one before each): run the LM head only here."""
        return np.flatnonzero(np.asarray(self.targets) != IGNORE) - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ContextFormat:
    """Builds segments for one vocabulary, one way of seeing and K carriers."""

    vocabulary: Vocabulary
    num_carriers: int
    first_carrier_id: int
    image_grid: tuple[int, int]
    """Tokens of one image as (rows, columns): (8, 8) for 256 px, patch 16, merge 2."""
    token_px: int = 32
    """Side in pixels of what one image token covers: patch times merge."""
    fovea: tuple[int, int, int, int] | None = None
    """First row, first column, rows and columns of ``image_grid`` whose tokens come first, at the positions of an image
    of that size; the others come behind them, around these positions: what an eye that was widened (`wide_eyes`) saw
    before stands where it stood. None: row by row, as Qwen3.5 reads an image."""
    eyes: Eyes = None
    """What is seen of an instant's views: how many images it gives, and with ``image_px`` which pixels."""
    proprioception: Proprioception | None = None
    """What is told of the robot's state besides; None: nothing, as in the paper."""
    speaks: bool = True
    """False: trained without words (RoboCasa-DC), its LM head on nothing. Serving then asks it for none."""
    takes_notes: bool = False
    """True: after every instant of a demonstration it may write, as at a query, and ``T_yes`` and its words stay in
    the row. The paper's only watches."""
    second_look: SecondLook | None = None
    """When serving looks again for what it has said (`second_look`); None: never, as in the paper."""
    counsel: Counsel | None = None
    """In which other views serving reads an episode as well (`counsel`); None: in none, as in the paper."""
    demonstrations: Showing = AS_IN_THE_PAPER
    """How they were shown to it; whoever serves it shows them so."""
    specialties: tuple[Specialty, ...] = ()
    """Which episodes have weights of their own (`specialty`); () as in the paper."""

    def __post_init__(self) -> None:
        check_specialties(self.specialties)
        if self.counsel is not None:
            self.counsel.text_px(self.eyes, self.image_px)  # words and pictures must move together
        if not 1 <= self.num_carriers <= 16:
            raise ValueError(f"num_carriers is {self.num_carriers}; K must be 1..16 (the paper uses 1).")
        if self.first_carrier_id < self.vocabulary.num_tokens:
            raise ValueError(
                f"first_carrier_id {self.first_carrier_id} is a real token; this tokenizer's unused rows "
                f"start at {self.vocabulary.num_tokens}."
            )
        if self.proprioception is not None:
            check_rows(self.proprioception, self.vocabulary.num_tokens, self.carrier_ids)
        if self.fovea is not None:
            row, column, rows, columns = self.fovea
            if not (
                0 <= row < row + rows <= self.image_grid[0] and 0 <= column < column + columns <= self.image_grid[1]
            ):
                raise ValueError(
                    f"fovea {self.fovea} (row, column, rows, columns) must lie within the image grid {self.image_grid}"
                )

    @property
    def carrier_ids(self) -> tuple[int, ...]:
        return tuple(range(self.first_carrier_id, self.first_carrier_id + self.num_carriers))

    @property
    def num_image_tokens(self) -> int:
        rows, columns = self.image_grid
        return rows * columns

    @property
    def token_order(self) -> npt.NDArray[np.intp]:
        """(num_image_tokens,): of the tokens of an image as they stand in a row, each one's number row by row."""
        rows, columns = self.image_grid
        if self.fovea is None:
            return np.arange(rows * columns)
        first_row, first_column, fovea_rows, fovea_columns = self.fovea
        is_fovea = np.zeros(self.image_grid, np.bool_)
        is_fovea[first_row : first_row + fovea_rows, first_column : first_column + fovea_columns] = True
        return np.argsort(~is_fovea.ravel(), kind="stable")

    @property
    def image_px(self) -> tuple[int, int]:
        """Height and width of every image in the row."""
        rows, columns = self.image_grid
        return rows * self.token_px, columns * self.token_px

    def instruction(self, text: str) -> Segment:
        """``<|im_start|>user\\n`` and the instruction, verbatim. ValueError if it spells a control token."""
        v = self.vocabulary
        ids = (v.im_start, *v.encode("user\n"), *v.encode(text))
        return _unsupervised(SegmentKind.INSTRUCTION, ids)

    def demo(self, num_views: int) -> Segment:
        """What is seen of all views of one demonstration instant."""
        return self._seen(SegmentKind.DEMO, num_views)

    def execution(self) -> Segment:
        """Ends the user's turn and opens the assistant's: from here on the episode runs."""
        v = self.vocabulary
        ids = (v.im_end, *v.encode("\n"), v.im_start, *v.encode("assistant\n"))
        return _unsupervised(SegmentKind.EXECUTION, ids)

    def observation(self, num_cameras: int, proprio: ArrayLike | None = None) -> Segment:
        """O_t: what is seen of one frame per camera, and what is told of ``proprio`` (8,) if anything is.

        Raises ValueError if it should be told and did not come.
        """
        seen = self._seen(SegmentKind.OBSERVATION, num_cameras)
        if self.proprioception is None:
            return seen
        if proprio is None:
            raise ValueError("this PONDER reads the robot's state with every observation; none came")
        ids = (*seen.ids, *self.proprioception.ids(proprio))
        return _unsupervised(SegmentKind.OBSERVATION, ids, num_images=seen.num_images)

    def text(self, transition: Transition) -> Segment:
        """``[T_yes, S]`` or ``[T_yes, DR, T_yes, S]``; its tokens are targets if they are due and to be learned."""
        t_yes = self.vocabulary.t_yes
        ids = (t_yes, *transition.subgoal)
        if transition.reasoning is not None:
            ids = (t_yes, *transition.reasoning, *ids)
        is_learned = transition.is_learned and transition.is_due
        label = t_yes if transition.is_due else self.vocabulary.t_no
        targets = ids if is_learned else (label, *(IGNORE,) * (len(ids) - 1))
        return Segment(kind=SegmentKind.TEXT, ids=ids, targets=targets)

    def carriers(self, *, is_owed: bool = False) -> Segment:
        """K carriers; the first one is labelled T_no, whether or not text came before it.

        If text should have come, and did not (``is_owed``), the label is T_yes.
        """
        label = self.vocabulary.t_yes if is_owed else self.vocabulary.t_no
        targets = (label, *(IGNORE,) * (self.num_carriers - 1))
        return Segment(kind=SegmentKind.CARRIERS, ids=self.carrier_ids, targets=targets)

    def opening(
        self,
        instruction: str,
        demo_views: Sequence[int] = (),
        notes: Sequence[Transition | None] | None = None,
    ) -> tuple[Segment, ...]:
        """Everything before the first query; ``demo_views``: the number of views at each demo instant.

        ``notes``: what is written after each of these, None where nothing is; whatever comes next is then labelled
        T_no, as carriers are. None for a row without words. Serving writes its own (``ponder_server``).

        Raises ValueError if there are not as many notes as instants.
        """
        demo = [self.demo(n) for n in demo_views]
        if notes is None:
            return (self.instruction(instruction), *demo, self.execution())
        segments = [self.instruction(instruction)]
        for nth, (seen, note) in enumerate(zip(demo, notes, strict=True)):
            segments.append(self._after_a_look(seen) if nth else seen)
            if note is not None:
                segments.append(self.text(note))
        segments.append(self._after_a_look(self.execution()) if demo else self.execution())
        return tuple(segments)

    def query(
        self,
        num_cameras: int,
        transition: Transition | None = None,
        proprio: ArrayLike | None = None,
        *,
        is_owed: bool = False,
    ) -> tuple[Segment, ...]:
        """One query, with text exactly if it is a transition; see :meth:`observation` and :meth:`carriers`."""
        text = () if transition is None else (self.text(transition),)
        return (self.observation(num_cameras, proprio), *text, self.carriers(is_owed=is_owed))

    def row(self, segments: Iterable[Segment]) -> Row:
        """Lays segments end to end."""
        ids: list[int] = []
        targets: list[int] = []
        carriers: list[range] = []
        gates: list[int] = []
        num_images, has_demo = 0, False
        for segment in segments:
            has_demo |= segment.kind is SegmentKind.DEMO
            if segment.kind is SegmentKind.CARRIERS:
                carriers.append(range(len(ids), len(ids) + len(segment)))
            ids.extend(segment.ids)
            targets.extend(segment.targets)
            num_images += segment.num_images
            if segment.kind is SegmentKind.OBSERVATION:
                gates.append(len(ids) - 1)
        num_read = carriers[0].stop if carriers else len(ids)
        return Row(
            ids=tuple(ids),
            targets=tuple(targets),
            carrier_index=np.array(carriers, dtype=np.int64).reshape(-1, self.num_carriers),
            gate_index=np.array(gates, dtype=np.int64),
            num_images=num_images,
            num_shown=num_read if has_demo else 0,
        )

    def positions(
        self, ids: Sequence[int], *, first_index: int = 0, first_position: int = 0
    ) -> tuple[npt.NDArray[np.int64], int]:
        """Positions of tokens appended to ``first_index`` others, and the mRoPE position after them.

        Returns (4, T) int64, rows [cache index; t; h; w], as transformers' Qwen3.5 text model takes them. An
        image occupies ``image_grid`` in h and w at one instant t, and moves the position on by its longer side, or
        that of its ``fovea``, not by its number of tokens. Left to itself the model would continue an appended image
        with text positions and a ``rope_deltas`` shared by all contexts of the process. Source: Qwen3.5
        ``get_rope_index``.

        Raises ValueError if an image does not have ``image_grid`` tokens.
        """
        rows, columns = self.image_grid
        first_row, first_column, *sides = self.fovea or (0, 0, rows, columns)
        is_image = np.asarray(ids, np.int64) == self.vocabulary.image_pad
        edges = np.flatnonzero(np.diff(is_image, prepend=False, append=False))
        begins, ends = edges[::2], edges[1::2]
        if (wrong := np.flatnonzero(ends - begins != rows * columns)).size:
            begin, end = int(begins[wrong[0]]), int(ends[wrong[0]])
            raise ValueError(f"image at token {first_index + begin} has {end - begin} tokens, not {rows}x{columns}")
        moves = np.where(is_image, 0, 1)
        moves[ends - 1] = max(sides)
        after = first_position + np.cumsum(moves)
        positions_4T = np.empty((4, len(ids)), dtype=np.int64)
        positions_4T[0] = np.arange(first_index, first_index + len(ids))
        positions_4T[1:] = after - moves
        offset_h, offset_w = np.divmod(self.token_order, columns)
        positions_4T[2, is_image] += np.tile(offset_h - first_row, len(begins))
        positions_4T[3, is_image] += np.tile(offset_w - first_column, len(begins))
        return positions_4T, int(after[-1]) if len(ids) else first_position

    def _after_a_look(self, segment: Segment) -> Segment:
        """What follows an instant of a demonstration, and its note if there is one: no more is to be written."""
        return replace(segment, targets=(self.vocabulary.t_no, *segment.targets[1:]))

    def _seen(self, kind: SegmentKind, num_views: int) -> Segment:
        v = self.vocabulary
        num_images = num_seen(num_views, self.eyes)
        ids = (v.vision_start, *(v.image_pad,) * self.num_image_tokens, v.vision_end) * num_images
        return _unsupervised(kind, ids, num_images=num_images)


def _unsupervised(kind: SegmentKind, ids: tuple[int, ...], num_images: int = 0) -> Segment:
    return Segment(kind=kind, ids=ids, targets=(IGNORE,) * len(ids), num_images=num_images)


def in_groups(segments: Sequence[Segment], max_tokens: int) -> list[list[Segment]]:
    """Consecutive segments in groups of at most ``max_tokens``, or of one that is longer."""
    groups: list[list[Segment]] = []
    num_tokens = 0
    for segment in segments:
        if not groups or num_tokens + len(segment) > max_tokens:
            groups.append([])
            num_tokens = 0
        groups[-1].append(segment)
        num_tokens += len(segment)
    return groups
