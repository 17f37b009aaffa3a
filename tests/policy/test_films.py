"""Films: what is said at the end is right, though it is no longer to be seen."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from dual_system.data.dataset import Dataset
from dual_system.data.episode import unpack
from dual_system.data.video import FPS
from dual_system.policy import films
from dual_system.policy.films import FIRST_SEED, PICTURE_HZ, Film, FilmStudio, packed
from dual_system.policy.studio import IMAGE_PX
from dual_system.tasks.environment import make_environment
from dual_system.tasks.task import task_names
from dual_system.training.data import TrainingSet

pytestmark = pytest.mark.sim

CHANNELS = {"red": 0, "green": 1, "blue": 2}
COLORED = re.compile(r"the (\w+) (marked|hidden) cube at <(\d+), (\d+)>, which is (\w+)")


@pytest.fixture(scope="module")
def studio() -> Iterator[FilmStudio]:
    studio = FilmStudio()
    yield studio
    studio.close()


@pytest.fixture(scope="module")
def shot(studio: FilmStudio) -> list[Film]:
    return [studio.film(FIRST_SEED + number) for number in range(20)]


def at(film: Film, place: tuple[int, int]) -> np.ndarray:
    """(pictures, 3): the colour at a place of the front picture, from the first picture to the last."""
    row, column = (pixel * IMAGE_PX // 256 for pixel in place)
    return np.stack([views["front"][row, column] for views in film.views]).astype(int)


def named(film: Film, kind: str) -> Sequence[tuple[tuple[int, int], int]]:
    """The places of hidden or marked cubes in a film's text, and the channels of their colours."""
    return [((int(y), int(x)), CHANNELS[color]) for _, what, y, x, color in COLORED.findall(film.text) if what == kind]


def test_a_film_follows_from_its_seed(studio: FilmStudio, shot: list[Film]) -> None:
    again = studio.film(FIRST_SEED + 3)
    assert (again.instruction, again.text) == (shot[3].instruction, shot[3].text)
    for one, other in zip(again.views, shot[3].views, strict=True):
        assert np.array_equal(one["front"], other["front"])


def test_what_was_hidden_was_seen_before_and_is_not_seen_at_the_end(shot: list[Film]) -> None:
    """In most films: the centre of a cube may be hidden by another thing while its edge is seen."""
    was_seen, is_seen = [], []
    for film in shot:
        for place, channel in named(film, "hidden"):
            colors = at(film, place)
            is_own = (colors.argmax(axis=1) == channel) & (np.ptp(colors, axis=1) > 60)
            was_seen.append(is_own[0])
            is_seen.append(is_own[-1])
    assert len(was_seen) > 10
    assert np.mean(was_seen) > 0.8
    assert np.mean(is_seen) < 0.1


def test_a_mark_is_white_and_gone_at_the_end(shot: list[Film]) -> None:
    was_marked, is_marked = [], []
    for film in shot:
        for (y, x), channel in named(film, "marked"):
            beside = [at(film, (y, x + offset)).min(axis=1) for offset in range(-14, 15, 2)]
            gain = np.max([whites - whites[0] for whites in beside], axis=0)
            was_marked.append(gain.max() > 40)
            if at(film, (y, x))[-1].argmax() == channel:  # no container, which is as white, stands over it
                is_marked.append(gain[-1] > 40)
    assert len(was_marked) > 10
    assert np.mean(was_marked) > 0.8
    assert np.mean(is_marked) < 0.4  # a container may stand beside it


def test_things_are_asked_for_in_the_order_in_which_they_are_told(shot: list[Film]) -> None:
    for film in shot:
        asked = film.instruction.removeprefix("say where these are: ").split(", ")
        assert [part.split(" at <")[0] for part in film.text.split("; ")] == asked
        assert len({*asked}) == len(asked)
        assert len(film.views) == PICTURE_HZ * film.seconds


def test_the_text_begins_when_all_has_happened(shot: list[Film]) -> None:
    shares = []
    for number, film in enumerate(shot):
        rows = unpack(packed(film, FIRST_SEED + number)).rows
        own = rows.grounded_subgoal.index(film.text)
        assert own == FPS * film.seconds
        assert rows.is_transition[own]
        assert not rows.is_demonstration[own:].any()
        shares.append(rows.is_demonstration.sum() / own)
    assert 0.2 < np.mean(np.array(shares) == 1) < 0.8
    assert min(shares) < 0.5


def test_no_text_is_a_subgoal_of_a_task(shot: list[Film]) -> None:
    """Words may be the same, sentences not: a film says where things are, a subgoal what to do."""
    said = {re.sub(r"<.*?>", "", part).strip() for film in shot for part in film.text.split("; ")}
    for name in task_names():
        with make_environment(name, render=False) as environment:
            assert re.sub(r"<.*?>", "", environment.reset(0).grounded_subgoal).strip() not in said


def test_they_are_collected_as_episodes_are_and_train_a_ponder(tmp_path: Path) -> None:
    assert films.main(["--out", str(tmp_path / "films"), "--films", "2", "--workers", "1", "--no-progress"]) == 0
    assert [entry.seed for entry in Dataset(tmp_path / "films").episodes] == [FIRST_SEED, FIRST_SEED + 1]
    data = TrainingSet(tmp_path / "films", demo_hz=2)
    assert data[0].instruction.startswith("say where these are: ")
    assert any(" at <" in text for text in data[0].subgoals)
