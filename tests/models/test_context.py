"""Laws of the episode row: append-stable, T_no only as a target, positions that move by an image's side."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.ponder.context import (
    IGNORE,
    ContextFormat,
    Segment,
    SegmentKind,
    Transition,
    in_groups,
)
from dual_system.models.ponder.observation import WHOLE_VIEWS, ObservationReader, Pictures, Size, check_cameras
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.small_pair.reading import CropReader

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


@given(episodes, st.integers(0, 40))
def test_positions_in_pieces_are_the_positions_of_the_whole(episode: Episode, cut: int) -> None:
    segments = segments_of(episode)
    head, whole = FORMAT.row(segments[:cut]).ids, FORMAT.row(segments).ids
    head_positions, next_position = FORMAT.positions(head)
    tail_positions, _ = FORMAT.positions(whole[len(head) :], first_index=len(head), first_position=next_position)
    both = np.concatenate([head_positions, tail_positions], axis=1)
    np.testing.assert_array_equal(both, FORMAT.positions(whole)[0])


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


# -- the reader: which images and tokens an observation gives

CROP = CropReader(camera=0, box=(0, 0, 1, 1), first_state_id=448, num_finger_bins=4, num_height_bins=8)
SMALL = replace(FORMAT, image_grid=(1, 2))
"""Images of 32 x 64 px."""
readers = st.sampled_from([WHOLE_VIEWS, CROP])
states = st.lists(st.floats(-0.5, 0.5), min_size=8, max_size=8)


def noise(size: Size, seed: int = 0) -> Pictures:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8)


@given(readers, st.integers(1, 3), states)
def test_an_observation_is_the_readers_images_and_then_its_tokens(
    reader: ObservationReader, num_views: int, state: list[float]
) -> None:
    form = replace(SMALL, reader=reader)
    observed, shown = form.observation(num_views, state), form.demo(num_views)
    size = reader.readable_sizes(form.image_px)[0]
    num_images = len(reader.images([noise(size)] * num_views, form.image_px))
    assert observed.num_images == shown.num_images == num_images == reader.num_images(num_views)
    assert observed.ids.count(VOCABULARY.vision_start) == num_images
    assert observed.ids.count(VOCABULARY.image_pad) == 2 * num_images
    assert observed.ids == (*shown.ids, *reader.state_ids(state))
    assert set(observed.ids) & set(reader.state_rows) == set(reader.state_ids(state))
    assert set(observed.targets) == {IGNORE}


@given(readers, st.integers(1, 3), states, states)
def test_an_observation_is_always_as_long(
    reader: ObservationReader, num_views: int, one: list[float], other: list[float]
) -> None:
    form = replace(SMALL, reader=reader)
    assert len(form.observation(num_views, one)) == len(form.observation(num_views, other))


@given(readers, st.integers(1, 3), st.integers(0, 99))
def test_what_a_reader_gives_has_the_networks_size(reader: ObservationReader, num_views: int, seed: int) -> None:
    for size in reader.readable_sizes(SMALL.image_px)[:3]:
        views = [noise(size, seed + number) for number in range(num_views)]
        images = reader.images(views, SMALL.image_px)
        assert images.dtype == np.uint8
        assert images.shape[1:] == (*SMALL.image_px, 3)
        assert reader.unreadable([size] * num_views, SMALL.image_px) is None


@given(st.integers(1, 3), st.integers(0, 99))
def test_whole_views_are_the_pictures_unchanged_and_no_state(num_views: int, seed: int) -> None:
    views = [noise(SMALL.image_px, seed + number) for number in range(num_views)]
    assert np.array_equal(WHOLE_VIEWS.images(views, SMALL.image_px), np.stack(views))
    assert WHOLE_VIEWS.state_ids(None) == WHOLE_VIEWS.state_ids(np.zeros(8)) == ()
    assert FORMAT.reader == WHOLE_VIEWS


@given(st.lists(st.sampled_from([(32, 64), (64, 32), (32, 32)]), min_size=1, max_size=3))
def test_whole_views_have_exactly_the_networks_size(sizes: list[Size]) -> None:
    wrong = [camera for camera, size in enumerate(sizes) if size != SMALL.image_px]
    found = WHOLE_VIEWS.unreadable(sizes, SMALL.image_px)
    assert (found is None) == (not wrong)
    if found is not None:
        assert found == (wrong[0], "32 x 64 px")
        said = f"camera {wrong[0]} gives .* px pictures; PONDER reads 32 x 64 px"
        with pytest.raises(ValueError, match=said):
            check_cameras(sizes, WHOLE_VIEWS, SMALL.image_px)
        with pytest.raises(ValueError, match=f"frame {wrong[0]}: uint8 of shape"):
            WHOLE_VIEWS.images([noise(size) for size in sizes], SMALL.image_px)


def test_a_view_that_is_no_picture_is_refused() -> None:
    with pytest.raises(ValueError, match=r"frame 0: float64 of shape \(32, 64, 3\); expected uint8"):
        WHOLE_VIEWS.images([np.zeros((32, 64, 3))], SMALL.image_px)  # type: ignore[list-item]


@pytest.mark.parametrize(("first_id", "whose"), [(400, "tokenizer"), (442, r"\[442\] are carriers"), (430, "carriers")])
def test_rows_of_the_table_that_are_taken_are_refused(first_id: int, whose: str) -> None:
    with pytest.raises(ValueError, match=whose):
        replace(FORMAT, reader=replace(CROP, first_state_id=first_id))


@given(episodes, st.integers(1, 200))
def test_groups_are_the_segments_in_order_and_no_longer_than_asked_for(episode: Episode, max_tokens: int) -> None:
    segments = segments_of(episode)
    groups = in_groups(segments, max_tokens)
    assert [segment for group in groups for segment in group] == segments
    assert all(len(group) == 1 or sum(map(len, group)) <= max_tokens for group in groups)
    for group, after in pairwise(groups):
        assert sum(map(len, group)) + len(after[0]) > max_tokens  # as few groups as that allows


@pytest.mark.parametrize("num_carriers", [0, 17])
def test_number_of_carriers_is_bounded(num_carriers: int) -> None:
    with pytest.raises(ValueError, match=r"1\.\.16"):
        replace(FORMAT, num_carriers=num_carriers)
