"""Rows that end before their episode does.

Most of what a first look shows takes one look to say, and a row of one look is a fifth of a whole one.
"""

# T tokens

from __future__ import annotations

from dataclasses import replace

from clock.sampling import SampledSchedule
from dual_system.models.ponder.context import IGNORE, Row
from dual_system.training.training_episode import TrainingEpisode


def shortened(schedule: SampledSchedule, max_queries: int | None) -> SampledSchedule:
    """Only the first queries, and the invocations before the next one."""
    if max_queries is None or max_queries >= len(schedule.queries):
        return schedule
    end = schedule.queries[max_queries].tick
    return SampledSchedule(
        queries=schedule.queries[:max_queries],
        invocations=tuple(each for each in schedule.invocations if each.tick < end),
    )


def is_noted_at_once(episode: TrainingEpisode) -> bool:
    """Whether there is anything to write down at the first look at its demonstration, and not at the second.

    What moves is noted at every look, and a row of one would teach the least of it.
    """
    return bool(episode.demo) and any(episode.demo_notes[:1]) and not any(episode.demo_notes[1:2])


def glanced(episode: TrainingEpisode) -> TrainingEpisode:
    """The same, of its demonstration only the first look. Nobody could tell from it what is to be done: its words are
    gone."""
    return replace(
        episode,
        demo=episode.demo[:1],
        demo_notes=episode.demo_notes[:1],
        demo_subgoals=(),
        demo_tools=(),
        subgoals=[""] * episode.num_ticks,
        unreached=(),
        reasoning="",
        planned=None,
        said=(),
    )


def with_notes_alone(row: Row) -> Row:
    """The row, nothing of which is learned from the first query on."""
    first = row.gate_index[0]
    return replace(row, targets=(*row.targets[:first], *(IGNORE,) * (len(row.targets) - first)))
