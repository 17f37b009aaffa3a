"""What training makes of an episode is what serving would have shown."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clock.sampling import EVALUATION, ROBOMME, sample_schedule
from dual_system.models.groot.pounce import GrootInputs
from dual_system.models.groot.prompt import tiny_eagle_tokenizer_for_random_weights
from dual_system.models.normalisation import ROBOMME as STATISTICS
from dual_system.models.pi05.prompt import tiny_tokenizer_for_random_weights
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.pounce.configs import tiny_groot
from dual_system.models.pounce.reading import groot_inputs, pi05_inputs
from dual_system.training.chunks import target_rows
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.example import ExampleConfig, episode_row, make_example, row_frames
from dual_system.training.places import misplaced
from dual_system.training.stand_in import stand_in
from dual_system.training.training_episode import TrainingEpisode
from pounce_server.contract import Request

PONDER = Ponder.random(replace(tiny_ponder(), image_px=(64, 64), num_layers=4), seed=1)
FORM = PONDER.format
POUNCE = tiny_pounce(horizon=6)
TOKENIZER = tiny_tokenizer_for_random_weights()


def episode(num_ticks: int, *, num_demo: int = 0, seed: int = 0, changes: tuple[int, ...] = (0,)) -> TrainingEpisode:
    """Noise with a subgoal that changes at the given ticks."""
    rng = np.random.default_rng(seed)

    def views() -> tuple[np.ndarray, ...]:
        return tuple(rng.integers(0, 256, (64, 64, 3), np.uint8) for _ in range(2))

    count = 0
    texts = []
    for tick in range(num_ticks):
        count += tick in changes
        texts.append(f"pick cube {count} at <{count}, 20>")
    return TrainingEpisode(
        instruction="press the button, then pick",
        demo=tuple(views() for _ in range(num_demo)),
        frames=[views() for _ in range(num_ticks)],
        state_T8=rng.uniform(-0.2, 0.2, (num_ticks, 8)).astype(np.float32),
        action_T8=rng.uniform(-0.2, 0.2, (num_ticks, 8)).astype(np.float32),
        subgoals=texts,
        is_transition_T=np.isin(np.arange(num_ticks), changes),
        reasoning="Demo selected <77, 103>." if num_demo else "",
    )


@given(num_ticks=st.integers(1, 60), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_an_invocation_is_read_as_pounce_serve_reads_it(num_ticks: int, seed: int) -> None:
    recorded = episode(num_ticks, seed=3)
    config = ExampleConfig(clocks=ROBOMME, max_invocations=4)
    example = make_example(recorded, FORM, config, np.random.default_rng(seed))
    batch = collate_pounce([example], POUNCE, TOKENIZER, STATISTICS)
    for place, asked in enumerate(example.invocations):
        request = Request(
            frames=recorded.frames[asked.tick],
            proprio=recorded.state_T8[asked.tick],
            instruction=recorded.instruction,
            cognition=np.zeros((1, 64), np.float32),
            age_ns=asked.reference.age_ns,
            seed=0,
        )
        served = pi05_inputs(request, POUNCE, TOKENIZER, STATISTICS, torch.device("cpu"))
        num_tokens = served.token_ids.shape[1]
        assert torch.equal(batch.inputs.images[place], served.images[0])
        assert torch.equal(batch.inputs.has_view[place], served.has_view[0])
        assert torch.equal(batch.inputs.token_ids[place, :num_tokens], served.token_ids[0])
        assert batch.inputs.is_token[place].sum() == num_tokens
        assert batch.inputs.age_ns[place] == served.age_ns[0]
        assert batch.query_I[place] == asked.reference.query


def test_groot_reads_an_invocation_as_pounce_serve_does() -> None:
    recorded, longer = (
        episode(50, seed=3),
        replace(episode(50, seed=4), instruction="press the button, then pick it up"),
    )
    config, tokenizer = tiny_groot(horizon=6), tiny_eagle_tokenizer_for_random_weights()
    form = ExampleConfig(clocks=ROBOMME, max_invocations=3)
    examples = [make_example(each, FORM, form, np.random.default_rng(1)) for each in (recorded, longer)]
    batch = collate_pounce(examples, config, tokenizer, STATISTICS)
    moments = [(example.episode, asked) for example in examples for asked in example.invocations]
    for place, (seen, asked) in enumerate(moments):
        request = Request(
            frames=seen.frames[asked.tick],
            proprio=seen.state_T8[asked.tick],
            instruction=seen.instruction,
            cognition=np.zeros((1, 64), np.float32),
            age_ns=asked.reference.age_ns,
            seed=0,
        )
        served = groot_inputs(request, config, tokenizer, STATISTICS, torch.device("cpu"))
        num_tokens = served.token_ids.shape[1]
        assert isinstance(batch.inputs, GrootInputs)
        for name in ("images", "state", "embodiment", "age_ns"):
            assert torch.equal(getattr(batch.inputs, name)[place], getattr(served, name)[0]), name
        assert torch.equal(batch.inputs.token_ids[place, -num_tokens:], served.token_ids[0])
        assert (
            batch.inputs.is_token[place].tolist()
            == [False] * (batch.inputs.token_ids.shape[1] - num_tokens) + [True] * num_tokens
        )
    assert not batch.inputs.is_token.all()  # the shorter instruction is padded


def test_targets_turn_back_into_the_commands() -> None:
    recorded = episode(30)
    example = make_example(recorded, FORM, ExampleConfig(clocks=EVALUATION), np.random.default_rng(0))
    batch = collate_pounce([example], POUNCE, TOKENIZER, STATISTICS)
    for place, asked in enumerate(example.invocations):
        rows = STATISTICS.absolute_targets(batch.actions_INA[place, :, :8].numpy(), recorded.state_T8[asked.tick])
        np.testing.assert_allclose(rows, target_rows(recorded, asked.tick, 6), atol=1e-5)
        assert not batch.actions_INA[place, :, 8:].any()


def test_after_the_end_the_last_command_stays_in_force() -> None:
    recorded = episode(5)
    assert np.array_equal(target_rows(recorded, 3, 4), recorded.action_T8[[3, 4, 4, 4]])


def test_the_row_says_what_the_annotations_say() -> None:
    recorded = episode(70, num_demo=3, changes=(0, 30))
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, 70, transition_ticks=recorded.transition_ticks)
    row = episode_row(recorded, FORM, schedule)
    v = FORM.vocabulary
    said = [i for i in row.ids if i == v.t_yes]
    assert len(said) == 3  # reasoning and first subgoal, second subgoal
    assert row.num_images == 2 * (3 + len(schedule.queries)) == len(row_frames(recorded, FORM, schedule))
    texts = v.decode([t for t in row.targets if t >= 0 and t not in (v.t_yes, v.t_no)])
    assert texts == "Demo selected [402, 301].pick cube 1 at [78, 4]pick cube 2 at [78, 8]"


def test_transitions_are_the_datas_and_not_the_texts() -> None:
    recorded = replace(episode(70), subgoals=["circle the post"] * 40 + ["go on"] * 15 + ["go on at <9, 9>"] * 15)
    marked = replace(recorded, is_transition_T=np.isin(np.arange(70), (0, 20, 40)))  # the second has the first's words
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, 70, transition_ticks=marked.transition_ticks)
    row = episode_row(marked, FORM, schedule)
    v = FORM.vocabulary
    assert v.decode([t for t in row.targets if t >= 0 and t not in (v.t_yes, v.t_no)]) == (
        "circle the postcircle the postgo on"
    )


def test_pictures_stand_in_the_order_of_the_row() -> None:
    recorded = episode(45, num_demo=2)
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, 45)
    frames = row_frames(recorded, FORM, schedule)
    assert np.array_equal(frames[1], recorded.demo[0][1])
    assert np.array_equal(frames[4 + 2], recorded.frames[schedule.queries[1].tick][0])


def test_without_grounding_the_row_has_no_text() -> None:
    recorded = episode(45, num_demo=2)
    config = ExampleConfig(clocks=EVALUATION, is_grounded=False)
    example = make_example(recorded, FORM, config, np.random.default_rng(0))
    assert FORM.vocabulary.t_yes not in example.row().ids


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_words_that_slipped_are_read_and_not_learned(seed: int) -> None:
    recorded = replace(episode(70, changes=(0, 30)), subgoals=["pick at <120, 40>"] * 30 + ["go to <20, 200>"] * 40)
    config = ExampleConfig(clocks=EVALUATION, slips=1.0, slip_px=(5.0, 5.0))
    slipped = make_example(recorded, FORM, config, np.random.default_rng(seed)).row()
    right = make_example(recorded, FORM, replace(config, slips=0.0), np.random.default_rng(seed)).row()
    v = FORM.vocabulary
    assert [t for t in slipped.targets if t >= 0] == [t for t in right.targets if t in (v.t_yes, v.t_no)]
    said = v.decode([i for i in slipped.ids if i not in v.control_ids and i not in FORM.carrier_ids])
    places = np.array([[int(n) for n in pair] for pair in re.findall(r"\[(\d+), (\d+)\]", said)])
    wanted = np.array([[156, 469], [781, 78]])
    assert places.shape == wanted.shape
    assert 0 < np.abs(places - wanted).max() < 6 * 5 * 1000 / 256
    assert "pick at [" in said


def test_words_that_tremble_are_read_and_learned() -> None:
    recorded = replace(episode(70, changes=(0, 30)), subgoals=["pick at <120, 40>"] * 30 + ["go to <20, 200>"] * 40)
    config = ExampleConfig(clocks=EVALUATION, tremble_px=2.0)
    v = FORM.vocabulary
    told = set()
    for seed in range(10):
        row = make_example(recorded, FORM, config, np.random.default_rng(seed)).row()
        read = v.decode([i for i in row.ids if i not in v.control_ids and i not in FORM.carrier_ids])
        learned = v.decode([t for t in row.targets if t >= 0 and t not in v.control_ids])
        assert re.findall(r"\[.*?\]", learned) == re.findall(r"\[.*?\]", read) != []
        told.update(re.findall(r"\[.*?\]", learned))
    assert len(told) > 10  # of 20 places, drawn anew


def test_how_far_words_slip_is_drawn_for_each_row() -> None:
    recorded = replace(episode(70, changes=(0,)), subgoals=["pick at <120, 120>"] * 70)
    config = ExampleConfig(clocks=EVALUATION, slips=1.0, slip_px=(2.0, 20.0))
    slips = [make_example(recorded, FORM, config, np.random.default_rng(seed)).slip for seed in range(60)]
    drawn = np.array([slip.std_px for slip in slips if slip is not None])
    assert len(drawn) == 60
    assert 2.0 <= drawn.min() < 3.0 < 15.0 < drawn.max() <= 20.0
    assert abs(np.log(drawn).mean() - np.log(40.0**0.5)) < 0.3
    for wrong in ((0.0, 1.0), (3.0, 2.0)):
        with pytest.raises(ValueError, match="must ascend"):
            ExampleConfig(clocks=EVALUATION, slip_px=wrong)


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_with_foresight_a_text_has_the_place_that_it_gets_later(data: st.DataObject) -> None:
    """Of its own subgoal only; what has a place keeps it, what never gets one stays as it is."""
    lengths = data.draw(st.lists(st.integers(1, 6), min_size=1, max_size=4))
    texts: list[str] = []
    expected: list[str] = []
    for number, length in enumerate(lengths):
        hidden = data.draw(st.integers(0, length))
        texts += [f"pick cube {number}"] * hidden + [
            f"pick cube {number} at <{tick}, 9>" for tick in range(hidden, length)
        ]
        expected += [f"pick cube {number} at <{hidden}, 9>" if hidden < length else f"pick cube {number}"] * hidden
        expected += texts[len(expected) :]
    begins = np.cumsum([0, *lengths[:-1]])
    recorded = replace(episode(len(texts), changes=tuple(begins.tolist())), subgoals=texts)
    foreseen = recorded.with_foresight()
    assert list(foreseen.subgoals) == expected
    assert list(foreseen.with_foresight().subgoals) == expected
    np.testing.assert_array_equal(foreseen.state_T8, recorded.state_T8)
    config = ExampleConfig(clocks=EVALUATION, has_foresight=True)
    assert list(make_example(recorded, FORM, config, np.random.default_rng(0)).episode.subgoals) == expected


@given(stints=st.lists(st.tuples(st.sampled_from("abcd"), st.booleans(), st.integers(1, 4)), min_size=1, max_size=7))
@settings(max_examples=60, deadline=None)
def test_a_plan_tells_the_places_of_what_comes_later(stints: list[tuple[str, bool, int]]) -> None:
    """Once each, in order; not at the first subgoal, and not of the one in force."""
    names = [name for name, _, _ in stints]
    heads = [f"pick {name} at <{10 * n}, 9>" if has_place else name for n, (name, has_place, _) in enumerate(stints)]
    texts = [head for head, (_, _, length) in zip(heads, stints, strict=True) for _ in range(length)]
    begins = np.cumsum([0, *(length for _, _, length in stints[:-1])]).tolist()
    planned = replace(episode(len(texts), changes=tuple(begins)), subgoals=texts).with_plans()
    assert list(planned.subgoals) == texts
    for n, begin in enumerate(begins):
        end = begins[n + 1] if n + 1 < len(begins) else len(texts)
        told = set(planned.words[begin:end])
        assert len(told) == 1
        head, *later = told.pop().replace(", 9>", "; 9>").split(", ")
        assert head == heads[n].replace(", 9>", "; 9>")
        shown = [m for m in range(n + 1, len(heads)) if stints[m][1] and not (names[m] == names[n] and stints[n][1])]
        once = [m for place, m in enumerate(shown) if names[m] not in {names[k] for k in shown[:place]}]
        assert later == ([f"<{10 * m}; 9>" for m in once] if n else [])


def test_a_plan_tells_what_was_not_reached_as_if_it_had_been() -> None:
    """Else one that failed after two of five would teach plans of two."""
    texts = ["press at <7, 7>", *(f"pick cube {n} at <{30 * n}, 20>" for n in range(1, 6))]
    whole = replace(episode(6, changes=tuple(range(6))), subgoals=texts).with_plans()
    for reached in range(1, 6):
        begun = replace(episode(reached, changes=tuple(range(reached))), subgoals=texts[:reached])
        assert [*replace(begun, unreached=texts[reached:]).with_plans().words] == [*whole.words[:reached]]
        assert reached == 1 or [*begun.with_plans().words] != [*whole.words[:reached]]


def test_a_plan_tells_a_place_once() -> None:
    """Where things are carried to and fro every text has one, and most are the same."""
    places = ["<9, 9>", "<40, 90>", "<80, 20>", "<42, 91>", "<80, 24>", "<7, 60>"]
    texts = [f"carry it to {place} for the {n}th time" for n, place in enumerate(places)]
    planned = replace(episode(len(texts), changes=tuple(range(len(texts)))), subgoals=texts).with_plans()
    assert [text.count("<") for text in planned.words] == [1, 3, 3, 3, 2, 1]
    assert planned.words[1] == texts[1] + ", <80, 20>, <7, 60>"


def test_a_plan_of_a_way_tells_every_stretch_and_how_it_is_gone() -> None:
    """Two in a row may have the same words, and a way may come back to where it was."""
    texts = [
        "move left to <10, 10>, then <10, 40>",
        "move left to <10, 40>, then <40, 40>",
        "go round clockwise to <40, 40>, then <10, 10>",
        "move back to <10, 10>",
    ]
    shown = ((np.zeros((32, 32, 3), np.uint8),) * 2,)
    recorded = replace(episode(4, changes=(0, 1, 2, 3)), subgoals=texts, demo=shown)
    assert [*recorded.with_plans().words] == [
        f"{texts[0]}, clockwise <40, 40>, back <10, 10>",
        f"{texts[1]}, back <10, 10>",
        *texts[2:],
    ]
    unseen = replace(recorded, demo=()).with_plans()
    assert unseen.words[0] == texts[0]  # nothing was shown by then


def test_a_plan_of_numbered_cubes_can_name_what_is_where() -> None:
    """Names do not change which places are told; plans of other things have none."""
    texts = [
        "pick up the first red cube at <10, 10>",
        "put it into the bin at <90, 90>",
        "pick up the first blue cube at <20, 40>",
        "put it into the bin at <90, 90>",
        "press the button at <5, 60>",
    ]
    recorded = replace(episode(5, changes=(0, 1, 2, 3, 4)), subgoals=texts)
    assert [*recorded.with_plans(names=True).words] == [
        texts[0],
        f"{texts[1]}, first blue <20, 40>, button <5, 60>",
        f"{texts[2]}, bin <90, 90>, button <5, 60>",
        f"{texts[3]}, button <5, 60>",
        texts[4],
    ]
    failed = replace(episode(2, changes=(0, 1)), subgoals=texts[:2], unreached=texts[2:]).with_plans(names=True)
    assert failed.words[1] == f"{texts[1]}, first blue <20, 40>, button <5, 60>"
    others = replace(recorded, subgoals=[re.sub("blue|red", "highlighted", text) for text in texts])
    assert others.with_plans(names=True).words == others.with_plans().words


def test_a_stand_in_can_tell_where_it_goes_on() -> None:
    """Of the share of queries that are to be told, and where the next subgoal has a place."""
    texts = ["pick at <1, 1>"] * 60 + ["put at <100, 40>"] * 60 + ["press"] * 60
    recorded = replace(episode(180, changes=(0, 60, 120)), subgoals=texts)
    after = ["<100, 40>"] * 60 + [""] * 120
    assert recorded.next_places() == after
    for share in (0.0, 0.5, 1.0):
        config = ExampleConfig(clocks=EVALUATION, tells_onward=share)
        told = total = 0
        for seed in range(20):
            example = make_example(recorded, FORM, config, np.random.default_rng(seed))
            for query, vector in zip(example.schedule.queries, example.stand_ins(64).numpy(), strict=True):
                plain, onward = (stand_in(texts[query.tick], 64, onward=each) for each in ("", after[query.tick]))
                is_told = np.array_equal(vector, onward)
                assert is_told or np.array_equal(vector, plain)
                if after[query.tick]:
                    told, total = told + is_told, total + 1
        assert abs(told / total - share) < (0.15 if share == 0.5 else 1e-9)
    with pytest.raises(ValueError, match="tells_onward"):
        ExampleConfig(clocks=EVALUATION, tells_onward=1.5)


def test_of_a_share_of_rows_clocks_run_evenly() -> None:
    recorded = episode(300)
    served = [q.tick for q in sample_schedule(np.random.default_rng(0), EVALUATION, 300).queries]
    for share in (0.0, 0.5, 1.0):
        config = ExampleConfig(clocks=ROBOMME, even_clocks=share)
        drawn = [make_example(recorded, FORM, config, np.random.default_rng(seed)) for seed in range(40)]
        even = [[query.tick for query in each.schedule.queries] == served for each in drawn]
        assert abs(np.mean(even) - share) < (0.2 if share == 0.5 else 1e-9)


def test_reasoning_can_be_left_unwritten() -> None:
    recorded = replace(episode(60, changes=(0,)), reasoning="the red one was under the left one")
    written, left_out = (
        make_example(recorded, FORM, ExampleConfig(clocks=EVALUATION, has_reasoning=has), np.random.default_rng(0))
        for has in (True, False)
    )
    assert "under the left one" in FORM.vocabulary.decode(written.row().ids)
    expected = make_example(
        replace(recorded, reasoning=""), FORM, ExampleConfig(clocks=EVALUATION), np.random.default_rng(0)
    )
    assert left_out.row().ids == expected.row().ids


def test_what_was_demonstrated_is_narrated_before_the_first_subgoal() -> None:
    shown = ["pick up the cube at <9, 9>", "drop the cube onto target at <100, 40>", "static at <1, 1>, <2, 2>"]
    recorded = replace(episode(60, num_demo=3, changes=(0,)), demo_subgoals=shown)
    rows = {
        narrates: make_example(
            recorded,
            FORM,
            ExampleConfig(clocks=EVALUATION, has_reasoning=False, narrates=narrates),
            np.random.default_rng(0),
        )
        for narrates in (True, False)
    }
    v = FORM.vocabulary
    said = {narrates: [t for t in each.row().targets if t >= 0] for narrates, each in rows.items()}
    told = v.encode(normalised_text("first <100, 40>"))
    begin = said[True].index(v.t_yes) + 1
    assert tuple(said[True][begin : begin + len(told)]) == tuple(told)
    assert said[True][begin + len(told) :] == said[False][said[False].index(v.t_yes) :]


def test_a_plan_is_said_and_cognition_is_of_the_subgoal() -> None:
    texts = ["press at <1, 1>"] * 30 + ["pick at <100, 40>"] * 40 + ["put at <20, 200>"] * 50
    recorded = replace(episode(120, changes=(0, 30, 70)), subgoals=texts)
    config = ExampleConfig(clocks=EVALUATION, has_plans=True)
    planned = make_example(recorded, FORM, config, np.random.default_rng(0))
    plain = make_example(recorded, FORM, replace(config, has_plans=False), np.random.default_rng(0))
    assert planned.said[-1] == plain.said[-1]
    assert planned.said[2].startswith(plain.said[2] + ", [")
    assert torch.equal(planned.stand_ins(64), plain.stand_ins(64))
    v = FORM.vocabulary
    learned = v.decode([t for t in planned.row().targets if t >= 0 and t not in v.control_ids])
    assert learned.count("[") == 4


@given(num_ticks=st.integers(2, 120), data=st.data())
@settings(max_examples=25, deadline=None)
def test_pounce_imitates_from_where_the_correction_begins(num_ticks: int, data: st.DataObject) -> None:
    begin = data.draw(st.integers(0, num_ticks - 1))
    recorded = replace(episode(num_ticks), imitated_from=begin)
    config = ExampleConfig(clocks=ROBOMME, max_invocations=4)
    for seed in range(3):
        example = make_example(recorded, FORM, config, np.random.default_rng(seed))
        whole = make_example(replace(recorded, imitated_from=0), FORM, config, np.random.default_rng(seed))
        assert example.schedule == whole.schedule
        open_ticks = [each for each in example.schedule.invocations if each.tick >= begin]
        assert len(example.invocations) == min(4, len(open_ticks))
        assert set(example.invocations) <= set(open_ticks)


def test_a_correction_begins_within_its_episode() -> None:
    for wrong in (-1, 70):
        with pytest.raises(ValueError, match="none of the 70 ticks"):
            replace(episode(70), imitated_from=wrong)


def test_places_that_slip_stay_in_the_picture() -> None:
    rng = np.random.default_rng(0)
    texts = [misplaced("<0, 256>", 30.0, rng) for _ in range(200)]
    numbers = np.array([[int(n) for n in text[1:-1].split(",")] for text in texts])
    assert numbers.min() == 0
    assert numbers.max() == 256
    assert misplaced("put it down", 30.0, rng) == "put it down"
    assert misplaced("at <7, 9>", 0.0, rng) == "at <7, 9>"


def test_no_more_invocations_than_asked_for_and_in_order() -> None:
    config = ExampleConfig(clocks=ROBOMME, max_invocations=5)
    ticks = [i.tick for i in make_example(episode(60), FORM, config, np.random.default_rng(0)).invocations]
    assert len(ticks) == 5
    assert ticks == sorted(set(ticks))


def test_examples_of_a_batch_keep_apart() -> None:
    config = ExampleConfig(clocks=ROBOMME, max_invocations=2)
    rng = np.random.default_rng(0)
    examples = [make_example(episode(n, seed=n), FORM, config, rng) for n in (25, 50)]
    episodes, batch = collate_ponder(examples), collate_pounce(examples, POUNCE, TOKENIZER, STATISTICS)
    assert batch.episode_I.tolist() == [0, 0, 1, 1]
    assert [len(row.carrier_index) for row in episodes.rows] == [2, 3]
    alone = collate_pounce(examples[1:], POUNCE, TOKENIZER, STATISTICS)
    assert torch.equal(batch.inputs.images[2:], alone.inputs.images)


def test_an_episode_with_missing_rows_is_refused() -> None:
    whole = episode(5)
    with pytest.raises(ValueError, match="per tick; it has 5, 4, 5, 5, 5"):
        replace(whole, state_T8=whole.state_T8[:4])


def test_a_prompt_that_is_too_long_is_refused() -> None:
    example = make_example(episode(5), FORM, ExampleConfig(clocks=EVALUATION), np.random.default_rng(0))
    with pytest.raises(ValueError, match="expected at most 3"):
        collate_pounce([example], replace(POUNCE, max_prompt_tokens=3), TOKENIZER, STATISTICS)


def test_what_a_demonstration_did_can_be_asked_for_in_short_rows() -> None:
    config = ExampleConfig(clocks=EVALUATION, recalls=1.0)
    shown, unshown = episode(200, num_demo=3, changes=(0,)), episode(200, changes=(0,))
    short, whole = (make_example(each, FORM, config, np.random.default_rng(0)) for each in (shown, unshown))
    as_before = make_example(shown, FORM, replace(config, recalls=0.0), np.random.default_rng(0))
    assert len(short.schedule.queries) == 2 < len(whole.schedule.queries) == len(as_before.schedule.queries)
    assert short.schedule.queries == as_before.schedule.queries[:2]
    assert all(each.tick < as_before.schedule.queries[2].tick for each in short.schedule.invocations)


def test_rows_may_be_beginnings() -> None:
    config = ExampleConfig(clocks=EVALUATION, begins=1.0)
    recorded = episode(300, changes=(0, 40, 180))
    short = make_example(recorded, FORM, config, np.random.default_rng(0))
    whole = make_example(recorded, FORM, replace(config, begins=0.0), np.random.default_rng(0))
    assert short.schedule.queries == whole.schedule.queries[:8] != whole.schedule.queries
    assert all(each.tick < whole.schedule.queries[8].tick for each in short.schedule.invocations)
    assert short.episode.subgoals == whole.episode.subgoals, "nothing else of it is cut"


def test_where_things_will_come_to_rest_is_noted_only_if_asked_for() -> None:
    recorded = replace(
        episode(60, num_demo=2),
        demo_notes=["<3, 4> to <80, 66>, second <9, 9>", "<5, 6>"],
        moving=["<1, 2>, <7, 8> to <80, 66>"] * 60,
    )
    told, untold = (
        make_example(
            recorded, FORM, ExampleConfig(clocks=EVALUATION, tells_ends=tells), np.random.default_rng(0)
        ).episode
        for tells in (True, False)
    )
    assert (told.demo_notes, told.moving) == (recorded.demo_notes, recorded.moving)
    assert untold.demo_notes == ["<3, 4>, second <9, 9>", "<5, 6>"]
    assert set(untold.moving) == {"<1, 2>, <7, 8>"}
