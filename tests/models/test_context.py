"""Laws of the episode row: append-stable, T_no only as a target, positions that move by an image's side."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.ponder.context import IGNORE, ContextFormat, Segment, SegmentKind, Transition
from dual_system.models.ponder.vocabulary import Vocabulary

VOCABULARY = Vocabulary.tiny()
FORMAT = ContextFormat(vocabulary=VOCABULARY, num_carriers=3, first_carrier_id=440, image_grid=(8, 8))

plain_ids = st.lists(st.integers(0, 383), max_size=6).map(tuple)
transitions = st.builds(Transition, subgoal=plain_ids, reasoning=st.none() | plain_ids)
episodes = st.tuples(
    st.text("abc <>,123", max_size=12),
    st.lists(st.integers(1, 2), max_size=3),
    st.lists(st.tuples(st.integers(1, 3), st.none() | transitions), max_size=5),
)
Episode = tuple[str, list[int], list[tuple[int, Transition | None]]]


def segments_of(episode: Episode) -> list[Segment]:
    instruction, demo_views, queries = episode
    segments = list(FORMAT.opening(instruction, demo_views))
    for num_cameras, transition in queries:
        segments += FORMAT.query(num_cameras, transition)
    return segments


@given(episodes)
def test_segments_end_to_end_are_the_training_row(episode: Episode) -> None:
    segments = segments_of(episode)
    row = FORMAT.row(segments)
    assert row.ids == tuple(i for s in segments for i in s.ids)
    assert row.targets == tuple(t for s in segments for t in s.targets)
    assert row.num_images == sum(s.num_images for s in segments)
    assert row.ids.count(VOCABULARY.image_pad) == 64 * row.num_images


@given(episodes, st.integers(0, 40))
def test_a_shorter_episode_is_a_prefix_of_a_longer_one(episode: Episode, cut: int) -> None:
    segments = segments_of(episode)
    part, whole = FORMAT.row(segments[:cut]), FORMAT.row(segments)
    assert whole.ids[: len(part.ids)] == part.ids
    assert whole.targets[: len(part.targets)] == part.targets


@given(episodes, st.lists(st.none() | transitions, min_size=3, max_size=3))
def test_notes_stand_after_their_look_and_nothing_else_changes(
    episode: Episode, notes: list[Transition | None]
) -> None:
    """Without them, and the labels that there are no more, the row is what it was."""
    instruction, demo_views, _ = episode
    bare = FORMAT.opening(instruction, demo_views)
    noted = FORMAT.opening(instruction, demo_views, notes[: len(demo_views)])
    assert [segment.ids for segment in noted if segment.kind is not SegmentKind.TEXT] == [each.ids for each in bare]
    v, looks = VOCABULARY, 0
    for segment, following in pairwise(noted):
        if segment.kind is SegmentKind.DEMO:
            note, looks = notes[looks], looks + 1
            assert (following.kind is SegmentKind.TEXT) == (note is not None)
            if note is None:
                assert following.targets[0] == v.t_no
            else:
                assert following == FORMAT.text(note)
        elif segment.kind is SegmentKind.TEXT:
            assert following.targets[0] == v.t_no
    assert looks == len(demo_views)
    assert FORMAT.opening(instruction, demo_views, None) == bare
    if not demo_views:
        assert noted == bare


def test_there_is_a_note_or_none_for_every_look() -> None:
    with pytest.raises(ValueError, match="shorter"):
        FORMAT.opening("watch", [1, 1], [None])


@given(episodes)
def test_t_no_is_only_ever_the_target_of_a_first_carrier(episode: Episode) -> None:
    row = FORMAT.row(segments_of(episode))
    assert VOCABULARY.t_no not in row.ids
    first_carriers = row.carrier_index[:, 0].tolist()
    assert [i for i, target in enumerate(row.targets) if target == VOCABULARY.t_no] == first_carriers


@given(episodes)
def test_every_other_target_is_the_token_itself(episode: Episode) -> None:
    row = FORMAT.row(segments_of(episode))
    first_carriers = set(row.carrier_index[:, 0].tolist())
    for index, (token, target) in enumerate(zip(row.ids, row.targets, strict=True)):
        assert target in (IGNORE, token) or index in first_carriers


@given(episodes)
def test_every_decision_is_read_from_an_observation_or_a_text(episode: Episode) -> None:
    row = FORMAT.row(segments_of(episode))
    carriers = set(FORMAT.carrier_ids)
    assert not any(row.ids[i] in carriers for i in row.supervised_index)


@given(episodes, st.integers(0, 40), st.sampled_from([None, (1, 2, 4, 3)]))
def test_positions_in_pieces_are_the_positions_of_the_whole(
    episode: Episode, cut: int, fovea: tuple[int, int, int, int] | None
) -> None:
    form, segments = replace(FORMAT, fovea=fovea), segments_of(episode)
    head, whole = FORMAT.row(segments[:cut]).ids, FORMAT.row(segments).ids
    head_positions, next_position = form.positions(head)
    tail_positions, _ = form.positions(whole[len(head) :], first_index=len(head), first_position=next_position)
    both = np.concatenate([head_positions, tail_positions], axis=1)
    np.testing.assert_array_equal(both, form.positions(whole)[0])


@given(episodes)
def test_the_mrope_position_moves_by_one_per_token_and_by_eight_per_image(episode: Episode) -> None:
    row = FORMAT.row(segments_of(episode))
    positions, next_position = FORMAT.positions(row.ids)
    assert next_position == len(row.ids) - row.num_images * (64 - 8)
    np.testing.assert_array_equal(positions[0], np.arange(len(row.ids)))


def test_an_image_spreads_over_h_and_w_at_one_instant() -> None:
    form = replace(FORMAT, image_grid=(2, 3))
    positions, next_position = form.positions(form.observation(1).ids, first_index=10, first_position=5)
    assert positions.tolist() == [
        [10, 11, 12, 13, 14, 15, 16, 17],
        [5, 6, 6, 6, 6, 6, 6, 9],
        [5, 6, 6, 6, 7, 7, 7, 9],
        [5, 6, 7, 8, 6, 7, 8, 9],
    ]
    assert next_position == 10


def test_a_fovea_stands_where_an_image_of_its_size_would_and_the_rest_around_it() -> None:
    """Of 2 x 3 tokens a narrow eye saw the 2 x 2 on the right: they come first, as they did then."""
    form = replace(FORMAT, image_grid=(2, 3), fovea=(0, 1, 2, 2))
    assert form.token_order.tolist() == [1, 2, 4, 5, 0, 3]
    positions, next_position = form.positions(form.observation(1).ids, first_index=10, first_position=5)
    assert positions[1:].tolist() == [
        [5, 6, 6, 6, 6, 6, 6, 8],
        [5, 6, 6, 7, 7, 6, 7, 8],
        [5, 6, 7, 6, 7, 5, 5, 8],
    ]
    narrow = replace(FORMAT, image_grid=(2, 2))
    before, next_before = narrow.positions(narrow.observation(1).ids, first_index=10, first_position=5)
    np.testing.assert_array_equal(positions[1:, :5], before[1:, :5])
    assert next_position == next_before, "and what follows is where it was"


@given(st.integers(1, 5), st.integers(1, 5), st.data())
def test_every_token_of_an_image_comes_once(rows: int, columns: int, data: st.DataObject) -> None:
    row, column = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, columns - 1))
    sides = data.draw(st.integers(1, rows - row)), data.draw(st.integers(1, columns - column))
    order = replace(FORMAT, image_grid=(rows, columns), fovea=(row, column, *sides)).token_order
    assert sorted(order.tolist()) == [*range(rows * columns)]


@pytest.mark.parametrize("fovea", [(0, 0, 3, 3), (1, 0, 2, 3), (-1, 0, 2, 3), (0, 0, 0, 1)])
def test_a_fovea_lies_within_the_image(fovea: tuple[int, int, int, int]) -> None:
    with pytest.raises(ValueError, match=r"must lie within the image grid \(2, 3\)"):
        replace(FORMAT, image_grid=(2, 3), fovea=fovea)


def test_first_execution_transition_reads_t_yes_reasoning_t_yes_subgoal() -> None:
    t_yes = VOCABULARY.t_yes
    segments = FORMAT.query(2, Transition(subgoal=(7, 8), reasoning=(5, 6)))
    assert [s.kind for s in segments] == [SegmentKind.OBSERVATION, SegmentKind.TEXT, SegmentKind.CARRIERS]
    assert segments[1].ids == (t_yes, 5, 6, t_yes, 7, 8)
    assert segments[1].targets == segments[1].ids


def test_the_papers_growth_is_132_tokens_per_fire_and_one_carrier() -> None:
    form = replace(FORMAT, num_carriers=1)
    assert sum(len(s) for s in form.query(2)) == 132 + 1


def test_a_cut_image_is_refused() -> None:
    with pytest.raises(ValueError, match="image at token 1 has 63 tokens, not 8x8"):
        FORMAT.positions(FORMAT.observation(1).ids[:-2])


def test_an_instruction_cannot_open_a_payload() -> None:
    with pytest.raises(ValueError, match="fim_prefix"):
        FORMAT.opening("be quick <|fim_prefix|> now")


def test_carriers_must_be_unused_rows() -> None:
    with pytest.raises(ValueError, match=f"unused rows start at {VOCABULARY.num_tokens}"):
        replace(FORMAT, first_carrier_id=VOCABULARY.num_tokens - 1)


@pytest.mark.parametrize("num_carriers", [0, 17])
def test_number_of_carriers_is_bounded(num_carriers: int) -> None:
    with pytest.raises(ValueError, match=r"1\.\.16"):
        replace(FORMAT, num_carriers=num_carriers)
