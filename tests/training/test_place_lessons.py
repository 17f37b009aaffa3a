"""Places to have in mind: each lesson lies where its place is about to be told, and gradients reach no other number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from clock.sampling import EVALUATION
from dual_system.models.place_code import NUM_PLACE_FEATURES, place_features
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.models.ponder.network import Ponder
from dual_system.training.collate import collate_ponder
from dual_system.training.example import Example, ExampleConfig, make_example
from dual_system.training.joint import encode_rows
from dual_system.training.lapses import Lapses
from dual_system.training.place_lessons import PlaceLessons
from dual_system.training.stand_in import text_code
from dual_system.training.training_episode import TrainingEpisode

PONDER = Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4), seed=1)
FORM, SIZE = PONDER.format, PONDER.hidden_size
CONFIG = ExampleConfig(clocks=EVALUATION, has_plans=True)
PLACES = [(30, 100), (70, 20), (110, 250)]


def episode(num_ticks: int = 180) -> TrainingEpisode:
    stint = np.arange(num_ticks) // 60
    return TrainingEpisode(
        instruction="pick them",
        demo=(),
        frames=[(np.zeros((32, 32, 3), np.uint8),) * 2] * num_ticks,
        state_T8=np.zeros((num_ticks, 8), np.float32),
        action_T8=np.zeros((num_ticks, 8), np.float32),
        subgoals=[f"pick cube {n} at <{PLACES[n][0]}, {PLACES[n][1]}>" for n in stint],
        is_transition_T=np.arange(num_ticks) % 60 == 0,
    )


def lessons_of(example: Example) -> tuple[PlaceLessons, list[tuple[int, int, tuple[int, int]]]]:
    """The lessons, and each as position, slot and the place that is nearest."""
    made = example.place_lessons(example.row(), SIZE)
    codes = np.stack([place_features(place) for place in PLACES])
    nearest = ((made.features_MP[:, None] - torch.from_numpy(codes)) ** 2).sum(-1).argmin(1).tolist()
    slots = (made.first_M // NUM_PLACE_FEATURES).tolist()
    return made, [
        (index, slot, PLACES[place]) for index, slot, place in zip(made.index_M.tolist(), slots, nearest, strict=True)
    ]


def test_the_end_of_every_observation_has_all_places_of_its_words_in_mind() -> None:
    example = make_example(episode(), FORM, CONFIG, np.random.default_rng(0))
    row, (_, found) = example.row(), lessons_of(example)
    for query, gate in zip(example.schedule.queries, row.gate_index.tolist(), strict=True):
        stint = query.tick // 60
        expected = PLACES[stint:]  # also while the first subgoal lasts, whose words tell no plan
        at_gate = sorted((slot, place) for index, slot, place in found if index == gate)
        assert at_gate == list(enumerate(expected))[: SIZE // NUM_PLACE_FEATURES]


def test_a_gate_is_where_the_next_token_says_whether_text_comes() -> None:
    row, v = make_example(episode(), FORM, CONFIG, np.random.default_rng(0)).row(), FORM.vocabulary
    assert len(row.gate_index) == len(row.carrier_index)
    assert {row.targets[gate + 1] for gate in row.gate_index.tolist()} == {v.t_yes, v.t_no}
    texts = sum(row.targets[gate + 1] == v.t_yes for gate in row.gate_index.tolist())
    assert texts == 3


def test_while_a_place_is_told_that_place_is_in_mind() -> None:
    example = make_example(episode(), FORM, CONFIG, np.random.default_rng(0))
    row, (made, found) = example.row(), lessons_of(example)
    gates = set(row.gate_index.tolist())
    told = {index: place for index, slot, place in found if index not in gates and slot == 0}
    assert told
    begins = [index for index in told if index - 1 not in told]
    for begin in begins:
        run = [index for index in range(begin, max(told) + 1) if all(k in told for k in range(begin, index + 1))]
        spelled = FORM.vocabulary.decode([row.ids[index + 1] for index in run])
        assert f"[{spelled}]" == normalised_text(f"<{told[begin][0]}, {told[begin][1]}>")
        assert all(row.targets[index + 1] != IGNORE for index in run)
    features = made.features_MP.numpy()
    errors = [np.abs(features[m] - place_features(told[at])).max() for m, (at, _, _) in enumerate(found) if at in told]
    assert max(errors) < 0.2  # thousandths of the picture are not its pixels


def test_words_that_are_not_learned_are_no_lesson() -> None:
    slipping = replace(CONFIG, lapses=Lapses(rows=1.0, missed=0.0, wrong=0.0, slipped=1.0), retold_px=4.0)
    example = make_example(episode(), FORM, slipping, np.random.default_rng(0))
    gates = set(example.row().gate_index.tolist())
    _, found = lessons_of(example)
    assert found
    assert {index for index, _, _ in found} <= gates


def test_gradients_reach_the_numbers_of_the_slot_alone() -> None:
    example = make_example(episode(), FORM, CONFIG, np.random.default_rng(0))
    batch = collate_ponder([example], place_size=SIZE)
    (hidden_TH,) = (each.detach().requires_grad_() for each in encode_rows(PONDER, batch))
    (lessons,) = batch.place_lessons
    (lessons.answers(hidden_TH) - lessons.features_MP).square().mean().backward()
    assert hidden_TH.grad is not None
    reached = {(int(t), int(h)) for t, h in zip(*torch.where(hidden_TH.grad != 0), strict=True)}
    allowed = {
        (index, first + k)
        for index, first in zip(lessons.index_M.tolist(), lessons.first_M.tolist(), strict=True)
        for k in range(NUM_PLACE_FEATURES)
    }
    assert reached <= allowed
    assert len(reached) > len(allowed) // 2


def test_who_asks_for_none_gets_none() -> None:
    assert collate_ponder([make_example(episode(), FORM, CONFIG, np.random.default_rng(0))]).place_lessons == ()


@pytest.mark.parametrize("num_slots", [1, 2])
def test_places_that_do_not_fit_are_left_out(num_slots: int) -> None:
    example = make_example(episode(), FORM, CONFIG, np.random.default_rng(0))
    made = example.place_lessons(example.row(), num_slots * NUM_PLACE_FEATURES)
    assert int(made.first_M.max()) == (num_slots - 1) * NUM_PLACE_FEATURES


def shown(texts: list[str]) -> TrainingEpisode:
    views = tuple((np.zeros((32, 32, 3), np.uint8),) * 2 for _ in texts)
    return replace(episode(), demo=views, demo_subgoals=texts)


def test_the_end_of_every_picture_of_a_demonstration_has_what_is_done_in_mind() -> None:
    texts = [f"put it onto a target at <{y}, {x}>" for y, x in (PLACES[0], PLACES[0], PLACES[1])] + ["press it"]
    example = make_example(shown(texts), FORM, CONFIG, np.random.default_rng(0))
    row = example.row()
    lessons = example.place_lessons(row, 4 * NUM_PLACE_FEATURES)
    seen = np.flatnonzero(np.asarray(row.ids) == FORM.vocabulary.vision_end)[1 : 2 * len(texts) : 2]  # two views each
    by_place = {
        (index, slot // NUM_PLACE_FEATURES): numbers
        for index, slot, numbers in zip(
            lessons.index_M.tolist(), lessons.first_M.tolist(), lessons.features_MP.numpy(), strict=True
        )
    }
    assert sorted(slot for index, slot in by_place if index < row.gate_index[0]) == sorted(
        [*(0, 2, 3) * 2, *range(4), 1, 2, 3]
    )
    here, before, which, number = range(4)
    for index, place in zip(seen[:3], (PLACES[0], PLACES[0], PLACES[1]), strict=True):
        np.testing.assert_array_equal(by_place[index, here], place_features(place))
    np.testing.assert_array_equal(by_place[seen[2], before], place_features(PLACES[0]))
    np.testing.assert_array_equal(by_place[seen[3], before], place_features(PLACES[1]))
    for slot in (which, number):
        codes = [by_place[index, slot] for index in seen]
        likeness = np.corrcoef(np.stack(codes))
        assert np.array_equal(codes[0], codes[1])
        assert np.abs(likeness[1:, 1:] - np.eye(3)).max() < 0.7


def test_a_demonstration_of_which_nobody_says_what_it_does_has_no_lessons() -> None:
    recorded = replace(shown(["a", "b"]), demo_subgoals=())
    example = make_example(recorded, FORM, CONFIG, np.random.default_rng(0))
    row = example.row()
    assert example.place_lessons(row, SIZE).index_M.min() >= row.gate_index[0]


def test_where_a_way_is_shown_the_last_image_token_has_the_tool_in_mind() -> None:
    (y, x), (v, u) = PLACES[:2]
    way = f"circle around it clockwise to <{y}, {x}>, then clockwise to <{v}, {u}>"
    tools = ["<5, 6>", "<50, 60>", "<200, 210>"]
    going = replace(shown([way, way, "wait there"]), demo_tools=tools)
    example = make_example(going, FORM, CONFIG, np.random.default_rng(0))
    row = example.row()
    lessons = example.place_lessons(row, 4 * NUM_PLACE_FEATURES)
    ends = np.flatnonzero(np.asarray(row.ids) == FORM.vocabulary.vision_end)[1:6:2]
    by_place = dict(zip(lessons.index_M.tolist(), lessons.features_MP.numpy(), strict=True))
    assert {row.ids[end - 1] for end in ends} == {FORM.vocabulary.image_pad}
    np.testing.assert_array_equal(by_place[ends[0] - 1], place_features((5, 6)))
    np.testing.assert_array_equal(by_place[ends[1] - 1], place_features((50, 60)))
    assert ends[2] - 1 not in by_place  # no way is gone there
    assert lessons.index_M.tolist().count(ends[0] - 1) == 1
    led = f"move to the nearest left target by circling around the stick clockwise to <{y}, {x}>"
    example = make_example(replace(going, demo_subgoals=(led, led, led)), FORM, CONFIG, np.random.default_rng(0))
    row = example.row()
    for num_slots in (4, 1):  # beside where the tool is, on which side it passes, if there is room
        lessons = example.place_lessons(row, num_slots * NUM_PLACE_FEATURES)
        at = (lessons.index_M == int(ends[0]) - 1).nonzero().flatten().tolist()
        assert len(at) == min(num_slots, 2)
    lessons = example.place_lessons(row, 4 * NUM_PLACE_FEATURES)
    (side,) = ((lessons.index_M == int(ends[0]) - 1) & (lessons.first_M == NUM_PLACE_FEATURES)).nonzero().tolist()
    np.testing.assert_array_equal(lessons.features_MP[side[0]], text_code("backward", NUM_PLACE_FEATURES))
    assert len(make_example(replace(going, demo_tools=()), FORM, CONFIG, np.random.default_rng(0)).row().ids) == len(
        row.ids
    )  # the row is the same: only what is asked of it differs
