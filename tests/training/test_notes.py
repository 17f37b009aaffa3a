"""Notes: where what moves by itself is at every look; told of one instant, put right, and as serving writes them."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from dual_system.tasks.front_view import front_pixels
from dual_system.tasks.paces import PASS_STEPS
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION
from dual_system.models.eyes import Eye
from dual_system.models.place_code import NUM_PLACE_FEATURES, place_features
from dual_system.models.ponder.context import IGNORE, Row
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.tasks.counting.stop_cube import StopCube
from dual_system.tasks.environment import make_environment
from dual_system.tasks.swaps import SWAP_STEPS
from dual_system.training.countdown import as_place, stood_at, waits
from dual_system.training.example import ExampleConfig, Slip, make_example
from dual_system.training.notes import (
    demo_notes,
    ends_of_moves,
    heeded,
    in_sight,
    misnoted,
    moving_places,
    noted,
    told_wait,
)
from dual_system.training.places import PARTS, PLACE, TEXT_PX, apart_px
from dual_system.training.stand_in import stand_in, text_code
from dual_system.training.training_episode import TrainingEpisode
from tests.training.test_countdown import FORM, HOVER, PRESS, STILL, waiting_episode

ASKED = "press the button to stop the cube just as it reaches the target for the third time"
TEXTS = [HOVER] * 30 + [STILL] * 240 + [PRESS] * 30  # it comes by every 120 steps
MOVING = [f"<{50 + tick // 5}, 100>" for tick in range(len(TEXTS))]


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


def running_episode() -> TrainingEpisode:
    return replace(waiting_episode(TEXTS, (0, 30, 270)), instruction=ASKED, moving=MOVING)


@pytest.mark.parametrize(
    ("task", "bodies"), [("StopCube", ["shuttle"]), ("ButtonUnmaskSwap", [f"container_{n}" for n in range(4)])]
)
def test_places_are_where_the_simulator_shows_things(task: str, bodies: list[str]) -> None:
    """Told of the seed alone; containers once they have come down."""
    for seed in (11, 13):
        environment = make_environment(task, render=False)
        hold = environment.reset(seed).command
        told = moving_places(task, seed, environment.difficulty, 130)
        assert all(told[:64])
        for step in range(130):
            if step >= 32 and told[step]:
                points_m = np.array([environment.physics.position_m(body) for body in bodies])
                points_m[:, 2] = points_m[:, 2].clip(max=0.038)  # texts tell the middle of what is seen of a container
                seen_N2 = front_pixels(points_m, TEXT_PX)
                for place in re.finditer(rf"(?<! to ){PLACE.pattern}", told[step]):
                    away_px = np.hypot(*(seen_N2 - [int(place[1]), int(place[2])]).T).min()
                    assert away_px < 1.5
            environment.step(hold, look=False)
        environment.close()


@pytest.mark.parametrize("difficulty", ["easy", "medium", "hard"])
@pytest.mark.parametrize("seed", [3, 5, 8])
def test_who_is_on_its_way_is_told_to_where_the_swap_leaves_it(seed: int, difficulty: str) -> None:
    """Law: what stands behind "to" is where the thing is when the swap that is going on is over; it is never a guess of
    what comes after, and nobody at rest has any."""
    told = moving_places("VideoUnmaskSwap", seed, difficulty, 400)
    end = max(step for step, note in enumerate(told) if note)
    num_underway = 0
    for step, note in enumerate(told[:end]):
        over = min(64 + -(-(step - 64) // SWAP_STEPS) * SWAP_STEPS, end)
        for nth, part in enumerate(PARTS.split(note) if note else ()):
            _, _, rest = part.partition(" to ")
            if rest:
                num_underway += 1
                assert 64 < step < over
                assert rest == PARTS.split(told[over])[nth]
            else:
                left_px = apart_px(part, PARTS.split(told[over])[nth])
                has_just_left = step <= 64 or (step - 64) % SWAP_STEPS < SWAP_STEPS // 2
                assert has_just_left or left_px is None or left_px <= 3
    assert num_underway or all(len(PARTS.split(note)) == 1 for note in told if note)


def test_where_watched_things_rest_before_and_after_is_read_off_the_captions() -> None:
    """They move for a while, rest for a moment, and move on; what is not watched stays as it was."""
    ways = [*range(50, 80, 2), 80, 80, 80, 80, 80, *range(80, 101, 2)]
    texts = ["pick up the cube at <1, 2>", *(f"static at <{y}, 9>, <5, 6>" for y in (50, 50, 50, *ways, 100, 100, 100))]
    last, coming = ends_of_moves(texts)
    assert last[0] == coming[0] == texts[0]
    middle = texts.index("static at <66, 9>, <5, 6>")
    assert last[middle].startswith("static at <50, 9>, <5, 6>")
    assert coming[middle] == "static at <80, 9>, <5, 6>"
    onward = texts.index("static at <90, 9>, <5, 6>")
    assert last[onward] == "static at <80, 9>, <5, 6>"
    assert coming[onward] == "static at <100, 9>, <5, 6>"
    assert coming[1] == texts[1]
    seen_late = ["static at <1, 2>", "static at <1, 2>, <3, 4>"]
    assert ends_of_moves(seen_late) == (seen_late, seen_late), "something comes into sight"
    assert ends_of_moves(["static at "]) == (["static at "],) * 2


def test_what_has_come_to_rest_is_told_for_one_more_look() -> None:
    told = moving_places("ButtonUnmask", 3, "easy", 200)
    assert all(told[:90])
    assert len(set(told[:32])) == len(set(told[32:90])) == 1, "the cube, then its container, which is higher"
    assert not any(told[90:])


def test_nothing_is_told_of_a_task_that_nobody_knows_or_where_nothing_moves() -> None:
    assert moving_places("SomebodyElses", 0, "easy", 3) == ["", "", ""]
    assert moving_places("PickHighlight", 0, "easy", 3) == ["", "", ""]
    assert moving_places("StopCube", 0, "mixed", 3) == ["", "", ""], "an album: a scene for every picture"


def test_a_machine_without_mujoco_trains_and_follows_nothing() -> None:
    """And a recipe that takes notes says what it needs."""
    program = """
