"""PONDER's texts and states belong to the instant at which the picture was taken, not to the one that repeats it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from clock.sampling import ROBOMME, sample_schedule
from dual_system.data.episode import About, EpisodeWriter, Row, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.small_pair.reading import CropReader
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import ExampleConfig, episode_row

FORM = replace(
    Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4), seed=1).format,
    reader=CropReader(camera=0, box=(0, 0, 1, 1), first_state_id=460, num_finger_bins=8, num_height_bins=40),
)
"""Of a PONDER that reads the robot's state, too."""
CONFIG = ExampleConfig(clocks=ROBOMME)

LOOKS = st.lists(st.booleans(), min_size=1, max_size=90).map(lambda looks: np.array([True, *looks]))
"""Whether a picture was taken at each tick; always at the first."""


def newest(is_taken_T: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The tick of the newest picture at each tick."""
    return np.array([np.flatnonzero(is_taken_T[: tick + 1])[-1] for tick in range(len(is_taken_T))])


def moving(num_ticks: int, changes: frozenset[int]) -> TrainingEpisode:
    """Every tick has a state, a picture and a place of its own."""
    stint = np.cumsum([tick in changes or tick == 0 for tick in range(num_ticks)])
    state_TS = np.linspace(-0.5, 0.5, num_ticks, dtype=np.float32)[:, None].repeat(8, axis=1)
    return TrainingEpisode(
        instruction="pick them",
        demo=(),
        images=[(np.full((32, 32, 3), tick, np.uint8),) for tick in range(num_ticks)],
        views=[()] * num_ticks,
        state_TS=state_TS,
        action_TA=state_TS + 1,
        subgoals=[f"pick cube {stint[tick]} at <{tick}, 20>" for tick in range(num_ticks)],
        is_transition_T=np.diff(stint, prepend=0) > 0,
    )


@given(is_taken_T=LOOKS, changes=st.frozensets(st.integers(1, 89)))
def test_text_and_state_of_a_tick_are_of_its_picture(is_taken_T: NDArray[np.bool_], changes: frozenset[int]) -> None:
    episode, seen_at_T = moving(len(is_taken_T), changes), newest(is_taken_T)
    seen = episode.as_seen(seen_at_T)
    for tick, at in enumerate(seen_at_T.tolist()):
        assert seen.subgoals[tick] == episode.subgoals[at]
        assert np.array_equal(seen.ponder_state(tick), episode.state_TS[at])
        since = int(seen_at_T[tick - 1]) if tick else -1
        assert seen.is_transition_T[tick] == any(episode.is_transition_T[since + 1 : at + 1])
    assert np.array_equal(seen.state_TS, episode.state_TS)
    assert seen.action_TA is episode.action_TA


@given(num_ticks=st.integers(1, 60), changes=st.frozensets(st.integers(1, 59)))
def test_where_every_tick_has_its_own_picture_nothing_changes(num_ticks: int, changes: frozenset[int]) -> None:
    episode = moving(num_ticks, changes)
    seen = episode.as_seen(np.arange(num_ticks))
    assert seen.subgoals == episode.subgoals
    assert np.array_equal(seen.is_transition_T, episode.is_transition_T)


@given(is_taken_T=LOOKS, changes=st.frozensets(st.integers(1, 89)), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_row_is_that_of_a_world_that_stood_still_between_pictures(
    is_taken_T: NDArray[np.bool_], changes: frozenset[int], seed: int
) -> None:
    episode, seen_at_T = moving(len(is_taken_T), changes), newest(is_taken_T)
    seen = episode.as_seen(seen_at_T)
    frozen = replace(seen, state_TS=episode.state_TS[seen_at_T], seen_at_T=None)
    schedule = sample_schedule(
        np.random.default_rng(seed), ROBOMME, episode.num_ticks, transition_ticks=seen.transition_ticks
    )
    row, expected = (episode_row(each, FORM, schedule, CONFIG) for each in (seen, frozen))
    assert (row.ids, row.targets) == (expected.ids, expected.targets)


LOOK_EVERY = 7
NUM_DEMO_ROWS = 10


@pytest.fixture(scope="module")
def sparse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one episode, a demonstration first; state, text and brightness count its rows."""
    root = tmp_path_factory.mktemp("data") / "set"
    episode = EpisodeWriter(32)
    for index in range(NUM_DEMO_ROWS + 60):
        row = Row(
            state=np.full(8, index / 100, np.float32),
            action=np.zeros(8, np.float32),
            tcp_pose=np.zeros(7, np.float32),
            subgoal="pick it",
            grounded_subgoal=f"pick it at <{index}, 7>",
            is_demonstration=index < NUM_DEMO_ROWS,
            is_transition=index in (NUM_DEMO_ROWS, 40),
        )
        picture = np.full((32, 32, 3), 20 + 3 * index, np.uint8)
        is_taken = index == NUM_DEMO_ROWS or index % LOOK_EVERY == 0
        episode.add(row, {"front": picture, "wrist": picture} if is_taken else {})
    about = About(
        task="PickHighlight", instruction="pick it", seed=1, difficulty="easy", origin="oracle", is_success=True,
        image_px=32,
    )  # fmt: skip
    writer = DatasetWriter(root)
    writer.add(unpack(episode.pack(about)))
    writer.finish()
    return root


def test_a_dataset_with_few_pictures_is_read_so(sparse: Path) -> None:
    episode = TrainingSet(sparse, sizes=PictureSizes(form=FORM))[0]
    for tick in range(episode.num_ticks):
        row = (float(episode.images[tick][0].mean()) - 20) / 3  # H.264 rounds
        assert episode.subgoals[tick] == f"pick it at <{round(row)}, 7>"
        assert episode.ponder_state(tick)[0] * 100 == pytest.approx(row, abs=0.7)
        assert episode.state_TS[tick, 0] * 100 == pytest.approx(NUM_DEMO_ROWS + tick)
    assert episode.transition_ticks == {0, 42 - NUM_DEMO_ROWS}  # the first picture that was taken after row 40


@pytest.mark.parametrize("sizes", [None, PictureSizes(pounce_px=32)], ids=["no pictures", "POUNCE's alone"])
def test_where_ponder_reads_no_pictures_texts_are_of_the_tick(sparse: Path, sizes: PictureSizes | None) -> None:
    episode = TrainingSet(sparse, sizes=sizes)[0]
    assert list(episode.subgoals) == [f"pick it at <{NUM_DEMO_ROWS + tick}, 7>" for tick in range(episode.num_ticks)]
    assert episode.transition_ticks == {0, 40 - NUM_DEMO_ROWS}
