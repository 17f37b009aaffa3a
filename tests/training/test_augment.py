"""Other views: pictures and words move together, and what is drawn leaves the rest of a step's chance alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.eyes import Eye
from dual_system.models.ponder.context import ContextFormat
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.training.augment import AS_IT_IS, NOT_AUGMENTED, Augmentation, View, draw_view

PX = 32
EYE = Eye(camera=0, box=(0.0, 0.25, 0.5, 0.75))
VOCABULARY = Vocabulary.tiny()
FORM = ContextFormat(
    vocabulary=VOCABULARY, num_carriers=1, first_carrier_id=448, image_grid=(2, 2), token_px=16, eyes=(EYE,)
)
TEXT_PX = 128 / PX


def dot_at(down: int, right: int) -> torch.Tensor:
    frames = torch.zeros(2, PX, PX, 3, dtype=torch.uint8)
    frames[:, down, right] = 255
    return frames


@given(
    down=st.integers(8, PX - 9),
    right=st.integers(8, PX - 9),
    shift=st.tuples(st.integers(-4, 4), st.integers(-4, 4)),
    is_mirrored=st.booleans(),
)
def test_a_text_points_at_its_thing_in_every_view(
    down: int, right: int, shift: tuple[int, int], is_mirrored: bool
) -> None:
    view = View(down_px=shift[0], right_px=shift[1], is_mirrored=is_mirrored, text_px=TEXT_PX)
    y, x = round((down + 0.5) * TEXT_PX), round(64 + (right + 0.5) * TEXT_PX)
    said = view.text(f"pick up the cube at <{y}, {x}>, which is red")
    y_said, x_said = (int(number) for number in said[said.index("<") + 1 : said.index(">")].split(", "))
    seen = view.pictures(dot_at(down, right))
    assert seen.shape == (2, PX, PX, 3)
    (place,) = seen[0, :, :, 0].nonzero().tolist()
    assert [int(y_said // TEXT_PX), int((x_said - 64 - 0.25 * is_mirrored) // TEXT_PX)] == place
    assert said.startswith("pick up the cube at <")
    assert said.endswith("which is red")


def test_as_it_is_changes_nothing() -> None:
    frames = torch.randint(0, 256, (3, PX, PX, 3), dtype=torch.uint8)
    assert AS_IT_IS.pictures(frames) is frames
    assert AS_IT_IS.text("at < 7,8 >") == "at < 7,8 >"


def test_edges_are_repeated_and_places_stay_in_the_picture() -> None:
    view = View(down_px=-3, right_px=3, text_px=TEXT_PX)
    frames = torch.arange(PX, dtype=torch.uint8).view(1, PX, 1, 1).expand(1, PX, PX, 3)
    assert view.pictures(frames)[0, :, 0, 0].tolist() == [*range(3, PX), 31, 31, 31]
    assert view.text("<2, 255>") == "<0, 256>"


def test_who_speaks_of_sides_is_not_mirrored() -> None:
    config = Augmentation(mirror=True)
    for text, may_be in (("the left target at <1, 2>", False), ("circle clockwise", False), ("the cube", True)):
        views = {draw_view(config, FORM, {text}, np.random.default_rng(seed)).is_mirrored for seed in range(20)}
        assert views == ({False, True} if may_be else {False})


WAYS = (
    "move to the nearest left target by circling clockwise to <80, 130>, then counterclockwise to <9, 60>",
    "move forward-right to <80, 130>, then <9, 60>",
    "move left to <80, 130>",
)


@pytest.mark.parametrize("text", WAYS)
def test_a_way_may_be_mirrored_and_then_leads_to_the_other_side(text: str) -> None:
    config = Augmentation(mirror=True)
    views = [draw_view(config, FORM, {text}, np.random.default_rng(seed)) for seed in range(20)]
    assert {view.is_mirrored for view in views} == {False, True}
    assert not any(
        draw_view(config, FORM, {text, "the left one"}, np.random.default_rng(s)).is_mirrored for s in range(20)
    )
    mirrored = View(is_mirrored=True)
    told = mirrored.text(text)
    assert told != text
    assert mirrored.text(told) == text, "mirrored twice it is what it was"
    assert ("left" in told, "right" in told) == ("right" in text, "left" in text)
    words = [word.strip(",") for word in text.split()]
    other = {"clockwise": "counterclockwise", "counterclockwise": "clockwise"}
    turned = [word.strip(",") for word in told.split()]
    assert [other[word] for word in words if word in other] == [word for word in turned if word in other]
    assert View(down_px=1, right_px=1, text_px=4.0).text(text).split(" to ")[0] == text.split(" to ")[0], "not mirrored"


@given(seed=st.integers(0, 10_000), max_gain=st.floats(0.05, 2.0))
def test_light_is_one_for_a_row_and_keeps_what_is_brighter_and_of_which_colour(seed: int, max_gain: float) -> None:
    rng = np.random.default_rng(seed)
    view = draw_view(Augmentation(max_gain=max_gain), replace(FORM, eyes=None), {"at <7,8>"}, rng)
    assert 1 / (1 + max_gain) - 1e-9 <= view.gain <= 1 + max_gain + 1e-9
    assert view.text("at < 7,8 >") == "at < 7,8 >", "nothing moves"
    frames = torch.from_numpy(rng.integers(0, 256, (2, 4, 4, 3), np.uint8))
    once, twice = view.pictures(frames), view.pictures(frames[1:])
    assert torch.equal(once[1:], twice), "a picture does not depend on the others of its row"
    was, now = frames.flatten().long(), once.flatten().long()
    is_brighter = was[:, None] > was[None]
    assert (now[:, None] >= now[None])[is_brighter].all(), "neither of two pictures nor of two colours"


def test_light_is_as_often_more_as_less() -> None:
    gains = [
        draw_view(Augmentation(max_gain=0.5), FORM, set(), np.random.default_rng(seed)).gain for seed in range(2000)
    ]
    assert np.mean(np.log(gains)) == pytest.approx(0.0, abs=0.02)
    assert (min(gains), max(gains)) == (pytest.approx(1 / 1.5, rel=0.01), pytest.approx(1.5, rel=0.01))


def test_light_leaves_what_else_is_drawn_as_it_was() -> None:
    moved = Augmentation(max_shift_px=4, mirror=True)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        plain = draw_view(moved, FORM, set(), np.random.default_rng(seed))
        assert plain.gain == 1.0
        lit = draw_view(replace(moved, max_gain=0.3), FORM, set(), rng)
        after_light = np.random.default_rng(seed)
        after_light.uniform()
        assert replace(lit, gain=1.0) == draw_view(moved, FORM, set(), after_light)


def test_without_augmentation_nothing_is_drawn() -> None:
    rng = np.random.default_rng(0)
    assert draw_view(NOT_AUGMENTED, FORM, set(), rng) == AS_IT_IS
    assert rng.integers(1 << 30) == np.random.default_rng(0).integers(1 << 30)


@pytest.mark.parametrize(
    ("eyes", "message"),
    [
        (None, "PONDER with one eye"),
        ((EYE, EYE), "PONDER with one eye"),
        ((Eye(camera=0, box=(0.0, 0.0, 0.5, 0.5)),), "not symmetric"),
    ],
)
def test_eyes_that_one_number_does_not_describe_are_refused(eyes: tuple[Eye, ...] | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw_view(Augmentation(mirror=True), replace(FORM, eyes=eyes), set(), np.random.default_rng(0))
    with pytest.raises(ValueError, match="at least 0, came -1"):
        Augmentation(max_shift_px=-1)
    with pytest.raises(ValueError, match="at least 0 and finite, came -1"):
        Augmentation(max_gain=-1)
