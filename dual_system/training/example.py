"""One recorded episode under one drawn schedule: PONDER's row, and what each POUNCE invocation saw and should do.

Serving builds the same row segment by segment (``context``) and refers by the same rule (``clock.reference``); tests
hold them equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, repeat
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from clock.sampling import Clocks, SampledInvocation, SampledSchedule, sample_schedule
from dual_system.models.eyes import see
from dual_system.models.normalisation import Floats
from dual_system.models.ponder.context import IGNORE, ContextFormat, Row, Transition
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.training.augment import AS_IT_IS, NOT_AUGMENTED, Augmentation, View, draw_view
from dual_system.training.blind import without_pictures
from dual_system.training.chunks import chunk_ticks
from dual_system.training.countdown import (
    counted,
    misjudged,
    rhythm,
    stood_at,
    told_until,
    waiting_longer,
    waits,
    waits_unplaced,
)
from dual_system.training.cut_short import cuts, drawn_cut
from dual_system.training.deeds import narration
from dual_system.training.events import EVENT_ROWS, draw_near, event_ticks
from dual_system.training.insertions import shows_an_insertion
from dual_system.training.lapses import NO_LAPSES, Lapses, Words, drawn_lapses, has_moved, without_lapses
from dual_system.training.notes import heeded, in_sight, misnoted, noted, told_wait, with_notes
from dual_system.training.nudge import NO_NUDGE, Nudge, draw_nudges
from dual_system.training.own_words import newly_said, own_words
from dual_system.training.place_lessons import PlaceLessons, place_lessons
from dual_system.training.row_ends import glanced, is_noted_at_once, shortened, with_notes_alone
from dual_system.training.slip import Slip
from dual_system.training.stand_in import stand_in
from dual_system.training.training_episode import Frame, TrainingEpisode
from dual_system.training.ways import has_sides, shows_a_way

_SILENCE = repeat(Words())
_BEGINNING, _RECALLING = 8, 2  # queries
_CORRECTED = 0.3  # of own words, at every query
_SHARES = (
    "text_dropout", "slips", "tells_onward", "cuts_short", "begins", "recalls", "own_words", "misjudges", "even_clocks",
    "other_ways", "blind", "learned_repeats", "glances",
)  # fmt: skip
_MOST_STRETCHES = 50  # more than any way has
_MOVED_PX = 3.0  # of a 256 px picture: farther than PONDER errs where nothing moves


@dataclass(frozen=True, slots=True, kw_only=True)
class ExampleConfig:
    """How an episode becomes a training example."""

    clocks: Clocks
    even_clocks: float = 0.0
    """Share of rows whose clocks run without spread, as in evaluation: where a second look tells a speed, all that
    follows is then told by counting looks."""
    max_invocations: int = 16
    """Of those that the schedule has, so many are drawn: they cost most."""
    event_weight: float = 1.0
    """How much likelier those are whose chunk reaches into an event (`events`): a grasp, a release, a new subgoal."""
    is_grounded: bool = True
    """False: texts are left out of the row, as in RoboCasa-DC."""
    text_dropout: float = 0.0
    """Share of rows without their texts although they have some: cognition must then come from what was seen."""

    has_foresight: bool = False
    """See `TrainingEpisode.with_foresight`."""
    has_reasoning: bool = True
    """False: nothing is written after a demonstration but the subgoal. The paper's PONDER can write; one from scratch
    would learn little else."""
    narrates: bool = False
    """After a demonstration `narration` is written. Deeds are then looked up in words, in which a number or a neighbour
    leads to a place; what was done a minute ago is read off pictures in one order, which all rows teach alike."""
    has_plans: bool = False
    """See `TrainingEpisode.with_plans`."""
    names_plans: bool = False  # also there
    ways_by_sight: bool = False
    """See `TrainingEpisode.with_ways_by_sight`."""
    other_ways: float = 0.0
    """Share of demonstrated ways and insertions told otherwise than pictures show: `with_other_sides`, and ways around
    nothing `scattered`. The row ends with the second query; what notes say is not learned. Not before blind."""
    blind: float = 0.0
    """Share of them whose rows are words alone (`blind`), of other places and sides in every row: narration and plan
    can then be had from notes and nowhere else."""
    spares_bare_ways: bool = False
    """`other_ways` and `blind` are of ways around things and of insertions alone: no other ways have sides."""
    cuts_short: float = 0.0
    """Share of episodes that count, of two rounds and more, that are told to end sooner (`cuts`)."""
    slips: float = 0.0
    """Share of grounded rows in which all said places are wrong by ``slip_px`` and not to be learned. Cognition must
    then come from what is seen; from flawless words alone it would learn to copy them, and PONDER's own are not."""
    slip_px: tuple[float, float] = (6.0, 6.0)
    """Standard deviation of each coordinate, of a 256 px picture: from the first to the second, drawn for each row,
    every factor as likely. A thing that was pushed lies further from where it was said to be than PONDER errs."""
    tremble_px: float = 0.0
    """The same in all other grounded rows, whose words are learned: no word is then exact enough to be copied."""

    lapses: Lapses = NO_LAPSES
    """Words that come late or are wrong, and are put right."""
    own_words: float = 0.0
    """Of grounded rows whose recording holds what its PONDER said, the share in which that stands (`own_words`)."""
    counts_down: bool = False
    """Waits are told with their number of steps, at every query anew (`countdown`)."""
    misjudges: float = 0.0
    """Share of rows with waits counted down in which the first numbers are wrong (`countdown.misjudged`)."""
    trusts_counts: bool = False
    """C tells the wait that words tell, be they wrong; else always the true one. A PONDER whose words are mostly right
    hedges between them and what it sees, and tells neither; the wait is then best put right in words."""
    waits_longer: int = 0
    """Waits are told to end so many control steps later than they did: a hand that comes too early is told so."""
    takes_notes: bool = False
    """What moves by itself is written down at every look (`notes`); a PONDER that learns it is served so. Waits are
    then told among the notes, and ``counts_down`` tells no others."""
    tells_ends: bool = False
    """Notes of what is on its way to a place tell that, too (`notes.ends_of_moves`)."""
    learned_repeats: float = 1.0
    """Of notes that repeat the one before, the share that is learned (`notes.heeded`)."""
    retold_px: float | None = None
    """Words are said again once the place that they told is farther than that from its thing; None: never."""

    augmentation: Augmentation = NOT_AUGMENTED
    """Other views of the scene. An action is that of the scene as it is, so where POUNCE learns as well, only watched
    episodes may be seen otherwise."""
    augments: Literal["all", "watched"] = "all"
    """Which episodes are seen in other views."""
    tells_onward: float = 0.0
    """Share of queries whose stand-in tells where the next subgoal will be (`TrainingEpisode.next_places`). The hand
    acts for up to 2.3 s on what it heard last: one that has lifted a cube and does not know where to lets go of it
    anywhere."""
    nudge: Nudge = NO_NUDGE
    """Displaced starts of POUNCE's invocations."""
    max_queries: int | None = None
    """The row ends after so many queries, and with it the invocations; None: with the episode. Most of what is to be
    seen is seen early."""
    begins: float = 0.0
    """Share of rows that end after eight queries: what stands where is told in the first few, and is what most errors
    begin with, while the rest of a row mostly repeats it."""
    recalls: float = 0.0
    """Share of demonstrated episodes whose row ends with the second query: what a demonstration did is looked up when
    the first words come, and that costs a fraction of a whole row."""
    glances: float = 0.0
    """Share of episodes with a note at the first look at their demonstration alone whose row ends with it."""

    def __post_init__(self) -> None:
        if self.max_queries is not None and self.max_queries < 1:
            raise ValueError(f"max_queries must be at least 1, came {self.max_queries}")
        if not 0 < self.event_weight < np.inf:
            raise ValueError(f"event_weight must be above 0 and finite, came {self.event_weight}")
        if not 0 < self.slip_px[0] <= self.slip_px[1] or self.tremble_px < 0:
            raise ValueError(
                f"slip_px {self.slip_px} must ascend from above 0, tremble_px {self.tremble_px} be at least 0"
            )
        if self.retold_px is not None and (self.slips or self.retold_px <= 0):
            raise ValueError(
                f"retold_px {self.retold_px} must be above 0, and slips 0, came {self.slips}: a row whose words all "
                "slip never puts them right; let them slip in `Lapses.slipped`"
            )
        for name in _SHARES:
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], came {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Example:
    """An episode under a schedule. What a stage does not read is not made."""

    episode: TrainingEpisode
    form: ContextFormat
    schedule: SampledSchedule
    invocations: tuple[SampledInvocation, ...]
    """Those of the schedule that were drawn."""
    is_grounded: bool
    view: View = AS_IT_IS
    slip: Slip | None = None
    words: tuple[Words, ...] | None = None
    """Of every query; None: those of the recording."""
    notes: tuple[str, ...] = ()
    """Of every query, subgoal and notes (`notes.noted`), ``""`` for none; () where none are taken."""
    heeded_demo: tuple[bool, ...] | None = None
    """Which notes of the demonstration are learned (`notes.heeded`); None: all."""
    trusted: tuple[int | None, ...] | None = None
    """Of every query, the wrong wait that C is to tell as words do, None: the right one; None: all are."""
    onward: tuple[str, ...] | None = None
    """Of every query, the place that its stand-in tells besides (`TrainingEpisode.next_places`); None: of none."""
    nudge: Nudge = NO_NUDGE
    nudges_I2: Floats | None = None
    """Of each invocation's tool [m]; None: starts are as recorded."""
    is_blind: bool = False
    """Without pictures."""
    is_glance: bool = False
    """Only what is noted at the first look at the demonstration is learned."""

    def row(self) -> Row:
        """PONDER's tokens."""
        row = episode_row(
            self.episode,
            self.form,
            self.schedule,
            is_grounded=self.is_grounded,
            view=self.view,
            slip=self.slip,
            words=self.words,
            heeded_demo=self.heeded_demo,
        )
        row = without_pictures(row, self.form.vocabulary) if self.is_blind else row
        row = with_notes_alone(row) if self.is_glance else row
        return replace(row, targets=(IGNORE,) * len(row.targets)) if self.episode.is_told else row

    @property
    def asks_for_no_cognition(self) -> bool:
        """C is asked for nothing: words tell places that were never seen, or what is to be done was not seen."""
        return self.is_glance or (self.slip is not None and self.slip.std_px is None)

    def frames(self) -> Tensor | None:
        """PONDER's pictures, (num_images, height, width, 3) uint8; None without any."""
        if self.is_blind:
            return None
        return self.view.pictures(row_frames(self.episode, self.form, self.schedule))

    @property
    def said(self) -> tuple[str, ...]:
        """Per query, the subgoal that PONDER had last written by then; empty texts without grounding."""
        if not self.is_grounded:
            return ("",) * len(self.schedule.queries)
        if self.words is None:
            return said_by_query(self.episode, self.schedule)
        return tuple(accumulate((normalised_text(each.text) for each in self.words), lambda old, new: new or old))

    def stand_ins(self, size: int) -> Tensor:
        """`stand_in` of the subgoal in force at every query, (Q, size)."""
        episode, made = self.episode, []
        left, onward = waits(episode.subgoals), self.onward or ("",) * len(self.schedule.queries)
        stood = stood_at(episode.subgoals)  # a hand that sees nothing and hears only how long would drift away
        trusted = self.trusted or (None,) * len(self.schedule.queries)
        for query, following, other in zip(self.schedule.queries, onward, trusted, strict=True):
            tick = query.tick
            text, after = (self.view.text(each) for each in (episode.subgoals[tick], stood[tick] or following))
            if (wait := left[tick]) is not None:
                text, after = told_until(text, after, wait if other is None else other)
            made.append(stand_in(text, size, episode.instruction, after))
        return torch.from_numpy(np.stack(made))

    def stand_in_weights(self, moved: float) -> Tensor:
        """How much each query's stand-in counts, (Q,): ``moved`` where the words said last tell another place, else 1.

        The thing was moved, or they are an earlier subgoal's. Everywhere else, and that is nearly everywhere, C can be
        copied from the words. 0 where C is asked for nothing.
        """
        if self.asks_for_no_cognition:
            return torch.zeros(len(self.schedule.queries))
        if not self.is_grounded:
            return torch.ones(len(self.schedule.queries))
        subgoals, is_change = _subgoals(self.episode, self.schedule)
        words = without_lapses(subgoals, is_change) if self.words is None else self.words
        weights, said = [], ""
        for each, now in zip(words, subgoals, strict=True):
            said = each.text or said
            weights.append(moved if has_moved(said, now, _MOVED_PX) else 1.0)
        return torch.tensor(weights)

    def place_lessons(self, row: Row, size: int) -> PlaceLessons:
        """`place_lessons` of ``row``, this example's.

        While the first subgoal lasts more is seen than there was when it was told: what comes later is in mind then,
        too. What a demonstration does is in mind while it is seen.
        """
        if self.asks_for_no_cognition:
            return place_lessons(row, [""] * len(self.schedule.queries), self.form.vocabulary, size)
        episode = self.episode
        if episode.planned is not None and not episode.is_told:
            episode = episode.with_plans(even_the_first=True)
        notes = self.notes or ("",) * len(self.schedule.queries)
        words = [note or episode.words[query.tick] for note, query in zip(notes, self.schedule.queries, strict=True)]
        texts = [self.view.text(text) for text in words]
        demonstrated = [self.view.text(text) for text in episode.demo_subgoals]
        tools = [self.view.text(text) for text in episode.demo_tools]
        steps = rhythm(episode.instruction, episode.subgoals)
        rhythms = [None if steps is None or 2 * query.tick < steps else steps for query in self.schedule.queries]
        return place_lessons(row, texts, self.form.vocabulary, size, demonstrated, tools, rhythms)


def make_example(
    episode: TrainingEpisode, form: ContextFormat, config: ExampleConfig, rng: np.random.Generator
) -> Example:
    """Draws a schedule and lays the episode out under it."""
    episode = episode.with_foresight() if config.has_foresight else episode
    if config.waits_longer:
        texts, is_transition_T = waiting_longer(episode.subgoals, episode.is_transition_T, config.waits_longer)
        episode = replace(episode, subgoals=texts, is_transition_T=is_transition_T)
    is_glance = bool(config.glances) and is_noted_at_once(episode) and rng.random() < config.glances
    episode = glanced(episode) if is_glance else episode
    cut = None
    if config.cuts_short and not is_glance and rng.random() < config.cuts_short:
        cut = drawn_cut(
            cuts(episode.instruction, episode.subgoals, episode.is_transition_T), episode.imitated_from, rng
        )
    is_around = has_sides(episode.demo_subgoals)
    is_bare = not is_around and shows_a_way(episode.demo_subgoals)
    is_way = is_around or shows_an_insertion(episode.demo_subgoals) or (is_bare and not config.spares_bare_ways)
    is_blind = is_way and bool(config.blind) and rng.random() < config.blind
    if is_otherwise := is_blind or (is_way and bool(config.other_ways) and rng.random() < config.other_ways):
        others = np.flatnonzero(rng.integers(2, size=_MOST_STRETCHES)) + 1
        episode = episode.with_other_sides(set(others.tolist()))
    episode = episode if cut is None else episode.cut_short(cut)
    episode = episode.with_plans(names=config.names_plans) if config.has_plans else episode
    episode = episode if config.has_reasoning else replace(episode, reasoning="")
    episode = replace(episode, reasoning=narration(episode.demo_subgoals)) if config.narrates else episode
    episode = episode.with_ways_by_sight() if config.ways_by_sight and is_around else episode.without_numbers()
    episode = episode if config.tells_ends else episode.without_ends()
    is_even = config.even_clocks and rng.random() < config.even_clocks
    clocks = config.clocks.without_spread() if is_even else config.clocks
    schedule = sample_schedule(rng, clocks, episode.num_ticks, transition_ticks=episode.transition_ticks)
    schedule = shortened(schedule, config.max_queries)
    if config.begins and rng.random() < config.begins:
        schedule = shortened(schedule, _BEGINNING)
    if is_otherwise or (config.recalls and episode.demo and rng.random() < config.recalls):
        schedule = shortened(schedule, _RECALLING)
    schedule = shortened(schedule, 1) if is_glance else schedule
    if cut is not None:
        schedule = SampledSchedule(
            queries=tuple(each for each in schedule.queries if each.tick < cut.shown),
            invocations=tuple(each for each in schedule.invocations if each.tick + EVENT_ROWS <= cut.end),
        )
    imitated = [i for i, each in enumerate(schedule.invocations) if each.tick >= episode.imitated_from]
    count = 0 if episode.is_watched else min(config.max_invocations, len(imitated))
    events = event_ticks(episode.action_T8, episode.transition_ticks)
    ticks = [schedule.invocations[index].tick for index in imitated]
    chosen = draw_near(ticks, events, count, config.event_weight, rng)
    invocations = tuple(schedule.invocations[imitated[index]] for index in chosen)
    is_spared = episode.is_told or is_glance  # slips and lapses: its words are not learned, or all in its notes
    is_grounded = config.is_grounded and (rng.random() >= config.text_dropout or is_spared or is_otherwise)
    is_own = is_grounded and bool(config.own_words and episode.said) and rng.random() < config.own_words
    slip = None
    if is_blind or (is_otherwise and is_bare):
        slip = Slip(std_px=None, seed=int(rng.integers(1 << 62)), is_learned=True)
    elif is_grounded and not is_own and config.slips and not is_spared and rng.random() < config.slips:
        std_px = float(np.exp(rng.uniform(*np.log(config.slip_px))))
        slip = Slip(std_px=std_px, seed=int(rng.integers(1 << 62)))
    elif is_grounded and config.tremble_px:
        slip = Slip(std_px=config.tremble_px, seed=int(rng.integers(1 << 62)), is_learned=True)
    words: tuple[Words, ...] | None = None
    notes: tuple[str, ...] = ()
    wrong_waits_Q: list[int | None] | None = None
    if is_grounded and not is_spared:
        lapses = config.lapses if config.lapses.rows and rng.random() < config.lapses.rows else NO_LAPSES
        if is_own:
            said = newly_said(episode.said, [query.tick for query in schedule.queries], bool(episode.demo))
            words = own_words(said, *_subgoals(episode, schedule), rng, _CORRECTED)
        elif lapses != NO_LAPSES or config.retold_px is not None:
            words = drawn_lapses(lapses, *_subgoals(episode, schedule), rng, config.retold_px)
        if config.takes_notes and episode.moving:
            ticks = [query.tick for query in schedule.queries]
            seen = [in_sight(places, form.eyes) for places in episode.moving]
            told = noted(episode.instruction, episode.subgoals, seen)
            notes = tuple(told[tick] for tick in ticks)
            wrong_Q = [""] * len(ticks)
            if config.misjudges and rng.random() < config.misjudges:
                wrong_Q = misnoted(episode.instruction, episode.subgoals, seen, ticks, rng)
                wrong_waits_Q = [told_wait(note) for note in wrong_Q]
            words = without_lapses(*_subgoals(episode, schedule)) if words is None else words
            words = with_notes(words, notes, wrong_Q, heeded(notes, config.learned_repeats, rng))
        elif config.counts_down and any(left := waits(episode.subgoals)):
            subgoals, is_change = _subgoals(episode, schedule)
            words = without_lapses(subgoals, is_change) if words is None else words
            told = [episode.subgoals[query.tick] for query in schedule.queries]
            ticks = [query.tick for query in schedule.queries]
            left_Q = [left[tick] for tick in ticks]
            if config.misjudges and rng.random() < config.misjudges:
                wrong_waits_Q = misjudged(ticks, told, left_Q, rng)
            words = counted(words, told, left_Q, wrong_waits_Q)
    heeded_demo = (False,) * len(episode.demo) if is_otherwise else None
    if heeded_demo is None and config.learned_repeats < 1 and form.takes_notes and episode.demo_notes:
        seen = [in_sight(note, form.eyes) for note in episode.demo_notes]
        heeded_demo = tuple(heeded(seen, config.learned_repeats, rng))
    is_moved = config.augments == "all" or episode.is_watched
    view = draw_view(config.augmentation if is_moved else NOT_AUGMENTED, form, set(episode.subgoals), rng)
    onward = None
    if config.tells_onward:
        heard_Q = rng.random(len(schedule.queries)) < config.tells_onward
        places, ticks = episode.next_places(), [query.tick for query in schedule.queries]
        onward = tuple(places[tick] if is_heard else "" for tick, is_heard in zip(ticks, heard_Q, strict=True))
    nudges_I2 = None
    if config.nudge != NO_NUDGE:
        first_I = np.array([each.tick for each in invocations], np.intp)
        chunks_IN8 = episode.action_T8[chunk_ticks(first_I, config.nudge.return_rows + 1, episode.num_ticks)]
        nudges_I2 = draw_nudges(config.nudge, episode.state_T8[first_I], chunks_IN8, rng)
        # how long there is to wait takes the place of where: nothing would tell the way back, and it would be guessed
        nudges_I2[np.array(waits_unplaced(episode.subgoals), np.bool_)[first_I]] = 0.0
    return Example(
        episode=episode,
        form=form,
        schedule=schedule,
        invocations=invocations,
        is_grounded=is_grounded,
        view=view,
        slip=slip,
        words=words,
        notes=notes,
        heeded_demo=heeded_demo,
        trusted=tuple(wrong_waits_Q) if config.trusts_counts and wrong_waits_Q else None,
        onward=onward,
        nudge=config.nudge,
        nudges_I2=nudges_I2,
        is_blind=is_blind,
        is_glance=is_glance,
    )


def episode_row(
    episode: TrainingEpisode,
    form: ContextFormat,
    schedule: SampledSchedule,
    *,
    is_grounded: bool = True,
    view: View = AS_IT_IS,
    slip: Slip | None = None,
    words: Sequence[Words] | None = None,
    heeded_demo: Sequence[bool] | None = None,
) -> Row:
    """The tokens of the episode. The first transition of a demonstration episode begins with its reasoning.

    ``words`` are those of every query, if not those of the recording; ``heeded_demo``: which of the demonstration's
    notes are learned, if not all.
    """
    if words is None:
        words = without_lapses(*_subgoals(episode, schedule))
    say = view.text if slip is None else slip.saying(view)
    eyes = form.eyes
    views, form = _before_ponder(episode, form)
    encode = form.vocabulary.encode
    is_learned = slip is None or slip.is_learned
    notes: list[Transition | None] | None = None
    if form.takes_notes and is_grounded:
        written = [in_sight(note, eyes) for note in episode.demo_notes or ("",) * len(episode.demo)]
        heeded_D = [True] * len(written) if heeded_demo is None else heeded_demo
        notes = [
            Transition(subgoal=encode(normalised_text(say(note))), is_learned=is_learned and learns) if note else None
            for note, learns in zip(written, heeded_D, strict=True)
        ]
    segments = list(form.opening(episode.instruction, [len(views) for views in episode.demo], notes))
    reasoning = encode(normalised_text(say(episode.reasoning))) if episode.reasoning else None
    for query, said in zip(schedule.queries, words if is_grounded else _SILENCE, strict=is_grounded):
        transition = None
        if said.text:
            subgoal = encode(normalised_text(say(said.text)))
            learns = is_learned and said.is_learned
            transition = Transition(subgoal=subgoal, reasoning=reasoning, is_learned=learns, is_due=said.is_due)
            reasoning = None
        is_owed = said.is_due and not said.text
        segments += form.query(len(views[query.tick]), transition, episode.ponder_state(query.tick), is_owed=is_owed)
    return form.row(segments)


def _subgoals(episode: TrainingEpisode, schedule: SampledSchedule) -> tuple[list[str], list[bool]]:
    """What is to be said at every query, and whether it is the first to see a change."""
    queries = schedule.queries
    return [episode.words[query.tick] for query in queries], [query.stamp.is_transition for query in queries]


def said_by_query(episode: TrainingEpisode, schedule: SampledSchedule) -> tuple[str, ...]:
    """The newest subgoal at every query, as PONDER writes it: new ones come at predicted transitions only."""
    texts: list[str] = []
    newest = ""
    for query in schedule.queries:
        if query.stamp.is_transition and episode.subgoals[query.tick]:
            newest = normalised_text(episode.words[query.tick])
        texts.append(newest)
    return tuple(texts)


def row_frames(episode: TrainingEpisode, form: ContextFormat, schedule: SampledSchedule) -> Tensor:
    """All pictures of the row in order: the demonstration's, then every query's; (N, height, width, 3) uint8.

    Raises ValueError if the episode's pictures have a size that ``form`` cannot see.
    """
    views, form = _before_ponder(episode, form)
    instants = [*episode.demo, *(views[query.tick] for query in schedule.queries)]
    return torch.from_numpy(np.concatenate([see(views, form.eyes, form.image_px) for views in instants]))


def _before_ponder(episode: TrainingEpisode, form: ContextFormat) -> tuple[Sequence[tuple[Frame, ...]], ContextFormat]:
    """The pictures that PONDER is shown, and its format for them: what was seen once is read as it is."""
    return (
        (episode.frames, form) if episode.sights is None else (episode.sights, replace(form, eyes=None, counsel=None))
    )
