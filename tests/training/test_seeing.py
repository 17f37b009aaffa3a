"""Eyes that are opened: the right square is asked for the right thing, the tower learns and nothing else moves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dual_system.data import album
from dual_system.data.dataset import Dataset
from dual_system.models.place_code import NUM_PLACE_FEATURES, place_features
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.configs import small
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.training.seeing import REFUSED, Album, answers_of, draw, loss_of, main, read_album, unlikeness
from dual_system.training.wide_eyes import wide_eyed

PONDER = Ponder.random(small(), seed=0)
FORM = PONDER.format
NAMES = ("blue cube", "button", "red cube")
BOX = (8 / 256, 32 / 256, 168 / 256, 224 / 256)
TOP_PX, LEFT_PX, SIDE_PX, TOKEN_PX = 8, 64, 128, 32


@given(
    y=st.integers(0, 255),
    x=st.integers(0, 255),
    name=st.sampled_from(NAMES),
)
def test_the_answer_says_the_place_again(y: int, x: int, name: str) -> None:
    place = f"<{y}, {x}>"
    answers = answers_of([f"{name} at {place}", ""], ["", place], NAMES, FORM)
    is_in_sight = TOP_PX <= y < TOP_PX + SIDE_PX and LEFT_PX <= x < LEFT_PX + SIDE_PX
    assert answers.things.is_here_NS.sum(dim=1).tolist() == [is_in_sight, 0]
    assert answers.tool.is_here_NS.sum(dim=1).tolist() == [0, is_in_sight]
    for picture, spots in enumerate((answers.things, answers.tool)) if is_in_sight else ():
        (token,) = spots.is_here_NS[picture].nonzero().flatten().tolist()
        down, along = spots.place_NS2[picture, token].tolist()
        assert y == pytest.approx(TOP_PX + (token // 4 + 0.5 + down) * TOKEN_PX, abs=1e-3)
        assert x == pytest.approx(LEFT_PX + (token % 4 + 0.5 + along) * TOKEN_PX, abs=1e-3)
        assert NAMES[int(answers.name_NS[0, token])] == name
        assert spots.told_NSP[picture, token].tolist() == place_features((y, x)).tolist()


def test_pictures_and_answers_move_together() -> None:
    picture = np.zeros((1, 64, 64, 3), np.uint8)
    picture[0, 30, 20] = 255
    place = f"<{TOP_PX + 61}, {LEFT_PX + 41}>"
    seen = Album(pictures=picture, texts=(f"red cube at {place}",), tools=(place,), names=NAMES)
    frames, answers = draw(seen, np.zeros(40, np.int64), FORM, np.random.default_rng(0))
    things = answers.things
    assert torch.equal(things.is_here_NS, answers.tool.is_here_NS)
    assert torch.equal(things.place_NS2, answers.tool.place_NS2)
    assert len({tuple(place.tolist()) for place in frames[..., 0].nonzero()[:, 1:]}) > 20
    for frame, is_thing_S, place_S2 in zip(frames, things.is_here_NS, things.place_NS2, strict=True):
        ((down, along),) = frame[..., 0].nonzero().tolist()
        (token,) = is_thing_S.nonzero().flatten().tolist()
        told = [(token // 4 + 0.5 + place_S2[token, 0]) * 16, (token % 4 + 0.5 + place_S2[token, 1]) * 16]
        assert [down + 0.5, along + 0.5] == pytest.approx([float(each) for each in told], abs=0.51)


def test_the_loss_is_least_where_everything_is_answered_rightly() -> None:
    answers = answers_of(["red cube at <40, 90>, button at <70, 120>"], ["<41, 150>"], NAMES, FORM)
    one = 3 + NUM_PLACE_FEATURES
    said = torch.full((16, 2 * one + len(NAMES)), -20.0)
    for first, spots in ((0, answers.things), (one, answers.tool)):
        for token in spots.is_here_NS[0].nonzero().flatten().tolist():
            said[token, first] = 20
            said[token, first + 1 : first + 3] = spots.place_NS2[0, token]
            said[token, first + 3 : first + one] = spots.told_NSP[0, token]
    for token in answers.things.is_here_NS[0].nonzero().flatten().tolist():
        said[token, 2 * one + int(answers.name_NS[0, token])] = 20
    assert loss_of(said, answers) < 1e-6
    for first, spots in ((0, answers.things), (one, answers.tool)):
        for column in (0, 1, 2, 3, 2 + NUM_PLACE_FEATURES):
            worse = said.clone()
            worse[spots.is_here_NS[0], first + column] -= 30
            assert loss_of(worse, answers) > 0.5
    nobody_asks = answers_of(["red cube at <40, 90>, button at <70, 120>"], [""], NAMES, FORM)
    said[:, one : 2 * one] = 30.0
    assert loss_of(said, nobody_asks) < 1e-6


def test_the_tower_learns_and_nothing_else_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = tmp_path / "album", tmp_path / "eyes"
    assert album.main(["--out", str(folder), "--pictures", "100", "--image-px", "128", "--no-progress"]) == 0
    arguments = ["--recipe", "small", "--data", str(folder), "--album", str(folder), "--out", str(out)]
    assert main([*arguments, "--steps", "6", "--pictures", "32", "--no-progress"]) == 0
    assert "5 pictures held out: " in capsys.readouterr().out
    losses = [float(line.split('"loss": ')[1].rstrip("}\n")) for line in (out / "log.jsonl").read_text().splitlines()]
    assert len(losses) == 6
    assert losses[-1] < losses[0]
    seeing = load_ponder(out / "ponder")
    drawn = Ponder.random(small(), Vocabulary.load(out / "ponder"), seed=0)
    before = dict(drawn.qwen.named_parameters())
    moved = {name for name, weight in seeing.qwen.named_parameters() if not torch.equal(weight, before[name])}
    assert moved == {name for name in before if ".visual." in name}
    assert main(arguments) == REFUSED
    assert "another --out" in capsys.readouterr().err
    again = [*arguments[:-1], str(tmp_path / "again"), "--ponder", str(out / "ponder"), "--steps", "3"]
    assert main([*again, "--settling", "5", "--pictures", "32", "--no-progress"]) == 0
    steps = [json.loads(line)["step"] for line in (tmp_path / "again" / "log.jsonl").read_text().splitlines()]
    assert steps == [*range(-5, 3)]
    only = [*arguments[:-1], str(tmp_path / "only"), "--ponder", str(out / "ponder"), "--steps", "0"]
    assert main([*only, "--settling", "4", "--pictures", "32", "--no-progress"]) == 0
    untouched = load_ponder(tmp_path / "only" / "ponder").qwen.state_dict()
    assert all(torch.equal(untouched[name], weight) for name, weight in seeing.qwen.state_dict().items())
    reopened = load_ponder(tmp_path / "again" / "ponder")
    once = dict(seeing.qwen.named_parameters())
    moved = {name for name, weight in reopened.qwen.named_parameters() if not torch.equal(weight, once[name])}
    assert moved == {name for name in once if ".visual." in name}


@pytest.mark.parametrize("is_widened", [True, False])
def test_an_eye_is_held_to_what_it_saw_before_it_was_widened_or_opened_again(
    is_widened: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, narrow, wide = tmp_path / "album", tmp_path / "narrow", tmp_path / "wide"
    assert album.main(["--out", str(folder), "--pictures", "100", "--image-px", "128", "--no-progress"]) == 0
    save_ponder(PONDER, narrow)
    save_ponder(wide_eyed(PONDER, BOX), wide)
    opened = wide if is_widened else narrow
    unlike = []
    for like in ([], ["--like", str(narrow)]):
        out = tmp_path / f"out{len(like)}"
        arguments = ["--recipe", "small", "--data", str(folder), "--album", str(folder), "--ponder", str(opened), *like]
        assert main([*arguments, "--out", str(out), "--steps", "10", "--pictures", "32", "--no-progress"]) == 0
        seen = read_album(load_ponder(opened).format, folder).pictures
        with torch.no_grad():
            unlike.append(unlikeness(load_ponder(out / "ponder"), PONDER, torch.from_numpy(seen)).item())
    assert unlike[1] < unlike[0] / 2
    arguments = ["--recipe", "small", "--data", str(folder), "--album", str(folder), "--ponder", str(narrow)]
    assert main([*arguments, "--like", str(wide), "--out", str(tmp_path / "none")]) == REFUSED
    assert "or be what was widened to a fovea of None" in capsys.readouterr().err


def test_several_albums_are_mixed_and_one_stays_in_order(tmp_path: Path) -> None:
    """What is held out at the end is then of all of them."""
    folders = {task: tmp_path / task for task in ("PickHighlight", "PickXtimes")}
    for task, folder in folders.items():
        arguments = ["--out", str(folder), "--task", task, "--pictures", "100", "--image-px", "128", "--no-progress"]
        assert album.main(arguments) == 0
    apart = [read_album(FORM, folder) for folder in folders.values()]
    for one, folder in zip(apart, folders.values(), strict=True):
        assert one.texts == Dataset(folder).rows(0).grounded_subgoal
    mixed = read_album(FORM, *folders.values())
    known = {text: picture for one in apart for text, picture in zip(one.texts, one.pictures, strict=True)}
    assert sorted(mixed.texts) == sorted([*apart[0].texts, *apart[1].texts])
    for text, picture in zip(mixed.texts, mixed.pictures, strict=True):
        assert np.array_equal(picture, known[text])
    assert 0 < sum("target" in text for text in mixed.texts[-20:]) < 20
    assert set(mixed.names) == {*apart[0].names, *apart[1].names}


def test_a_recipe_that_can_see_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--data", str(tmp_path), "--album", str(tmp_path), "--out", str(tmp_path)]
    assert main(["--recipe", "robomme", *where]) == REFUSED
    assert "can see" in capsys.readouterr().err
