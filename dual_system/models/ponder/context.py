"""An episode as one row of tokens: PONDER's context, and where its LM head is supervised.

The row is built from segments and is append-only: training concatenates them, serving appends them one by one, and
both get them from here (the official chat template rewrites earlier turns, so it cannot be used). One episode is

    <|im_start|>user\\n Ins [demo frames, 1 Hz] <|im_end|>\\n<|im_start|>assistant\\n     once, at opening ("chat")
    O_t  [ T_yes S_t | T_yes DR T_yes S_t ]  K carriers                               per query t

where a frame is ``<|vision_start|> <|image_pad|> * n <|vision_end|>`` (n = 64 at 256 px), one per image that the
`observation` reader returns. Without memory (`ContextFormat.remembers`) every query is such a row of its own, after Ins
and without a demonstration. **T_no is never in the row.** It is only the LM *target* at the first carrier position
(paper, appendix A.2), so T_t is always decided by the logits of the preceding token: the last one of O_t, or the last
one of the text. Carriers are rows of the embedding table that no real token uses; their ids are ordinary ids.

A target belongs to the position it labels: the logits that must predict ``targets[i]`` are those of position
i - 1.

Pure: integers in, integers out. # T tokens of a row, K carriers, Q queries
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from dual_system.models.ponder.demo_sampling import PAPER_SAMPLING, DemoSampling
from dual_system.models.ponder.observation import WHOLE_VIEWS, ObservationReader
from dual_system.models.ponder.text_policy import OWN_TEXTS, TextPolicy
from dual_system.models.ponder.vocabulary import Vocabulary

OpeningForm: TypeAlias = Literal["chat", "bare"]
"""chat: the user's turn is closed and the assistant's opened. bare: observations follow the demonstration directly."""

PAPER_CAMERAS = 2
"""front, wrist"""
IGNORE = -100
"""Target of a position that is not supervised (the ignore index of torch's cross-entropy)."""


class SegmentKind(StrEnum):
    INSTRUCTION = "instruction"
    DEMO = "demo"
    EXECUTION = "execution"  # the header after which observations begin
    OBSERVATION = "observation"
    TEXT = "text"  # T_yes and the text that it opens
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
    """Text of one transition query, as token ids; ``reasoning`` (DR) only at a demo episode's first query."""

    subgoal: tuple[int, ...]
    reasoning: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Row:
    """Concatenated segments: one causal training row, or the contents of a serving session."""

    ids: tuple[int, ...]
    targets: tuple[int, ...]
    carrier_index: npt.NDArray[np.int64]
    """(Q, K): positions of each query's carriers; their final hidden states are C_t."""
    num_images: int

    @property
    def supervised_index(self) -> npt.NDArray[np.int64]:
        """Positions whose logits predict the targets (one before each): run the LM head only here."""
        return np.flatnonzero(np.asarray(self.targets) != IGNORE) - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ContextFormat:
    """Builds segments for one vocabulary, one way of reading observations and K carriers."""

    vocabulary: Vocabulary
    num_carriers: int
    first_carrier_id: int
    image_grid: tuple[int, int]
    """Tokens of one image as (rows, columns): (8, 8) for 256 px, patch 16, merge 2."""
    token_px: int = 32
    """Side in pixels of the square that one image token covers: patch times merge."""
    reader: ObservationReader = WHOLE_VIEWS
    """Maps an observation to images and tokens."""
    speaks: bool = True
    """False if trained without texts (RoboCasa-DC, w2 = 0): its LM head is untrained, and serving generates no text."""
    demonstrations: DemoSampling = PAPER_SAMPLING
    """How demonstrations were sampled in training; serving must sample them alike."""
    opening_form: OpeningForm = "chat"
    texts: TextPolicy = OWN_TEXTS
    cameras: tuple[str, ...] = ()
    """Names of the robot's cameras in training, in order; () if they are not known."""
    remembers: bool = True
    """False: a query's context is instruction, observation and its own text; no demonstration, nothing earlier."""

    def __post_init__(self) -> None:
        if not 1 <= self.num_carriers <= 16:
            raise ValueError(f"num_carriers is {self.num_carriers}; K must be 1..16 (the paper uses 1).")
        for what, rows in (("first_carrier_id", self.carrier_ids), ("the state's tokens", self.reader.state_rows)):
            if rows and rows[0] < self.vocabulary.num_tokens:
                raise ValueError(
                    f"{what}: row {rows[0]} is a real token; this tokenizer's unused rows start at "
                    f"{self.vocabulary.num_tokens}."
                )
        if clash := sorted({*self.carrier_ids} & {*self.reader.state_rows}):
            raise ValueError(f"rows {clash} are carriers and the state's tokens at once; move first_carrier_id.")

    @property
    def num_cameras(self) -> int:
        """Views of an observation; the paper's two if the checkpoint names none."""
        return len(self.cameras) or PAPER_CAMERAS

    @property
    def carrier_ids(self) -> tuple[int, ...]:
        return tuple(range(self.first_carrier_id, self.first_carrier_id + self.num_carriers))

    @property
    def num_image_tokens(self) -> int:
        rows, columns = self.image_grid
        return rows * columns

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
        """All images of one demonstration instant."""
        return self._seen(SegmentKind.DEMO, num_views)

    def execution(self) -> Segment:
        """Ends the user's turn and opens the assistant's, which holds the running episode."""
        v = self.vocabulary
        ids = (v.im_end, *v.encode("\n"), v.im_start, *v.encode("assistant\n"))
        return _unsupervised(SegmentKind.EXECUTION, ids)

    def observation(self, num_cameras: int, proprio: ArrayLike | None = None) -> Segment:
        """O_t: the images of one frame per camera, then the tokens of ``proprio`` (8,) if the reader makes any.

        Raises ValueError if the reader needs ``proprio`` and it is None.
        """
        seen = self._seen(SegmentKind.OBSERVATION, num_cameras)
        ids = (*seen.ids, *self.reader.state_ids(proprio))
        return _unsupervised(SegmentKind.OBSERVATION, ids, num_images=seen.num_images)

    def text(self, transition: Transition) -> Segment:
        """``[T_yes, S]`` or ``[T_yes, DR, T_yes, S]``; every token is a target."""
        t_yes = self.vocabulary.t_yes
        ids = (t_yes, *transition.subgoal)
        if transition.reasoning is not None:
            ids = (t_yes, *transition.reasoning, *ids)
        return Segment(kind=SegmentKind.TEXT, ids=ids, targets=ids)

    def carriers(self) -> Segment:
        """K carriers; the first one is labelled T_no, whether or not text came before it."""
        targets = (self.vocabulary.t_no, *(IGNORE,) * (self.num_carriers - 1))
        return Segment(kind=SegmentKind.CARRIERS, ids=self.carrier_ids, targets=targets)

    def opening(self, instruction: str, demo_views: Sequence[int] = ()) -> tuple[Segment, ...]:
        """Everything before the first query; ``demo_views``: the number of views at each demo instant."""
        header = () if self.opening_form == "bare" else (self.execution(),)
        return (self.instruction(instruction), *(self.demo(n) for n in demo_views), *header)

    def query(
        self, num_cameras: int, transition: Transition | None = None, proprio: ArrayLike | None = None
    ) -> tuple[Segment, ...]:
        """One query, with text if and only if it is a transition; ``proprio`` as in :meth:`observation`."""
        text = () if transition is None else (self.text(transition),)
        return (self.observation(num_cameras, proprio), *text, self.carriers())

    def row(self, segments: Iterable[Segment]) -> Row:
        """Concatenates segments."""
        ids: list[int] = []
        targets: list[int] = []
        carriers: list[range] = []
        num_images = 0
        for segment in segments:
            if segment.kind is SegmentKind.CARRIERS:
                carriers.append(range(len(ids), len(ids) + len(segment)))
            ids.extend(segment.ids)
            targets.extend(segment.targets)
            num_images += segment.num_images
        return Row(
            ids=tuple(ids),
            targets=tuple(targets),
            carrier_index=np.array(carriers, dtype=np.int64).reshape(-1, self.num_carriers),
            num_images=num_images,
        )

    def positions(
        self, ids: Sequence[int], *, first_index: int = 0, first_position: int = 0
    ) -> tuple[npt.NDArray[np.int64], int]:
        """Positions of tokens appended to ``first_index`` others, and the mRoPE position after them.

        Returns (4, T) int64, rows [cache index; t; h; w], as transformers' Qwen3.5 text model takes them. An
        image occupies ``image_grid`` in h and w at one instant t, and advances the position by its longer side, not by
        its number of tokens. Without explicit positions the model would give an appended image text positions, and a
        ``rope_deltas`` shared by all contexts of the process. Source: Qwen3.5 ``get_rope_index``.

        Raises ValueError if an image does not have ``image_grid`` tokens.
        """
        rows, columns = self.image_grid
        is_image = np.asarray(ids, np.int64) == self.vocabulary.image_pad
        edges = np.flatnonzero(np.diff(is_image, prepend=False, append=False))
        begins, ends = edges[::2], edges[1::2]
        if (wrong := np.flatnonzero(ends - begins != rows * columns)).size:
            begin, end = int(begins[wrong[0]]), int(ends[wrong[0]])
            raise ValueError(f"image at token {first_index + begin} has {end - begin} tokens, not {rows}x{columns}")
        moves = np.where(is_image, 0, 1)
        moves[ends - 1] = max(rows, columns)
        after = first_position + np.cumsum(moves)
        positions_4T = np.empty((4, len(ids)), dtype=np.int64)
        positions_4T[0] = np.arange(first_index, first_index + len(ids))
        positions_4T[1:] = after - moves
        offset_h, offset_w = np.divmod(np.arange(rows * columns), columns)
        positions_4T[2, is_image] += np.tile(offset_h, len(begins))
        positions_4T[3, is_image] += np.tile(offset_w, len(begins))
        return positions_4T, int(after[-1]) if len(ids) else first_position

    def _seen(self, kind: SegmentKind, num_views: int) -> Segment:
        v = self.vocabulary
        num_images = self.reader.num_images(num_views)
        ids = (v.vision_start, *(v.image_pad,) * self.num_image_tokens, v.vision_end) * num_images
        return _unsupervised(kind, ids, num_images=num_images)


def _unsupervised(kind: SegmentKind, ids: tuple[int, ...], num_images: int = 0) -> Segment:
    return Segment(kind=kind, ids=ids, targets=(IGNORE,) * len(ids), num_images=num_images)


def in_groups(segments: Sequence[Segment], max_tokens: int) -> list[list[Segment]]:
    """Groups consecutive segments into at most ``max_tokens`` tokens each; a longer segment is its own group."""
    groups: list[list[Segment]] = []
    num_tokens = 0
    for segment in segments:
        if not groups or num_tokens + len(segment) > max_tokens:
            groups.append([])
            num_tokens = 0
        groups[-1].append(segment)
        num_tokens += len(segment)
    return groups
