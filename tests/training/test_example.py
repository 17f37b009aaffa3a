"""What training makes of an episode is what serving would have shown."""

from __future__ import annotations

from collections.abc import Callable
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
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.pounce.configs import tiny_groot
from dual_system.models.pounce.reading import groot_inputs, pi05_inputs
from dual_system.training.chunks import chunk_ticks
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import Example, ExampleConfig, make_example, row_images
from pounce_server.contract import Request

FORM = Ponder.random(replace(tiny_ponder(), image_px=(64, 64), num_layers=4), seed=1).format
POUNCE = tiny_pounce(horizon=6)
TOKENIZER = tiny_tokenizer_for_random_weights()
AT_1_HZ = ExampleConfig(clocks=EVALUATION)

MakeEpisode = Callable[..., TrainingEpisode]


def example_of(episode: TrainingEpisode, config: ExampleConfig = AT_1_HZ, seed: int = 0) -> Example:
    return make_example(episode, FORM, config, np.random.default_rng(seed))


def written(example: Example) -> str:
    """The supervised texts of the row, one after the other."""
    v = FORM.vocabulary
    return v.decode([t for t in example.row.targets if t >= 0 and t not in (v.t_yes, v.t_no)])


def served(episode: TrainingEpisode, tick: int, age_ns: int) -> Request:
    return Request(
        frames=episode.views[tick],
        proprio=episode.state_TS[tick],
        instruction=episode.instruction,
        cognition=np.zeros((1, 64), np.float32),
        age_ns=age_ns,
        seed=0,
    )


@given(num_ticks=st.integers(1, 60), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15)
def test_an_invocation_is_read_as_pounce_serve_reads_it(
    episode_of_noise: MakeEpisode, num_ticks: int, seed: int
) -> None:
    recorded = episode_of_noise(num_ticks, seed=3)
    example = example_of(recorded, ExampleConfig(clocks=ROBOMME, max_invocations=4), seed)
    batch = collate_pounce([example], POUNCE, TOKENIZER, STATISTICS)
    for place, asked in enumerate(example.invocations):
        request = served(recorded, asked.tick, asked.reference.age_ns)
        expected = pi05_inputs(request, POUNCE, TOKENIZER, STATISTICS, torch.device("cpu"))
        num_tokens = expected.token_ids.shape[1]
        assert torch.equal(batch.inputs.images[place], expected.images[0])
        assert torch.equal(batch.inputs.has_view[place], expected.has_view[0])
        assert torch.equal(batch.inputs.token_ids[place, :num_tokens], expected.token_ids[0])
        assert batch.inputs.is_token[place].sum() == num_tokens
        assert batch.inputs.age_ns[place] == expected.age_ns[0]
        assert batch.query_I[place] == asked.reference.query


def test_groot_reads_an_invocation_as_pounce_serve_does(episode_of_noise: MakeEpisode) -> None:
    longer = replace(episode_of_noise(50, seed=4), instruction="press the button, then pick it up")
    config, tokenizer = tiny_groot(horizon=6), tiny_eagle_tokenizer_for_random_weights()
    drawn = ExampleConfig(clocks=ROBOMME, max_invocations=3)
    examples = [example_of(each, drawn, seed=1) for each in (episode_of_noise(50, seed=3), longer)]
    batch = collate_pounce(examples, config, tokenizer, STATISTICS)
    moments = [(example.episode, asked) for example in examples for asked in example.invocations]
    for place, (seen, asked) in enumerate(moments):
        request = served(seen, asked.tick, asked.reference.age_ns)
        expected = groot_inputs(request, config, tokenizer, STATISTICS, torch.device("cpu"))
        num_tokens = expected.token_ids.shape[1]
        assert isinstance(batch.inputs, GrootInputs)
        for name in ("images", "state", "embodiment", "age_ns"):
            assert torch.equal(getattr(batch.inputs, name)[place], getattr(expected, name)[0]), name
        assert torch.equal(batch.inputs.token_ids[place, -num_tokens:], expected.token_ids[0])
        num_pads = batch.inputs.token_ids.shape[1] - num_tokens
        assert batch.inputs.is_token[place].tolist() == [False] * num_pads + [True] * num_tokens
    assert not batch.inputs.is_token.all()  # the shorter instruction is padded


