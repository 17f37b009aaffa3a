"""``pp-train`` from a dataset's folder to folders that the servers load."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dual_system.training.notes import moving_places
from safetensors.torch import load_file

from dual_system.data.episode import About, EpisodeWriter, Row, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.models.action_space import ActionSpace, num_dims
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.pi05.prompt import with_subgoal
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.models.ponder.demo_sampling import DemoSampling, declared
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle
from dual_system.training import recipes, train
from dual_system.training.chunks import chunk_ticks
from dual_system.training.data import Sight, TrainingSet
from dual_system.training.example import make_example
from dual_system.training.parallel import World
from dual_system.training.recipe import Recipe, stages_of
from dual_system.training.train import TrainOptions
from pounce_server.contract import example_request
from pounce_server.engine import EagerEngine

PX = 64
NUM_DEMO_ROWS = 41


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of noise, the second after a demonstration."""
    root = tmp_path_factory.mktemp("data") / "set"
    writer = DatasetWriter(root)
    for number, num_demo in enumerate((0, NUM_DEMO_ROWS)):
        writer.add(unpack(_episode(number, num_demo)))
    writer.finish()
    return root


def _episode(seed: int, num_demo: int, unseen: Collection[int] = ()) -> dict[str, bytes]:
    rng = np.random.default_rng(seed)
    episode = EpisodeWriter(PX)
    for index in range(num_demo + 45):
        row = Row(
            state=rng.uniform(-0.2, 0.2, 8).astype(np.float32),
            action=rng.uniform(-0.2, 0.2, 8).astype(np.float32),
            tcp_pose=np.zeros(7, np.float32),
            subgoal="pick it",
            grounded_subgoal=f"pick it at <{1 + index // 60}, 7>",
            is_demonstration=index < num_demo,
            is_transition=index in (num_demo, 60),
            demonstration_reasoning="Demo selected <3, 4>." if num_demo and index == num_demo else "",
        )
        picture = np.full((PX, PX, 3), 20 + index, np.uint8)
        episode.add(row, {} if index in unseen else {"front": picture, "wrist": 255 - picture})
    about = About(
        task="PickHighlight", instruction="pick what was shown", seed=seed, difficulty="easy", origin="oracle",
        is_success=True, image_px=PX,
    )  # fmt: skip
    return episode.pack(about)


@pytest.fixture(autouse=True)
def small_recipe(monkeypatch: pytest.MonkeyPatch) -> None:
    run = recipes.tiny()
    ponder = replace(run.ponder, image_px=(PX, PX), num_layers=4)
    small = replace(run, ponder=ponder, example=replace(run.example, max_invocations=2), batch_episodes=2)
    monkeypatch.setitem(recipes.RECIPES, "tiny", lambda: small)
    other = recipes.tiny_groot()
    groot = replace(other, ponder=ponder, example=replace(other.example, max_invocations=2))
    monkeypatch.setitem(recipes.RECIPES, "tiny_groot", lambda: groot)
    text = replace(small, name="tiny_subgoal_text", pounce=recipes.tiny_subgoal_text().pounce)
    monkeypatch.setitem(recipes.RECIPES, "tiny_subgoal_text", lambda: text)


def options(folder: Path, out: Path, **changes: object) -> TrainOptions:
    return replace(
        TrainOptions(recipe="tiny", data=(folder,), out=out, steps=2, save_every=1, progress=False),
        **changes,  # type: ignore[arg-type]
    )


def test_an_episode_is_read_as_it_was_written(folder: Path) -> None:
    episode = TrainingSet(folder)[1]
    written = unpack(_episode(1, NUM_DEMO_ROWS)).rows
    assert [len(episode.demo), episode.num_ticks] == [3, 45]  # 1 Hz: rows 0, 20, 40
    np.testing.assert_array_equal(episode.state_T8, written.state[NUM_DEMO_ROWS:])
    np.testing.assert_array_equal(episode.action_T8, written.action[NUM_DEMO_ROWS:])
    assert episode.reasoning == "Demo selected <3, 4>."
    assert episode.transition_ticks == {0, 60 - NUM_DEMO_ROWS}
    brightness = [int(views[0].mean()) for views in (*episode.demo, episode.frames[0], episode.frames[44])]
    assert brightness == pytest.approx([20, 40, 60, 20 + NUM_DEMO_ROWS, 64 + NUM_DEMO_ROWS], abs=2)  # H.264 rounds
    assert int(episode.frames[0][1].mean()) == pytest.approx(255 - 20 - NUM_DEMO_ROWS, abs=2)


