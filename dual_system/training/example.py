"""One recorded episode under one sampled schedule: PONDER's row, and POUNCE's invocations.

Serving builds the same row segment by segment (``ponder.context``) and assigns cognitions to invocations by the same
rule (``clock.reference``); tests compare the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from clock.sampling import Clocks, SampledInvocation, SampledQuery, SampledSchedule, sample_schedule
from dual_system.models.frame_sampling import FrameSampling
from dual_system.models.ponder.context import ContextFormat, Row, Transition
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.training.episode import TrainingEpisode
from dual_system.training.told import Told

_BRANCH_TICKS = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class ExampleConfig:
    """How an episode becomes a training example."""

    clocks: Clocks
    max_invocations: int = 16
    """Largest number of POUNCE invocations drawn from an episode's schedule; they dominate the cost of a step."""
    is_grounded: bool = True
    """False: the row has no texts, as in RoboCasa-DC."""
    told: Told | None = None
    """Texts for POUNCE in place of PONDER's; None: PONDER's newest subgoal, if it reads subgoals."""
    delay_up_to_ns: int = 0
    """PONDER's mean delay is drawn for each episode, from 0 to this one, in place of the clocks'; 0: it is not."""
    branch_weight: float = 1.0
    """Weight of invocations in the 1.5 s after a transition, where the subgoal decides, against all others."""
    has_reasoning: bool = True
    """False: the text at the first transition after a demonstration is the subgoal alone (paper, Table 3)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Example:
    """An episode under a schedule."""

    episode: TrainingEpisode
    rows: tuple[Row, ...]
    """One of the whole episode; for a PONDER without memory one of every query."""
    images: Tensor | None
    """PONDER's images in the order of the rows, (N, height, width, 3) uint8, or (N, S, H) float16 from a frozen tower;
    None if PONDER is not run."""
    schedule: SampledSchedule
    invocations: tuple[SampledInvocation, ...]
    """The invocations drawn from the schedule."""
    written: tuple[str, ...]
    """PONDER's newest subgoal at every query; empty texts without grounding."""
    told: tuple[str, ...]
    """What POUNCE is told at every invocation: the newest text written, unless `ExampleConfig.told` changes it."""

    @property
    def row(self) -> Row:
        """The episode's only row."""
        (row,) = self.rows
        return row

    def remembered_tick(self, invocation: SampledInvocation, sampling: FrameSampling) -> int:
        """The newest tick that a frame memory may have a picture of."""
        query = invocation.reference.query
        if sampling.until == "observation":
            return invocation.tick
        return 0 if query is None else self.schedule.queries[query].tick

    @property
    def frames(self) -> tuple[Tensor | None, ...]:
        """The images of each row."""
        if self.images is None:
            return (None,) * len(self.rows)
        return self.images.split([row.num_images for row in self.rows])


def make_example(
    episode: TrainingEpisode, form: ContextFormat, config: ExampleConfig, rng: np.random.Generator
) -> Example:
    """Samples a schedule and builds the example under it, with the demonstration's views that the format reads."""
    if not form.remembers:
        episode = replace(episode, demo=())
    if (num_views := form.demonstrations.num_views) is not None:
        num_images = form.reader.num_images(num_views)
        episode = replace(episode, demo=tuple(images[:num_images] for images in episode.demo))
    clocks = config.clocks
    if config.delay_up_to_ns:
        mean_ns = int(rng.integers(config.delay_up_to_ns, endpoint=True))
        clocks = replace(clocks, delay=replace(clocks.delay, mean_ns=mean_ns))
    schedule = sample_schedule(rng, clocks, episode.num_ticks, transition_ticks=episode.transition_ticks)
    imitated = [each for each in schedule.invocations if each.tick >= episode.imitated_from]
    count = min(config.max_invocations, len(imitated))
    weights = None if config.branch_weight == 1 else _weights(episode, imitated, config.branch_weight)
    chosen = np.sort(rng.choice(len(imitated), size=count, replace=False, p=weights)) if count else np.empty(0, np.intp)
    invocations = tuple(imitated[index] for index in chosen)
    written = subgoals_by_query(episode, form, schedule) if config.is_grounded else ("",) * len(schedule.queries)
    newest = ["" if each.reference.query is None else written[each.reference.query] for each in invocations]
    return Example(
        episode=episode,
        rows=rows_of(episode, form, schedule, config),
        images=row_images(episode, schedule),
        schedule=schedule,
        invocations=invocations,
        written=written,
        told=tuple(told if config.told is None else config.told.draw(told, rng) for told in newest),
    )