def test_targets_turn_back_into_the_commands(episode_of_noise: MakeEpisode) -> None:
    recorded = episode_of_noise(30)
    example = example_of(recorded)
    batch = collate_pounce([example], POUNCE, TOKENIZER, STATISTICS)
    for place, asked in enumerate(example.invocations):
        (ticks,) = chunk_ticks(np.array([asked.tick]), 6, recorded.num_ticks)
        rows = STATISTICS.absolute_targets(batch.actions_INA[place, :, :8].numpy(), recorded.state_TS[asked.tick])
        np.testing.assert_allclose(rows, recorded.action_TA[ticks], atol=1e-5)
        assert not batch.actions_INA[place, :, 8:].any()


def test_after_the_end_the_last_command_stays_in_force() -> None:
    assert chunk_ticks(np.array([0, 3]), 4, num_ticks=5).tolist() == [[0, 1, 2, 3], [3, 4, 4, 4]]


def test_the_row_writes_what_the_annotations_say(episode_of_noise: MakeEpisode) -> None:
    example = example_of(episode_of_noise(70, num_demo=3, changes=(0, 30)))
    assert example.row.ids.count(FORM.vocabulary.t_yes) == 3  # reasoning and first subgoal, second subgoal
    assert example.images is not None
    assert example.row.num_images == 2 * (3 + len(example.schedule.queries)) == len(example.images)
    assert written(example) == "Demo selected [402, 301].pick cube 1 at [78, 4]pick cube 2 at [78, 8]"


def test_transitions_are_the_datas_and_not_the_texts(episode_of_noise: MakeEpisode) -> None:
    texts = ["circle the post"] * 40 + ["go on"] * 15 + ["go on at <9, 9>"] * 15
    marked = np.isin(np.arange(70), (0, 20, 40))  # the second one has the text of the first
    example = example_of(replace(episode_of_noise(70), subgoals=texts, is_transition_T=marked))
    assert written(example) == "circle the postcircle the postgo on"


def test_images_stand_in_the_order_of_the_row(episode_of_noise: MakeEpisode) -> None:
    recorded = episode_of_noise(45, num_demo=2)
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, 45)
    images = row_images(recorded, schedule)
    assert images is not None
    assert np.array_equal(images[1], recorded.demo[0][1])
    assert np.array_equal(images[4 + 2], recorded.images[schedule.queries[1].tick][0])


def test_a_format_of_fewer_views_shows_the_first_ones_of_a_demonstration(episode_of_noise: MakeEpisode) -> None:
    recorded = episode_of_noise(45, num_demo=2)
    form = replace(FORM, demonstrations=replace(FORM.demonstrations, num_views=1))
    example = make_example(recorded, form, AT_1_HZ, np.random.default_rng(0))
    assert example.images is not None
    assert len(example.images) == example.row.num_images
    for instant, images in enumerate(recorded.demo):
        assert np.array_equal(example.images[instant], images[0])


def test_an_episode_that_ponder_does_not_read_gives_no_images(episode_of_noise: MakeEpisode) -> None:
    recorded = episode_of_noise(45, num_demo=2)
    unread = replace(recorded, images=[()] * 45, demo=((), ()))
    assert row_images(unread, sample_schedule(np.random.default_rng(0), EVALUATION, 45)) is None


def test_without_grounding_the_row_has_no_text(episode_of_noise: MakeEpisode) -> None:
    example = example_of(episode_of_noise(45, num_demo=2), replace(AT_1_HZ, is_grounded=False))
    assert FORM.vocabulary.t_yes not in example.row.ids
    assert set(example.written) == {""}


def test_reasoning_can_be_left_out_of_the_row(episode_of_noise: MakeEpisode) -> None:
    recorded = replace(episode_of_noise(60, num_demo=1), reasoning="the red one was under the left one")
    with_it, without = (example_of(recorded, replace(AT_1_HZ, has_reasoning=has)) for has in (True, False))
    assert written(with_it) == recorded.reasoning + written(without)
    assert without.row.ids == example_of(replace(recorded, reasoning="")).row.ids