@pytest.mark.parametrize("num_demo", [1, 10, 20, 21, 22, 40, 59])
@pytest.mark.parametrize("is_rendered", [True, False])
@pytest.mark.parametrize("demo_hz", [1, 2])
def test_a_video_is_looked_at_so_often_and_at_its_end_if_that_was_rendered(
    tmp_path: Path, num_demo: int, is_rendered: bool, demo_hz: int
) -> None:
    writer = DatasetWriter(tmp_path / "set")
    last, every = num_demo - 1, 20 // demo_hz
    writer.add(unpack(_episode(1, num_demo, () if is_rendered or last % every == 0 else (last,))))
    writer.finish()
    episode = TrainingSet(tmp_path / "set", demo_hz=demo_hz)[0]
    rows = sorted({*range(0, num_demo, every), *([last] if is_rendered else [])})
    assert [int(views[0].mean()) for views in episode.demo] == pytest.approx([20 + row for row in rows], abs=2)
    told = [f"pick it at <{1 + row // 60}, 7>" for row in rows]
    assert [list(episode.demo_subgoals), len(episode.demo_tools), len(episode.demo_notes)] == [told, *[len(rows)] * 2]
    assert int(episode.frames[0][0].mean()) == pytest.approx(20 + num_demo, abs=2)


@pytest.mark.parametrize("is_rendered", [True, False])
def test_a_trained_ponder_says_how_demonstrations_were_shown(tmp_path: Path, is_rendered: bool) -> None:
    writer = DatasetWriter(tmp_path / "set")
    for seed, num_demo in ((1, 42), (2, 46), (3, 0)):
        writer.add(unpack(_episode(seed, num_demo, () if is_rendered else (num_demo - 1,))))
    writer.finish()
    assert TrainingSet(tmp_path / "set").showing(2) == DemoSampling(hz=2, to_its_end=is_rendered)
    train.train(options(tmp_path / "set", tmp_path / "out"))
    assert declared(tmp_path / "out" / "ponder") == DemoSampling(hz=1, to_its_end=is_rendered)


def test_without_demonstrations_nobody_says_how_they_are_shown(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path / "set")
    writer.add(unpack(_episode(1, 0)))
    writer.finish()
    assert TrainingSet(tmp_path / "set").showing(2) is None


def test_a_video_whose_pictures_were_taken_more_seldom_is_refused(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path / "set")
    writer.add(unpack(_episode(1, 41, tuple(row for row in range(41) if row % 20))))
    writer.finish()
    assert len(TrainingSet(tmp_path / "set")[0].demo) == 3
    with pytest.raises(
        ValueError, match=r"set: the demonstration of PickHighlight 1 .* 2 of these 5 .*--demonstration-hz 2"
    ):
        TrainingSet(tmp_path / "set", demo_hz=2)[0]


def test_sights_of_other_rates_lie_beside_each_other(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path / "set")
    writer.add(unpack(_episode(1, 41)))
    writer.finish()
    sight = Sight(form=None, pounce_px=16)
    for demo_hz in (1, 2, 1):
        episode = TrainingSet(tmp_path / "set", sight=sight, sights=tmp_path / "sights", demo_hz=demo_hz)[0]
        assert len(episode.demo) == 1 + 2 * demo_hz
        assert int(episode.frames[0][0].mean()) == pytest.approx(20 + 41, abs=2)
    assert len([*(tmp_path / "sights").rglob("*.npz")]) == 2