import sys
sys.modules["mujoco"] = None
from dual_system.training import recipes, train
from dual_system.training.notes import moving_places
assert moving_places("StopCube", 3, "easy", 2) == ["", ""]
try:
    train.build(recipes.recipe("small_noting").stages[-1], None, None)
except ValueError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "takes notes" in done.stdout, done.stderr
    assert "pip install mujoco" in done.stdout


def test_what_is_out_of_sight_is_not_noted() -> None:
    eyes = (Eye(camera=0, box=(0.0, 0.25, 0.5, 0.75)), Eye(camera=1))
    assert in_sight("<127, 64>, <128, 64>, <0, 191>, <0, 192>, <3, 63>", eyes) == "<127, 64>, <0, 191>"
    assert in_sight("<200, 200>", None) == "<200, 200>"
    assert in_sight("", eyes) == ""
    assert in_sight("second <3, 63>", eyes) == "second", "it happened all the same"
    assert in_sight("second <3, 64>", eyes) == "second <3, 64>"
    assert in_sight("second <3, 63> to <3, 64>, second <3, 64> to <3, 63>", eyes) == "second to <3, 64>, second <3, 64>"
    assert in_sight("<3, 64> to <3, 65>, <4, 64> to <3, 1>, <3, 1> to <5, 64>, <3, 1> to <3, 2>", eyes) == (
        "<3, 64> to <3, 65>, <4, 64>, <5, 64>"
    )