@given(num_ticks=st.integers(1, 90), changes=st.frozensets(st.integers(0, 89)), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_the_newest_subgoal_at_a_query_is_the_last_one_that_the_row_wrote(
    episode_of_noise: MakeEpisode, num_ticks: int, changes: frozenset[int], seed: int
) -> None:
    """``written`` is read off the schedule; here it is read off the tokens, segment by segment."""
    recorded = episode_of_noise(num_ticks, changes=(0, *changes))
    example = example_of(recorded, ExampleConfig(clocks=ROBOMME), seed)
    v, ids = FORM.vocabulary, list(example.row.ids)
    newest = ""
    for query, carriers_K in enumerate(example.row.carrier_index.tolist()):
        end = carriers_K[0]
        begin = max((index for index in range(end) if ids[index] == v.vision_end), default=0) + 1
        if begin < end:
            newest = v.decode(ids[begin + 1 : end])
        assert example.written[query] == newest != ""


@given(num_ticks=st.integers(2, 120), data=st.data())
@settings(max_examples=25)
def test_pounce_imitates_from_where_the_correction_begins(
    episode_of_noise: MakeEpisode, num_ticks: int, data: st.DataObject
) -> None:
    begin = data.draw(st.integers(0, num_ticks - 1))
    recorded = replace(episode_of_noise(num_ticks), imitated_from=begin)
    config = ExampleConfig(clocks=ROBOMME, max_invocations=4)
    for seed in range(3):
        example = example_of(recorded, config, seed)
        assert example.schedule == example_of(replace(recorded, imitated_from=0), config, seed).schedule
        open_ones = [each for each in example.schedule.invocations if each.tick >= begin]
        assert len(example.invocations) == min(4, len(open_ones))
        assert set(example.invocations) <= set(open_ones)


def test_a_correction_begins_within_its_episode(episode_of_noise: MakeEpisode) -> None:
    for wrong in (-1, 70):
        with pytest.raises(ValueError, match="none of the 70 ticks"):
            replace(episode_of_noise(70), imitated_from=wrong)


def test_an_episode_has_one_delay_of_those_that_are_drawn(episode_of_noise: MakeEpisode) -> None:
    config = ExampleConfig(clocks=EVALUATION, delay_up_to_ns=2_000_000_000)
    found = []
    for seed in range(20):
        schedule = example_of(episode_of_noise(90), config, seed).schedule
        delays = {query.stamp.ready_ns - query.stamp.source_ns for query in schedule.queries}
        assert len(delays) == 1
        found += delays
    assert 0 <= min(found) < 500_000_000
    assert 1_500_000_000 < max(found) <= 2_000_000_000


def test_no_more_invocations_than_asked_for_and_in_order(episode_of_noise: MakeEpisode) -> None:
    drawn = example_of(episode_of_noise(60), ExampleConfig(clocks=ROBOMME, max_invocations=5))
    ticks = [each.tick for each in drawn.invocations]
    assert len(ticks) == 5
    assert ticks == sorted(set(ticks))


def test_examples_of_a_batch_keep_apart(episode_of_noise: MakeEpisode) -> None:
    config = ExampleConfig(clocks=ROBOMME, max_invocations=2)
    rng = np.random.default_rng(0)
    examples = [make_example(episode_of_noise(n, seed=n), FORM, config, rng) for n in (25, 50)]
    episodes, batch = collate_ponder(examples), collate_pounce(examples, POUNCE, TOKENIZER, STATISTICS)
    assert batch.episode_I.tolist() == [0, 0, 1, 1]
    assert [len(row.carrier_index) for row in episodes.rows] == [2, 3]
    alone = collate_pounce(examples[1:], POUNCE, TOKENIZER, STATISTICS)
    assert torch.equal(batch.inputs.images[2:], alone.inputs.images)


def test_a_batch_without_an_invocation_is_refused(episode_of_noise: MakeEpisode) -> None:
    example = replace(example_of(episode_of_noise(5)), invocations=())
    with pytest.raises(ValueError, match="none of the 2 examples has an invocation to learn from"):
        collate_pounce([example, example], POUNCE, TOKENIZER, STATISTICS)


def test_the_tokenizer_of_the_other_family_is_refused(episode_of_noise: MakeEpisode) -> None:
    with pytest.raises(ValueError, match="a PounceConfig does not read with a EagleTokenizer"):
        collate_pounce([example_of(episode_of_noise(5))], POUNCE, tiny_eagle_tokenizer_for_random_weights(), STATISTICS)


def test_an_episode_with_missing_rows_is_refused(episode_of_noise: MakeEpisode) -> None:
    whole = episode_of_noise(5)
    with pytest.raises(ValueError, match="per tick; it has 5, 5, 4, 5, 5, 5"):
        replace(whole, state_TS=whole.state_TS[:4])


def test_a_prompt_that_is_too_long_is_refused(episode_of_noise: MakeEpisode) -> None:
    with pytest.raises(ValueError, match="expected at most 3"):
        collate_pounce([example_of(episode_of_noise(5))], replace(POUNCE, max_prompt_tokens=3), TOKENIZER, STATISTICS)
