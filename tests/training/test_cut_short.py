"""An episode that counts, told to end sooner: what is said up to there is the same, and then what came at its end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clock.sampling import ROBOMME
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.models.ponder.network import Ponder
from dual_system.tasks.environment import make_environment
from dual_system.training.cut_short import Cut, cuts
from dual_system.training.events import EVENT_ROWS
from dual_system.training.example import ExampleConfig, make_example
from dual_system.training.training_episode import TrainingEpisode

FORM = Ponder.random(replace(tiny_cpu(), image_px=(32, 32)), seed=1).format
STINT = 40  # ticks of each subgoal


def told(instruction: str, *texts: str) -> TrainingEpisode:
    """An episode whose subgoals take equally long. Its pictures tell their tick."""
    num_ticks = STINT * len(texts)
    return TrainingEpisode(
        instruction=instruction,
        demo=(),
        frames=[(np.full((32, 32, 3), tick % 256, np.uint8),) * 2 for tick in range(num_ticks)],
        state_T8=np.repeat(np.arange(num_ticks, dtype=np.float32)[:, None], 8, axis=1),
        action_T8=np.zeros((num_ticks, 8), np.float32),
        subgoals=[texts[tick // STINT] for tick in range(num_ticks)],
        is_transition_T=np.arange(num_ticks) % STINT == 0,
    )


def picks(times: str) -> str:
    return f"pick up the red cube and place it on the target{times}, then press the button to stop"


def swings(rest: str) -> str:
    begin = "pick up the red cube, move it to the top of the right-side target, then "
    return f"{begin}{rest}, finally press the button to stop"


PICKING = told(
    picks(", repeating this action three times"),
    "pick up the red cube at <9, 9> for the first time",
    "place the red cube onto the target at <50, 60>",
    "pick up the red cube at <50, 61> for the second time",
    "place the red cube onto the target at <50, 60>",
    "pick up the red cube at <50, 62> for the third time",
    "place the red cube onto the target at <50, 60>",
    "press the button at <90, 90> to stop",
)
SWINGING = told(
    swings("move it to the top of the left-side target, repeating this back-and-forth motion two times"),
    "pick up the red cube at <9, 9>",
    "move to the top of the right-side target at <50, 60> for the first time",
    "move to the top of the left-side target at <50, 160> for the first time",
    "move to the top of the right-side target at <50, 60> for the second time",
    "move to the top of the left-side target at <50, 160> for the second time",
    "put the red cube on the table",
    "press the button at <90, 90>",
)
FILLING = told(
    "put two blue cubes and one green cube into the bin, then press the button to stop",
    "pick up the first green cube at <9, 9>",
    "put it into the bin at <50, 60>",
    "pick up the first blue cube at <20, 30>",
    "put it into the bin at <50, 60>",
    "pick up the second blue cube at <30, 40>",
    "put it into the bin at <50, 60>",
    "press the button at <90, 90>",
)
COUNTING = (PICKING, SWINGING, FILLING)


def cuts_of(episode: TrainingEpisode) -> list[Cut]:
    return cuts(episode.instruction, episode.subgoals, episode.is_transition_T)


@pytest.mark.parametrize(
    ("episode", "expected"),
    [
        (PICKING, [picks(""), picks(", repeating this action two times")]),
        (SWINGING, [swings("put it down on the left-side target")]),
        (
            FILLING,
            [
                "put one green cube into the bin, then press the button to stop",
                "put one blue cube and one green cube into the bin, then press the button to stop",
            ],
        ),
    ],
)
def test_the_instruction_asks_for_the_rounds_that_were_done(episode: TrainingEpisode, expected: list[str]) -> None:
    assert [cut.instruction for cut in cuts_of(episode)] == expected


@pytest.mark.parametrize(
    ("name", "episode"), [("PickXtimes", PICKING), ("SwingXtimes", SWINGING), ("BinFill", FILLING)]
)
def test_instructions_are_worded_as_the_task_does(name: str, episode: TrainingEpisode) -> None:
    env = make_environment(name, render=False)
    worded = set()
    for seed in range(150):
        env.reset(seed)
        worded.add(env.instruction)
    assert {episode.instruction, *(cut.instruction for cut in cuts_of(episode))} <= worded


@pytest.mark.parametrize("episode", COUNTING)
def test_up_to_its_end_all_is_as_it_was_and_then_what_came_at_last(episode: TrainingEpisode) -> None:
    last = next(text for text in episode.subgoals if text.startswith(("press", "put the")))
    for cut in cuts_of(episode):
        made = episode.cut_short(cut)
        assert list(made.subgoals[: cut.end]) == list(episode.subgoals[: cut.end])
        assert set(made.subgoals[cut.end : cut.shown]) == {last}
        assert made.is_transition_T[cut.end]
        assert not made.is_transition_T[cut.end + 1 : cut.shown].any()
        np.testing.assert_array_equal(made.state_T8[: cut.shown, 0], np.arange(cut.shown))
        assert made.subgoals[-1] == episode.subgoals[-1]
        assert made.words[0] == episode.words[0]


def test_a_plan_tells_no_more_than_is_asked_for() -> None:
    shortest, longer = (FILLING.cut_short(cut).with_plans() for cut in cuts_of(FILLING))
    assert shortest.words[STINT] == "put it into the bin at <50, 60>, <90, 90>"
    assert longer.words[STINT] == "put it into the bin at <50, 60>, <20, 30>, <90, 90>"


@given(seed=st.integers(0, 10_000), which=st.sampled_from(COUNTING))
@settings(deadline=None, max_examples=40)
def test_nothing_is_seen_or_imitated_of_what_the_arm_did_otherwise(seed: int, which: TrainingEpisode) -> None:
    config = ExampleConfig(clocks=ROBOMME, cuts_short=1.0, has_foresight=True, has_plans=True)
    example = make_example(which, FORM, config, np.random.default_rng(seed))
    (cut,) = [cut for cut in cuts_of(which) if cut.instruction == example.episode.instruction]
    assert all(query.tick < cut.shown for query in example.schedule.queries)
    assert example.schedule.queries[-1].tick >= cut.end  # the words at its end are learned
    assert all(each.tick + EVENT_ROWS <= cut.end for each in example.schedule.invocations)
    end = next(query for query in example.schedule.queries if query.tick >= cut.end)
    assert normalised_text(which.subgoals[-1]).split(" at ")[0] in example.said[-1] or "put the" in example.said[-1]
    assert end.stamp.is_transition


def test_what_does_not_count_or_never_ends_is_left_as_it_is() -> None:
    once = told(picks(""), "pick up the red cube at <9, 9> for the first time", "press the button at <90, 90> to stop")
    assert cuts_of(once) == []
    assert cuts_of(replace(PICKING, instruction="press the button")) == []
    unfinished = replace(PICKING, subgoals=[*PICKING.subgoals[:-STINT], *[PICKING.subgoals[0]] * STINT])
    assert cuts_of(unfinished) == []


def test_a_corrected_episode_is_cut_only_where_it_is_imitated() -> None:
    corrected = replace(PICKING, imitated_from=3 * STINT)
    config = ExampleConfig(clocks=ROBOMME, cuts_short=1.0, has_foresight=True)
    for seed in range(10):
        example = make_example(corrected, FORM, config, np.random.default_rng(seed))
        assert example.episode.instruction == picks(", repeating this action two times")