def test_the_cube_that_was_shown_is_noted_from_when_the_tool_is_at_it() -> None:
    texts = ["pick up the cube at <90, 120>"] * 3 + ["drop the cube on the table at <80, 121>, <60, 60>"]
    texts += ["static at <90, 120>, <60, 60>", "static at <99, 110>, <60, 60>"]
    tools = ["<20, 128>", "<85, 122>", "<70, 122>", "<70, 122>", "<20, 128>", "<20, 128>"]
    expected = ["", "<90, 120>", "<90, 120>", "<80, 121>", "<90, 120>", "<99, 110>"]
    assert demo_notes(texts, tools, [""] * 6) == expected
    assert demo_notes(texts[:1], tools[:1], [""]) == ["<90, 120>"], "no later than it is done"
    assert demo_notes(texts, tools, ["<1, 2>"] * 6) == ["<1, 2>"] * 6, "the clock alone tells it"
    assert demo_notes(texts, (), [""] * 6) == [""] * 6, "nobody says where the tool is"
    moves = ([*texts[:5], texts[4]], [*texts[:5], "static at <130, 100>, <60, 60>"])
    assert demo_notes(texts, tools, [""] * 6, moves) == [*expected[:5], "<99, 110> to <130, 100>"], "on its way"


def test_deeds_are_noted_when_the_tool_is_there_and_a_target_from_then_on() -> None:
    texts = ["pick up the cube at <90, 120>", *["drop the cube onto target at <100, 60>"] * 3]
    texts += ["press the button at <120, 128>", "pick up the cube at <98, 60>"]
    texts += ["drop the cube onto target at <80, 170>", "drop the cube onto table at <60, 128>, <80, 170>"]
    texts += ["static at <82, 128>, <80, 170>", "static at <82, 128>, <90, 150>"]
    tools = ["<85, 120>", "<70, 90>", "<95, 62>", "<90, 60>", "<50, 90>", "<95, 60>"]
    tools += ["<40, 140>", "<50, 128>", "<20, 128>", "<20, 128>"]
    expected = ["", "", "first <100, 60>", "", "button", "", "second <80, 170>", ""]
    then = ["second <80, 170>", "second <90, 150>"]
    assert demo_notes(texts, tools, [""] * 10) == [*expected, *then], "which of them was asked for, wherever it moves"
    moves = (texts, [*texts[:9], "static at <82, 128>, <110, 90>"])
    underway = demo_notes([*texts[:9], "static at <82, 128>, <90, 150>"], tools, [""] * 10, moves)
    assert underway[8:] == [then[0], "second <90, 150>"], "it cannot be seen to have left"
    moves = ([*texts[:9], texts[8]], [*texts[:9], "static at <82, 128>, <110, 90>"])
    assert demo_notes(texts, tools, [""] * 10, moves)[8:] == [then[0], "second <90, 150> to <110, 90>"]
    first = [*texts[:8], "static at <82, 128>, <101, 61>", "static at <82, 128>, <101, 61>"]
    assert demo_notes(first, tools, [""] * 10)[8:] == ["first <101, 61>"] * 2
    nobody = [*texts[:8], "static at <82, 128>, <30, 30>", "static at <82, 128>, <30, 30>"]
    assert demo_notes(nobody, tools, [""] * 10)[8:] == ["<30, 30>"] * 2, "nothing was put there"


def test_stretches_of_a_way_are_noted_where_they_end() -> None:
    texts = [*["move backward to <66, 172>, then <52, 148>"] * 3, *["move backward-right to <52, 148>"] * 2]
    tools = ["<95, 172>", "<85, 172>", "<76, 172>", "<64, 170>", "<56, 158>"]
    expected = ["", "", "", "1 backward <66, 172>", "2 backward-right <52, 148>"]
    assert demo_notes(texts, tools, [""] * 5) == expected, (
        "the first ends between two looks, and is nearer to the second"
    )
    tools[2] = "<68, 172>"
    assert demo_notes(texts, tools, [""] * 5) == ["", "", expected[3], "", expected[4]]
    both = demo_notes([texts[0], texts[3]], [tools[0], "<60, 160>"], ["", ""])
    assert both == ["", f"{expected[3]}, {expected[4]}"], "what fell between the same two looks is told at once"


