"""A recipe that opens PONDER's eyes first: once, from an album that lies in its data; the stages go on from them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.data.episode import About, EpisodeWriter, Row, unpack
from dual_system.data.lerobot_v3 import ALBUM, DatasetWriter
from dual_system.models.eyes import Eye
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.training import recipes, train
from dual_system.training.recipe import Curriculum, Recipe, stages_of
from dual_system.training.train import TrainOptions

PX, NUM_ROWS = 64, 40
PATIENCE_S = 120


def _shrunk(run: Recipe) -> Recipe:
    ponder = replace(run.ponder, image_px=(16, 16), eyes=(Eye(camera=0, box=(0.0, 0.25, 0.5, 0.75)),), vision_depth=1)
    example = replace(run.example, max_invocations=2, max_queries=2)
    return replace(run, ponder=ponder, example=example, num_steps=1, batch_episodes=2)


def _write(root: Path, origin: str, texts: tuple[str, ...]) -> Path:
    """Two episodes of which every row has the next of the texts."""
    writer = DatasetWriter(root)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        episode = EpisodeWriter(PX)
        for k in range(NUM_ROWS):
            joints = np.array([0, 0.2, 0, -2.2, 0, 2.4, 0.8, 0.04], np.float32) + 0.01 * np.float32(k)
            row = Row(
                state=joints,
                action=joints + 0.02,
                tcp_pose=np.zeros(7, np.float32),
                subgoal="press",
                grounded_subgoal=texts[k % len(texts)],
                is_transition=k in (0, 20),
            )
            episode.add(row, {camera: rng.integers(0, 256, (PX, PX, 3), np.uint8) for camera in ("front", "wrist")})
        about = About(
            task="PickHighlight", instruction="press it", seed=seed, difficulty="easy", origin=origin, is_success=True,
            image_px=PX,
        )  # fmt: skip
        writer.add(unpack(episode.pack(about)))
    writer.finish()
    return root


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return _write(tmp_path / "set", "oracle", ("press the button at <60, 90>",))


@pytest.fixture
def album(folder: Path) -> Path:
    texts = ("red cube at <40, 90>, button at <70, 120>", "button at <60, 100>", "red cube at <90, 140>")
    return _write(folder / ALBUM / "PickHighlight", "album", texts)


def _short() -> Curriculum:
    """The recipe with stages of one step, and two steps for its eyes."""
    runs = tuple(_shrunk(run) for run in stages_of(recipes.recipe("starter")))
    return Curriculum(name="starter", stages=runs, eyes_steps=2)


@pytest.fixture(autouse=True)
def _starter(monkeypatch: pytest.MonkeyPatch) -> None:
    curriculum = _short()
    monkeypatch.setitem(recipes.RECIPES, "starter", lambda: curriculum)


def options(folder: Path, out: Path, **changes: object) -> TrainOptions:
    plain = TrainOptions(recipe="starter", data=(folder,), out=out, progress=False)
    return replace(plain, **changes)  # type: ignore[arg-type]


def tower(folder: Path) -> dict[str, torch.Tensor]:
    return {name: value for name, value in load_ponder(folder).state_dict().items() if ".visual." in name}


def test_the_stages_go_on_from_eyes_that_were_opened_once(
    folder: Path, album: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    seen: list[Path | None] = []
    build = train.build
    monkeypatch.setattr(train, "build", lambda run, data, how: seen.append(how.ponder) or build(run, data, how))  # type: ignore[func-returns-value]
    num_threads = torch.get_num_threads()
    train.train(options(folder, out, stage="looking"))
    assert seen == [out / "eyes" / "ponder"]
    assert "4 pictures held out" in capsys.readouterr().out
    assert torch.get_num_threads() == num_threads
    assert list((out / "sights").glob("*/*.npz")), "pictures of all stages are decoded once"
    eyes = (out / "eyes" / "ponder" / "model.safetensors").read_bytes()
    train.train(options(folder, out))  # the others
    assert "held out" not in capsys.readouterr().out
    assert (out / "eyes" / "ponder" / "model.safetensors").read_bytes() == eyes
    assert seen[1:] == [out / "looking" / "ponder", out / "grounding" / "ponder", out / "grounding" / "ponder"]
    assert (out / "ponder").is_dir()
    assert (out / "pounce").is_dir()


def test_the_album_of_the_command_line_comes_before_the_datas(folder: Path, tmp_path: Path, album: Path) -> None:
    other = _write(tmp_path / "other", "album", ("blue cube at <50, 100>",))
    for name, given in (("its", ()), ("given", (other,)), ("the same", (album,))):
        train.train(options(folder, tmp_path / name, stage="looking", album=given))
    its, given, same = (tower(tmp_path / name / "eyes" / "ponder") for name in ("its", "given", "the same"))
    assert any(not torch.equal(its[name], given[name]) for name in its)
    assert all(torch.equal(its[name], same[name]) for name in its)


def test_without_an_album_it_says_how_to_get_one(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="collect with --album 6000"):
        train.train(options(folder, tmp_path / "run"))


def test_a_ponder_that_can_see_needs_none(folder: Path, album: Path, tmp_path: Path) -> None:
    train.train(options(folder, tmp_path / "run", stage="looking"))
    again = options(folder, tmp_path / "again", stage="looking", ponder=tmp_path / "run" / "eyes" / "ponder")
    train.train(replace(again, album=(tmp_path / "nowhere",)))
    assert not (tmp_path / "again" / "eyes").exists()


def run_as_one_of_several(folder: Path, out: Path) -> None:
    """What each process of torchrun does; whoever writes takes its time."""
    curriculum, export = _short(), train.export
    recipes.RECIPES["starter"] = lambda: curriculum

    def slowly(*model: Any, **how: Any) -> None:
        time.sleep(2.0)
        export(*model, **how)

    train.export = slowly
    train.train(options(folder, out, weights="whole"))


@pytest.mark.e2e
@pytest.mark.slow
def test_a_stage_of_two_processes_begins_where_the_one_before_ended(folder: Path, album: Path, tmp_path: Path) -> None:
    """On both of them: whoever looks too early finds the eyes, or nothing, and begins with that."""
    train.train(options(folder, tmp_path / "one"))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", __file__]
    done = subprocess.run(
        [*command, str(folder), str(tmp_path / "two")],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    for stage in ("looking", "grounding", "motor", "joint"):
        mine, theirs = (json.loads((tmp_path / who / stage / "log.jsonl").read_text()) for who in ("one", "two"))
        # eyes that two threads opened are not those of one, bit for bit
        assert theirs["total"] == pytest.approx(mine["total"], rel=1e-3), stage


if __name__ == "__main__":
    run_as_one_of_several(Path(sys.argv[1]), Path(sys.argv[2]))