def test_what_was_still_to_come_what_was_said_and_what_moves_are_read(tmp_path: Path) -> None:
    packed = unpack(_episode(11, 0))
    said = ["" for _ in packed.rows.state]
    said[3], said[20] = "look at [500, 20]", "look at [5000, 20]"
    about = replace(packed.about, task="StopCube", is_success=False, unreached=("press it at <3, 4>",))
    writer = DatasetWriter(tmp_path / "set")
    writer.add(replace(packed, about=about, rows=replace(packed.rows, said=tuple(said))))
    writer.finish()
    plain = tmp_path / "plain"
    writer = DatasetWriter(plain)
    writer.add(unpack(_episode(11, 0)))
    writer.finish()
    episode = TrainingSet(plain, watched=[tmp_path / "set"])[1]
    assert episode.unreached == ("press it at <3, 4>",)
    heard = {tick: text for tick, text in enumerate(episode.said) if text}
    assert heard == {3: "look at <5, 128>"}, "a place outside of the picture is no place"
    assert list(episode.moving) == moving_places("StopCube", 11, "easy", 45)
    assert not any(TrainingSet(plain)[0].moving)
    assert not any(TrainingSet(plain)[0].said)


def test_a_small_cache_reads_the_same(folder: Path) -> None:
    large, small = TrainingSet(folder), TrainingSet(folder, cache_mb=0)
    for number in (0, 1, 0):
        assert np.array_equal(large[number].frames[3][0], small[number].frames[3][0])
    assert len(small._cache) == 1


def test_a_tokenizer_of_its_own_has_read_all_that_pounce_will_be_told(folder: Path) -> None:
    data = TrainingSet(folder)
    told = data.told()
    form = recipes.recipe("tiny_subgoal_text")
    assert isinstance(form, Recipe)
    ponder = Ponder.random(form.ponder, seed=0)
    for number in range(len(data)):
        example = make_example(data[number], ponder.format, form.example, np.random.default_rng(number))
        assert example.said[-1]
        assert {with_subgoal(example.episode.instruction, text) for text in ("", *example.said)} <= set(told)
    assert set(data.instructions()) < set(told)


@pytest.mark.parametrize("space", ["joint_delta", "ee_delta"])
def test_statistics_put_what_happened_into_the_networks_range(folder: Path, space: ActionSpace) -> None:
    data = TrainingSet(folder)
    statistics = data.statistics(horizon=4, space=space)
    episodes = [data[number] for number in range(len(data))]
    states = np.concatenate([statistics.normalise_states(episode.state_T8) for episode in episodes])
    chunks = np.concatenate(
        [
            statistics.normalise_chunks(
                episode.action_T8, episode.state_T8, chunk_ticks(np.arange(episode.num_ticks), 4, episode.num_ticks)
            )
            for episode in episodes
        ]
    )
    assert chunks.shape == (len(states), 4, num_dims(space))
    for numbers in (states, chunks):
        assert np.mean(np.abs(numbers) <= 1.0) == pytest.approx(0.98, abs=0.02)