AROUND_AND_BACK = [
    f"move to the nearest {way} to {ends}"
    for way, ends, instants in (
        ("left target by circling around the stick clockwise", "<89, 167>, then clockwise to <89, 130>", 4),
        ("right target by circling around the stick clockwise", "<89, 130>", 2),
    )
    for _ in range(instants)
]


def test_the_side_on_which_a_way_passes_is_noted_when_it_is_seen() -> None:
    texts, back = AROUND_AND_BACK, "<89, 130>"
    tools = ["<85, 132>", "<58, 140>", "<56, 151>", "<80, 165>", "<103, 148>", "<88, 133>"]
    expected = ["", "", "1 left backward", "1 left backward <89, 167>", "2 right forward", f"2 right forward {back}"]
    assert demo_notes(texts, tools, [""] * 6) == expected
    at_once = demo_notes(texts[3:], tools[3:], [""] * 3)
    assert at_once == ["1 left backward <89, 167>", *expected[4:]], "no instant is left for the side alone"
    straight = ["move left to <89, 167>"] * 3
    assert demo_notes(straight, tools[1:4], [""] * 3) == ["", "", "1 left <89, 167>"], "it goes around nothing"


def test_the_end_of_a_stretch_that_is_shown_to_its_middle_alone_is_not_noted() -> None:
    """Until then a stretch that goes on looks the same, and of that the side alone is noted."""
    texts, back = AROUND_AND_BACK, "<89, 130>"
    tools = ["<85, 132>", "<58, 140>", "<56, 151>", "<80, 165>", "<100, 160>", "<103, 152>"]
    begun = ["", "", "1 left backward", "1 left backward <89, 167>"]
    assert demo_notes(texts, tools, [""] * 6) == [*begun, "", "2 right forward"]
    tools[4:] = "<103, 150>", "<98, 138>"
    assert demo_notes(texts, tools, [""] * 6) == [*begun, "2 right forward", f"2 right forward {back}"], (
        "it was past its middle"
    )


def test_a_stretch_that_ends_where_it_began_is_not_over_at_once() -> None:
    texts = [*["move left to <50, 50>, then <52, 52>"] * 2, *["move right to <52, 52>"] * 2]
    tools = ["<90, 90>", "<70, 70>", "<51, 51>", "<60, 60>"]
    assert demo_notes(texts, tools, [""] * 4) == ["", "", "1 left <50, 50>", "2 right <52, 52>"]


def test_where_nothing_was_put_or_picked_up_to_be_asked_for_nothing_is_noted() -> None:
    texts = [
        "Pick up the cube at <84, 129>",
        "place the cube onto the target at <113, 108>",
        "static at <9, 9>, <8, 8>",
    ]
    assert demo_notes(texts, ["<84, 129>", "<113, 108>", "<9, 9>"], [""] * 3) == [""] * 3


def test_what_is_told_to_move_is_of_the_picture_that_is_shown() -> None:
    shown_at_T = np.arange(300) // 20 * 20
    assert running_episode().as_seen(shown_at_T).moving == [MOVING[tick] for tick in shown_at_T]


def numbers(text: str) -> list[int]:
    """The pace and the wait of a note."""
    return [int(each) for each in PLACE.sub("", text).split(", ") if each.isdecimal()]


def test_notes_tell_place_pace_and_wait_of_their_own_instant() -> None:
    told = noted(ASKED, TEXTS, MOVING)
    assert told[0] == f"{HOVER}, <50, 100>", "how fast it runs nobody can tell yet"
    assert told[30] == f"{STILL}, <56, 100>, 120, 240"
    assert {tick + numbers(told[tick])[1] for tick in range(30, 270)} == {270}
    assert not any(told[270:]), "who has waited is told no more"
    assert noted(ASKED, TEXTS, [""] * 300)[29:31] == ["", f"{STILL}, 120, 240"], "out of sight it runs on"


