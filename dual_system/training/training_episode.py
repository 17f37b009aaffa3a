"""What training reads of a recorded episode, and other ways to tell the same one."""

# T ticks

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dual_system.training.cut_short import Cut
from dual_system.training.insertions import inserted_otherwise, shows_an_insertion
from dual_system.training.lapses import has_moved
from dual_system.training.notes import without_end
from dual_system.training.places import PLACE, WAY
from dual_system.training.ways import by_sight, noted_otherwise, stretch_numbers, turned_otherwise, without_numbers

Frame = NDArray[np.uint8]  # (height, width, 3) RGB
_SAME_PX = 6.0  # of a 256 px picture: less than any two things lie apart
_NUMBERED = re.compile(r"pick up the (\w+ (?:red|green|blue)) cube")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingEpisode:
    """What training reads of an episode of T ticks. Row k is the world before action k."""

    instruction: str
    demo: tuple[tuple[Frame, ...], ...]
    """The demonstration's views at 1 Hz; () without one."""
    demo_subgoals: Sequence[str] = ()
    """What is done in each of them, as grounded text; () where nobody says."""
    demo_tools: Sequence[str] = ()
    """Where the tool is then, ``<y, x>``; () where nobody says."""
    demo_notes: Sequence[str] = ()
    """What a PONDER that takes notes writes down in each of them (`notes.demo_notes`), ``""`` for nothing; () for
    nothing in all of them."""
    frames: Sequence[tuple[Frame, ...]]
    """T ticks of views, in the order of the robot's cameras; () at ticks where POUNCE has none."""
    state_T8: NDArray[np.float32]
    action_T8: NDArray[np.float32]
    """Absolute joint targets and the gripper's command."""
    subgoals: Sequence[str]
    """T grounded texts; empty texts for data without annotations."""
    is_transition_T: NDArray[np.bool_]
    """Where another subgoal begins. Texts do not tell: two in a row may be the same, and one changes when its object
    comes into sight."""
    reasoning: str = ""
    """What PONDER writes at the first transition after a demonstration; empty without one."""
    imitated_from: int = 0
    """The tick from which POUNCE imitates; before it somebody else acted (`pp-correct`)."""
    is_watched: bool = False
    """Somebody else's doing, good or bad: PONDER learns to follow it, POUNCE does not imitate it."""
    is_told: bool = False
    """PONDER cannot know what is to be said, or when (`pp-wander`): it learns to follow what texts point at, only."""
    planned: Sequence[str] | None = None
    """T texts that PONDER says instead of the subgoals (`with_plans`); None: the subgoals."""
    unreached: Sequence[str] = ()
    """Texts of what was still to come at the end, of an episode that failed: plans have it, too."""
    moving: Sequence[str] = ()
    """Per tick where things are that move by themselves, ``<y, x>, <y, x>`` (`notes.moving_places`), ``""`` for none;
    () where nobody says."""
    said: Sequence[str] = ()
    """What the recorded PONDER newly said at each of T ticks, ``""`` for nothing; () where nobody was listened to."""
    sights: Sequence[tuple[Frame, ...]] | None = None
    """T ticks of what PONDER's eyes make of the views, where ``frames`` are not the cameras' own; ``demo`` then is what
    they make of it, too."""
    seen_at_T: NDArray[np.intp] | None = None
    """The tick that PONDER's view of each tick is of (`as_seen`); None: itself."""

    def __post_init__(self) -> None:
        rows = (self.frames, self.state_T8, self.action_T8, self.subgoals, self.is_transition_T)
        sizes = {len(column) for column in rows}
        if not 0 <= self.imitated_from < len(self.subgoals):
            raise ValueError(f"imitated_from {self.imitated_from} is none of the {len(self.subgoals)} ticks")
        if len(sizes) != 1 or 0 in sizes:
            raise ValueError(
                "an episode needs one frame, state, action, text and transition flag per tick; it has "
                f"{', '.join(str(len(column)) for column in rows)}"
            )

    @property
    def num_ticks(self) -> int:
        return len(self.subgoals)

    def as_seen(self, seen_at_T: NDArray[np.intp]) -> TrainingEpisode:
        """The same where pictures were taken now and then only: what is shown at tick t was taken at ``seen_at_T[t]``.

        What PONDER is told and is to say must be of that instant, too. A thing that is being pushed lies elsewhere a
        second later; a PONDER whose pictures lag behind its words learns not to look. POUNCE's state and commands stay.
        Changes that no picture shows apart are seen as one.
        """
        count_T = np.cumsum(self.is_transition_T)[seen_at_T]
        return replace(
            self,
            subgoals=[self.subgoals[tick] for tick in seen_at_T],
            is_transition_T=np.diff(count_T, prepend=0) > 0,
            moving=[self.moving[tick] for tick in seen_at_T] if self.moving else (),
            seen_at_T=seen_at_T,
        )

    def ponder_state(self, tick: int) -> NDArray[np.float32]:
        """The robot's state (8,) as it was when the picture of this tick was taken."""
        state_8: NDArray[np.float32] = self.state_T8[tick if self.seen_at_T is None else self.seen_at_T[tick]]
        return state_8

    def with_foresight(self) -> TrainingEpisode:
        """The same with a place in every text that gets one later, while its subgoal lasts.

        Upstream's texts have none as long as the arm hides the thing. Nothing in the picture tells where it is then,
        but what was seen before may, and a PONDER that learns to say such a text points nowhere.
        """
        begins = np.flatnonzero(self.is_transition_T | (np.arange(self.num_ticks) == 0)).tolist()
        subgoals: list[str] = []
        for begin, end in pairwise([*begins, self.num_ticks]):
            texts = self.subgoals[begin:end]
            placed = next((text for text in texts if PLACE.search(text)), "")
            subgoals += [text if PLACE.search(text) else placed or text for text in texts]
        return replace(self, subgoals=subgoals)

    def cut_short(self, cut: Cut) -> TrainingEpisode:
        """The same, told to end sooner (`cuts`). Its last ticks are not to be seen."""
        ticks = cut.ticks_U.tolist()
        return replace(
            self,
            instruction=cut.instruction,
            frames=[self.frames[tick] for tick in ticks],
            sights=None if self.sights is None else [self.sights[tick] for tick in ticks],
            state_T8=self.state_T8[ticks],
            action_T8=self.action_T8[ticks],
            subgoals=cut.subgoals,
            is_transition_T=cut.is_transition_U,
            seen_at_T=None if self.seen_at_T is None else self.seen_at_T[ticks],
            moving=[self.moving[tick] for tick in ticks] if self.moving else (),
            said=(),  # of the longer task, as this is
            unreached=(),
        )

    def without_ends(self) -> TrainingEpisode:
        """The same, its notes telling where things are and not where they will come to rest."""
        notes, moving = ([without_end(note) for note in told] for told in (self.demo_notes, self.moving))
        return replace(self, demo_notes=notes, moving=moving)

    def with_plans(self, *, even_the_first: bool = False, names: bool = False) -> TrainingEpisode:
        """The same, every subgoal but the first told with the places of those that come later: ``S, <y, x>, <y, x>``.

        What was shown is then written down soon after, and read off from there later; without, a small network loses
        the third of three things. When the first subgoal is told nothing has been seen, but for a demonstration. One
        that is tried again counts once, and so does a place that was told already: where things are carried to and fro
        every text has one. Of a way (`WAY`) every stretch counts, and is told with its last word: on which side.

        With ``names`` plans of cubes that are picked up by their numbers tell what is where, ``second blue <y, x>,
        button <y, x>``: who is asked for three green ones counts to the third. Of bare places one was told twice, and
        another was not.
        """
        begins = np.flatnonzero(self.is_transition_T | (np.arange(self.num_ticks) == 0)).tolist()
        from_the_first = even_the_first or bool(self.demo)
        is_numbered = names and any(_NUMBERED.match(text) for text in {*self.subgoals, *self.unreached})
        planned: list[str] = []
        for begin, end in pairwise([*begins, self.num_ticks]):
            own = PLACE.sub("", self.subgoals[begin])
            later: dict[str, str] = {}
            told, stretches = [self.subgoals[begin]], []
            coming = [*(self.subgoals[other] for other in begins if other >= end), *self.unreached]
            for text in coming if begin > 0 or from_the_first else ():
                place, stretch = PLACE.search(text), WAY.search(text)
                if stretch is not None:
                    stretches.append(f"{stretch[1]} {stretch[2]}")
                elif place is not None and PLACE.sub("", text) != own:
                    later.setdefault(PLACE.sub("", text), place[0])
            for text, there in later.items():
                if all(not PLACE.search(other) or has_moved(other, there, _SAME_PX) for other in told):
                    told.append(f"{_name(text)}{there}" if is_numbered else there)
            plan = "".join(f", {there}" for there in (*told[1:], *stretches[1:]))  # a stretch's text has the next one
            planned += [text + plan for text in self.subgoals[begin:end]]
        return replace(self, planned=planned)

    def with_ways_by_sight(self) -> TrainingEpisode:
        """The same, its words on ways telling them as they were seen (`ways`), what was said as if it was of then."""
        numbers = self._stretch_numbers()
        planned, said = (
            [by_sight(text, number) for text, number in zip(texts, numbers, strict=False)]
            for texts in (self.words, self.said)
        )
        return replace(self, planned=planned, said=said)

    def with_other_sides(self, others: Collection[int]) -> TrainingEpisode:
        """The same, told as if the stretches of these numbers of a way around things had passed on the other side; or,
        of a peg that is put into a box, as `inserted_otherwise`.

        What is demonstrated is then what words say and no longer what pictures show: who writes a plan has to look it
        up in the notes, by its number. Before `with_plans`; nothing was said.
        """
        if shows_an_insertion(self.demo_subgoals):
            demo, own, notes = (
                [inserted_otherwise(text, others) for text in texts]
                for texts in (self.demo_subgoals, self.subgoals, self.demo_notes)
            )
            return replace(self, demo_subgoals=demo, subgoals=own, demo_notes=notes, said=())
        demo, own = (
            [turned_otherwise(text, number, others) for text, number in zip(texts, numbers, strict=True)]
            for texts, numbers in (
                (self.demo_subgoals, stretch_numbers(self.demo_subgoals)),
                (self.subgoals, self._stretch_numbers()),
            )
        )
        notes = [noted_otherwise(note, others) for note in self.demo_notes]
        return replace(self, demo_subgoals=demo, subgoals=own, demo_notes=notes, said=())

    def _stretch_numbers(self) -> list[int]:
        """Of every tick, the number of the stretch of a way that is gone."""
        begins_T = self.is_transition_T | (np.arange(self.num_ticks) == 0)
        begun = [begin and WAY.search(text) is not None for begin, text in zip(begins_T, self.subgoals, strict=True)]
        return np.cumsum(begun).tolist()  # type: ignore[no-any-return]

    def without_numbers(self) -> TrainingEpisode:
        """The same, its notes and narration telling stretches of ways by their sides alone (`ways.without_numbers`)."""
        notes = [*map(without_numbers, self.demo_notes)]
        return replace(self, demo_notes=notes, reasoning=without_numbers(self.reasoning))

    def next_places(self) -> list[str]:
        """Per tick, the place of the subgoal after the one in force, ``<y, x>``; empty where it has none."""
        begins = [*np.flatnonzero(self.is_transition_T | (np.arange(self.num_ticks) == 0)).tolist(), self.num_ticks]
        found: list[str] = []
        for begin, end in pairwise(begins):
            place = PLACE.search(self.subgoals[end]) if end < self.num_ticks else None
            found += ["" if place is None else place[0]] * (end - begin)
        return found

    @property
    def words(self) -> Sequence[str]:
        """What is to be said at each tick."""
        return self.subgoals if self.planned is None else self.planned

    @property
    def transition_ticks(self) -> frozenset[int]:
        """Ticks at which another subgoal begins."""
        return frozenset(np.flatnonzero(self.is_transition_T).tolist())


def _name(text: str) -> str:
    """What a plan calls the place of this subgoal, and a space; empty where it has no name for it."""
    numbered = _NUMBERED.match(text)
    if numbered is not None:
        return f"{numbered[1]} "
    return next((f"{name} " for name in ("bin", "button") if f" the {name}" in text), "")