def _weights(
    episode: TrainingEpisode, invocations: Sequence[SampledInvocation], branch_weight: float
) -> NDArray[np.float64]:
    """Chances of being drawn, by how long ago the newest transition was."""
    changes = np.array(sorted(episode.transition_ticks | {0}))
    ticks = np.array([each.tick for each in invocations])
    since = ticks - changes[np.searchsorted(changes, ticks, side="right") - 1]
    weights = np.where(since < _BRANCH_TICKS, branch_weight, 1.0)
    chances: NDArray[np.float64] = weights / weights.sum()
    return chances


def rows_of(
    episode: TrainingEpisode, form: ContextFormat, schedule: SampledSchedule, config: ExampleConfig
) -> tuple[Row, ...]:
    """The episode's row, or those of its queries: then each has the text of its own tick."""
    if form.remembers:
        return (episode_row(episode, form, schedule, config),)
    opening, num_views = form.opening(episode.instruction), len(episode.images[0])
    rows = []
    for query in schedule.queries:
        text = _new_text(episode, form, query) if config.is_grounded else ""
        transition = Transition(subgoal=form.vocabulary.encode(text)) if text else None
        rows.append(form.row([*opening, *form.query(num_views, transition, episode.ponder_state(query.tick))]))
    return tuple(rows)


def _new_text(episode: TrainingEpisode, form: ContextFormat, query: SampledQuery) -> str:
    """The subgoal that PONDER is to write at a query; "" for none. Without memory it cannot know whether it is new."""
    is_new = query.stamp.is_transition or not form.remembers
    return normalised_text(episode.subgoals[query.tick]) if is_new else ""


def episode_row(episode: TrainingEpisode, form: ContextFormat, schedule: SampledSchedule, config: ExampleConfig) -> Row:
    """The tokens of the episode. The first transition after a demonstration begins with its reasoning."""
    encode = form.vocabulary.encode
    num_views = len(episode.images[0])
    segments = list(form.opening(episode.instruction, [len(images) for images in episode.demo]))
    reasoning = encode(normalised_text(episode.reasoning)) if config.has_reasoning and episode.reasoning else None
    for query in schedule.queries:
        transition = None
        if config.is_grounded and (text := _new_text(episode, form, query)):
            transition = Transition(subgoal=encode(text), reasoning=reasoning)
            reasoning = None
        segments += form.query(num_views, transition, episode.ponder_state(query.tick))
    return form.row(segments)


def subgoals_by_query(episode: TrainingEpisode, form: ContextFormat, schedule: SampledSchedule) -> tuple[str, ...]:
    """The newest subgoal at every query, as PONDER generates it: with memory it changes at transitions only."""
    texts: list[str] = []
    for query in schedule.queries:
        text = _new_text(episode, form, query)
        texts.append(text or (texts[-1] if texts and form.remembers else ""))
    return tuple(texts)


def row_images(episode: TrainingEpisode, schedule: SampledSchedule) -> Tensor | None:
    """All images of the row, as in `Example.images`: the demonstration's, then every query's."""
    instants = [*episode.demo, *(episode.images[query.tick] for query in schedule.queries)]
    pictures = [picture for images in instants for picture in images]
    return torch.from_numpy(np.stack(pictures)) if pictures else None