def test_what_changes_places_is_noted_behind_the_subgoal() -> None:
    assert noted("press it", ["press", "press", ""], ["<1, 2>, <3, 4>", "", "<1, 2>"]) == [
        "press, <1, 2>, <3, 4>",
        "",
        "",
    ]


@given(seed=st.integers(0, 1000), ticks=st.lists(st.integers(0, 299), min_size=1, unique=True).map(sorted))
def test_a_wrong_pace_is_that_of_another_scene_and_is_put_right(seed: int, ticks: list[int]) -> None:
    wrong = misnoted(ASKED, TEXTS, MOVING, ticks, np.random.default_rng(seed))
    paced = [bool(30 <= tick < 270) for tick in ticks]
    assert all(is_paced for text, is_paced in zip(wrong, paced, strict=True) if text)
    found = [(tick, *numbers(text)) for tick, text in zip(ticks, wrong, strict=True) if text]
    assert len({pace for _, pace, _ in found}) <= 1
    for tick, pace, wait in found:
        assert pace in set(PASS_STEPS) - {120}
        assert tick + wait == 2.5 * pace - 30, "the instant that a cube of this pace would be stopped at"
        assert wait > 0
    places = [text.split(", 100>")[0] for text in wrong if text]
    right = [noted(ASKED, TEXTS, MOVING)[tick].split(", 100>")[0] for tick, *_ in found]
    assert places == right, "where it is is told rightly all the same"


def test_the_row_tells_notes_at_every_look_and_c_what_is_right() -> None:
    config = ExampleConfig(clocks=EVALUATION, takes_notes=True)
    example = make_example(running_episode(), FORM, config, np.random.default_rng(0))
    assert example.words is not None
    told = noted(ASKED, TEXTS, MOVING)
    for query, words in zip(example.schedule.queries, example.words, strict=True):
        if told[query.tick]:
            assert (words.text, words.is_due, words.is_learned) == (told[query.tick], True, True)
    assert sum(bool(words.text) for words in example.words) > 10
    misled = make_example(running_episode(), FORM, replace(config, misjudges=1.0), np.random.default_rng(0))
    assert misled.words is not None
    unlearned = [words.text for words in misled.words if not words.is_learned]
    assert 0 < len(unlearned) < len(misled.words)
    assert all(numbers(text)[0] != 120 for text in unlearned)
    row = misled.row()
    gates = np.asarray(row.targets)[row.gate_index + 1]
    assert (gates == FORM.vocabulary.t_yes).sum() == sum(bool(words.text) for words in misled.words)
    np.testing.assert_array_equal(misled.stand_ins(128), example.stand_ins(128))


def test_c_that_trusts_counts_tells_the_wait_of_the_words_right_or_wrong() -> None:
    config = ExampleConfig(clocks=EVALUATION, takes_notes=True, misjudges=1.0, trusts_counts=True)
    example = make_example(running_episode(), FORM, config, np.random.default_rng(0))
    assert example.words is not None
    left, found = waits(TEXTS), {True: 0, False: 0}
    for query, words, told in zip(example.schedule.queries, example.words, example.stand_ins(128), strict=True):
        wait = left[query.tick]
        if wait is None or TEXTS[query.tick] != STILL:
            continue
        said = told_wait(words.text)
        assert said is not None
        assert said == (wait if words.is_learned else numbers(words.text)[1])
        believed = f"{STILL} until {as_place(said)}"
        np.testing.assert_array_equal(told, stand_in(believed, 128, ASKED, stood_at(TEXTS)[query.tick]))
        found[words.is_learned] += 1
    assert all(found.values()), "right ones and wrong ones"