@pytest.mark.parametrize("name", ["tiny", "tiny_groot", "tiny_subgoal_text"])
def test_a_run_leaves_folders_that_the_servers_load(folder: Path, tmp_path: Path, name: str) -> None:
    train.train(options(folder, tmp_path / "run", recipe=name))
    steps = [json.loads(line)["step"] for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert steps == [0, 1]
    assert (tmp_path / "run" / "run.png").exists()
    samples = [json.loads(line) for line in (tmp_path / "run" / "samples.jsonl").read_text().splitlines()]
    assert {sample["step"] for sample in samples} == (set() if name == "tiny_groot" else {0})  # actions only: no words
    ponder = load_ponder(tmp_path / "run" / "ponder")
    assert not ponder.is_random
    assert ponder.format.speaks == (name != "tiny_groot")
    bundle = load_bundle(tmp_path / "run" / "pounce")
    assert not bundle.is_random
    assert not bundle.has_fresh_prefix
    assert bundle.statistics == TrainingSet(folder).statistics(bundle.model.config.horizon)


def test_a_run_that_was_killed_ends_as_one_that_was_not(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train.train(options(folder, tmp_path / "whole"))
    update, done = train.Trainer._update, []

    def dies_at_the_second(self: train.Trainer) -> train.StepReport:
        if done:
            raise KeyboardInterrupt
        done.append(True)
        return update(self)

    with monkeypatch.context() as patch:
        patch.setattr(train.Trainer, "_update", dies_at_the_second)
        with pytest.raises(KeyboardInterrupt):
            train.train(options(folder, tmp_path / "cut"))
    train.train(options(folder, tmp_path / "cut"))
    for name in ("log.jsonl", "ponder/model.safetensors", "pounce/model.safetensors"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"recipe": "tinny"}, "Did you mean 'tiny'?"),
        ({"recipe": "robomme"}, "--ponder, --pounce"),
        ({"products": "tfloat32"}, "is for GPUs"),
        ({"length_groups": 0}, "expected 1 to 2"),
        ({"length_groups": 3}, "expected 1 to 2"),
        ({"loaders": -1}, "at least one process"),
        ({"tasks": ("StopCube",)}, "has no successful episode of StopCube; it has PickHighlight"),
    ],
)
def test_what_does_not_fit_is_said_in_one_sentence(
    folder: Path, tmp_path: Path, changes: dict[str, object], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        train.train(options(folder, tmp_path / "run", **changes))


def test_pictures_of_another_size_are_refused(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (small,) = stages_of(recipes.recipe("tiny"))
    larger = replace(small, ponder=replace(small.ponder, image_px=(96, 96)))
    monkeypatch.setitem(recipes.RECIPES, "tiny", lambda: larger)
    with pytest.raises(ValueError, match="collect with --image-px 96"):
        train.train(options(folder, tmp_path / "run"))


def test_the_program_says_what_is_wrong_and_returns_two(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--recipe", "tiny", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "out")]
    assert train.main(arguments) == 2
    assert "holds no dataset" in capsys.readouterr().err


def test_a_finished_run_is_not_overwritten(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "run" / "pounce").mkdir(parents=True)
    with pytest.raises(train.CheckpointError, match="finished run"):
        train.train(options(folder, tmp_path / "run"))


def test_a_step_draws_the_same_batch_whenever_it_is_asked(folder: Path, tmp_path: Path) -> None:
    (run,) = stages_of(recipes.recipe("tiny"))
    data = TrainingSet(folder)
    model, bundle = train.build(run, data, options(folder, tmp_path))
    batches = train.Batches(data, run, model, bundle, World())
    first, again = batches(5), batches(5)
    assert [r.ids for r in first[0].rows] == [r.ids for r in again[0].rows]
    assert torch.equal(first[1].actions_INA, again[1].actions_INA)
    assert not torch.equal(first[1].actions_INA, batches(6)[1].actions_INA)


def test_who_lays_out_the_rows_changes_nothing(folder: Path, tmp_path: Path) -> None:
    for name, loaders in (("alone", 0), ("helped", 2)):
        train.train(options(folder, tmp_path / name, loaders=loaders))
    alone, helped = (load_file(tmp_path / name / "ponder" / "model.safetensors") for name in ("alone", "helped"))
    assert all(torch.equal(alone[name], helped[name]) for name in alone)


def test_out_of_memory_says_what_to_lower(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: train.Trainer) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(train.Trainer, "_update", full)
    arguments = ["--recipe", "tiny", "--data", str(folder), "--out", str(tmp_path / "out"), "--batch-episodes", "1"]
    assert train.main(arguments) == 2
    said = capsys.readouterr().err
    assert "out of memory at 1 x 2 (episodes a step x invocations each; CUDA" in said
    assert "--max-invocations" in said


def test_what_was_learned_to_be_given_is_served(folder: Path, tmp_path: Path) -> None:
    train.train(options(folder, tmp_path / "run", max_committed_rows=3))
    bundle = load_bundle(tmp_path / "run" / "pounce")
    assert isinstance(bundle.model.config, PounceConfig)
    assert bundle.model.config.max_committed_rows == 3
    engine = EagerEngine(bundle, continuity="trained")
    rows = np.full((2, 8), 0.1, np.float32)
    request = replace(example_request(engine.spec), previous_rows=rows, committed_rows=2)
    np.testing.assert_array_equal(engine.invoke(request)[:2], rows)


def test_groot_does_not_learn_to_be_given_rows(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"is pi0\.5's, recipe tiny_groot trains GR00T"):
        train.train(options(folder, tmp_path / "run", recipe="tiny_groot", max_committed_rows=3))