def test_places_in_mind_are_those_that_notes_tell() -> None:
    config = ExampleConfig(clocks=EVALUATION, takes_notes=True)
    example = make_example(running_episode(), FORM, config, np.random.default_rng(0))
    row = example.row()
    lessons = example.place_lessons(row, 128)
    query = next(n for n, query in enumerate(example.schedule.queries) if TEXTS[query.tick] == STILL)
    is_there = (lessons.index_M == row.gate_index[query]) & (lessons.first_M == 0)
    y, x = PLACE.search(MOVING[example.schedule.queries[query].tick]).groups()  # type: ignore[union-attr]
    np.testing.assert_array_equal(lessons.features_MP[is_there][0], place_features((int(y), int(x))))


def test_while_pace_and_count_are_told_they_are_in_mind() -> None:
    example = make_example(running_episode(), FORM, ExampleConfig(clocks=EVALUATION, takes_notes=True), _rng())
    row = example.row()
    lessons = example.place_lessons(row, 4 * NUM_PLACE_FEATURES)
    told = {
        (index, first): features
        for index, first, features in zip(
            lessons.index_M.tolist(), lessons.first_M.tolist(), lessons.features_MP.numpy(), strict=True
        )
    }
    last = 3 * NUM_PLACE_FEATURES
    found = 0
    for gate, note in zip(row.gate_index.tolist(), example.notes, strict=True):
        if len(numbers(note)) < 2:
            continue
        pace, wait = numbers(note)[-2:]
        end = gate + 1 + len(FORM.vocabulary.encode(normalised_text(note)))  # its last digit; T_yes stands before
        digits = len(FORM.vocabulary.encode(str(wait)))
        for index in range(end - digits, end):
            as_told = place_features((min(wait / 4, 255), min(wait, 255)))
            np.testing.assert_array_equal(told[index, 0], as_told)
        assert (end - digits - 1, 0) not in told, "before the comma no number is due"
        comma = end - digits - 1  # and before it is the last digit of the pace
        of_pace = [*range(comma - 1 - len(FORM.vocabulary.encode(str(pace))), comma - 1)]
        assert [index for index in range(gate + 1, end) if (index, last) in told] == of_pace
        code = text_code(f"comes by every {pace} steps", NUM_PLACE_FEATURES)
        assert all(np.array_equal(told[index, last], code) for index in of_pace)
        found += 1
    assert found > 5


def test_notes_that_repeat_the_one_before_are_learned_now_and_then() -> None:
    notes = ["<1, 2>", "<1, 2>", "", "<1, 2>", "<3, 4>", *["<3, 4>"] * 1000]
    told = heeded(notes, 0.3, _rng())
    assert [told[at] for at in (0, 3, 4)] == [True] * 3
    assert 200 < sum(told[5:]) < 400
    assert all(heeded(notes, 1.0, _rng()))
    assert heeded(notes[:5], 0.0, _rng()) == [True, False, True, True, True]


def test_what_is_not_heeded_stands_in_the_row_all_the_same() -> None:
    still = [f"<{80 + tick // 150}, 100>" for tick in range(len(TEXTS))]
    asked = replace(running_episode(), instruction="press it", moving=still)
    shown = replace(asked, demo=shown_episode().demo, demo_notes=("<10, 20>", "<10, 20>", "<12, 22>"))
    config = ExampleConfig(clocks=EVALUATION, takes_notes=True, learned_repeats=0.0)
    thinned = make_example(shown, TAKING, config, _rng())
    whole = make_example(shown, TAKING, replace(config, learned_repeats=1.0), _rng())
    assert thinned.heeded_demo == (True, False, True)
    assert thinned.row().ids == whole.row().ids
    assert [learned for _, learned in between_looks_learned(thinned.row())] == [True, False, True]
    assert all(learned for _, learned in between_looks_learned(whole.row()))
    words = [each for each in thinned.words or () if each.text]
    repeats = [now.text == before.text for before, now in pairwise(words)]
    assert any(repeats)
    assert not all(repeats)
    assert [each.is_learned for each in words[1:]] == [not repeats_it for repeats_it in repeats]
    gates = [np.asarray(each.row().targets)[each.row().gate_index + 1] for each in (thinned, whole)]
    np.testing.assert_array_equal(*gates)  # that something is said is learned


def test_without_the_setting_nothing_is_noted() -> None:
    config = ExampleConfig(clocks=EVALUATION)
    with_moving = make_example(running_episode(), FORM, config, np.random.default_rng(0))
    without = make_example(replace(running_episode(), moving=()), FORM, config, np.random.default_rng(0))
    assert with_moving.row().ids == without.row().ids


NOTES = ["<10, 20>", "", "<12, 22>"]
TAKING = replace(FORM, takes_notes=True)


def shown_episode() -> TrainingEpisode:
    picture = (np.zeros((32, 32, 3), np.uint8),) * 2
    return replace(waiting_episode(["pick it up at <12, 22>"] * 60, (0,)), demo=(picture,) * 3, demo_notes=NOTES)


def shown_row(*, slip: Slip | None = None, is_grounded: bool = True) -> Row:
    example = make_example(shown_episode(), TAKING, ExampleConfig(clocks=EVALUATION), np.random.default_rng(0))
    return replace(example, slip=slip, is_grounded=is_grounded).row()


def between_looks(row: Row) -> list[tuple[str, list[int]]]:
    """What is written after each look of the demonstration, and the targets of that and of the next token."""
    v = FORM.vocabulary
    ends = [index for index, each in enumerate(row.ids) if each == v.vision_end][: 2 * 3 + 1][1::2]  # two views a look
    found = []
    for end in ends:
        stop = next(i for i in range(end + 1, len(row.ids)) if row.ids[i] in (v.vision_start, v.im_end))
        ids = row.ids[end + 1 : stop]
        text = v.decode(list(ids[1:])) if ids else ""
        found.append((text, list(row.targets[end + 1 : stop + 1])))
    return found


def between_looks_learned(row: Row) -> list[tuple[str, bool]]:
    """What is written after each look, and whether its words, and not just that there are any, are targets."""
    return [(text, targets[1] != IGNORE) for text, targets in between_looks(row) if text]


def test_a_demonstration_is_noted_look_by_look() -> None:
    v = FORM.vocabulary
    for (text, targets), note in zip(between_looks(shown_row()), NOTES, strict=True):
        assert text == normalised_text(note)
        assert targets == [*([v.t_yes, *v.encode(text)] if note else []), v.t_no]


def test_notes_that_slip_are_read_and_not_learned_and_rows_without_words_have_none() -> None:
    v = FORM.vocabulary
    slipped = between_looks(shown_row(slip=Slip(std_px=20.0, seed=1)))
    assert [bool(text) for text, _ in slipped] == [True, False, True]
    for (text, targets), note in zip(slipped, NOTES, strict=True):
        assert not note or text != normalised_text(note)
        assert targets[-1] == v.t_no
        assert set(targets[:-1]) <= {v.t_yes, IGNORE}
    assert [text for text, _ in between_looks(shown_row(is_grounded=False))] == ["", "", ""]
    assert all(set(targets) == {IGNORE} for _, targets in between_looks(shown_row(is_grounded=False)))


def test_who_takes_no_notes_reads_the_row_as_it_was() -> None:
    example = make_example(shown_episode(), FORM, ExampleConfig(clocks=EVALUATION), np.random.default_rng(0))
    bare = make_example(
        replace(shown_episode(), demo_notes=()), FORM, ExampleConfig(clocks=EVALUATION), np.random.default_rng(0)
    )
    assert example.row().ids == bare.row().ids
    assert FORM.vocabulary.t_no not in [target for _, targets in between_looks(example.row()) for target in targets]


def test_the_cube_of_a_scene_comes_back_at_its_pace() -> None:
    """A whole pass there and back: the same place again."""
    seed = 5
    layout = StopCube().sample(np.random.default_rng(seed), "easy")
    told = moving_places("StopCube", seed, "easy", 4 * layout.pass_steps)
    both_ways = 2 * layout.pass_steps
    assert told[both_ways : both_ways + 20] == told[:20]
    assert any(first != second for first, second in pairwise(told))
