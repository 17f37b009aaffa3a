"""Stages: each trains one system or both, from what earlier ones left; what a stage does not need is not made."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dual_system.data.dataset import Dataset
from dual_system.data.episode import About, EpisodeWriter, Row, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.models import flow
from dual_system.models.arm import tool_poses
from dual_system.models.eyes import Eye
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.models.pounce.checkpoint import load_bundle
from dual_system.training import recipes, train
from dual_system.training.augment import AS_IT_IS, Augmentation
from dual_system.training.data import Sight, TrainingSet
from dual_system.training.example import ExampleConfig, make_example, row_frames
from dual_system.training.joint import Draws, JointModel
from dual_system.training.parallel import World
from dual_system.training.recipe import Curriculum, Recipe, stages_of
from dual_system.training.train import Batches, TrainOptions, build
from dual_system.training.trainer import Trainer
from dual_system.training.training_episode import TrainingEpisode

PX, NUM_EPISODES, NUM_ROWS = 64, 2, 50


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _dataset(tmp_path_factory.mktemp("stages") / "set", seeds=range(NUM_EPISODES))


def _dataset(root: Path, *, seeds: range, is_success: bool = True) -> Path:
    writer = DatasetWriter(root)
    for seed in seeds:
        writer.add(unpack(_package(seed, is_success=is_success)))
    writer.finish()
    return root


def _package(seed: int, *, is_success: bool) -> dict[str, bytes]:
    rng = np.random.default_rng(seed)
    episode = EpisodeWriter(PX)
    for k in range(NUM_ROWS):
        joints = np.array([0, 0.2, 0, -2.2, 0, 2.4, 0.8, 0.04], np.float32) + 0.01 * np.float32(k)
        row = Row(
            state=joints,
            action=joints + 0.02,
            tcp_pose=np.zeros(7, np.float32),
            subgoal="press",
            grounded_subgoal=f"press the button at <{60 + seed}, {80 if k < 25 else 90}>",
            is_transition=k in (0, 25),
        )
        episode.add(row, {camera: rng.integers(0, 256, (PX, PX, 3), np.uint8) for camera in ("front", "wrist")})
    return episode.pack(
        About(
            task="PickHighlight", instruction="press it", seed=seed, difficulty="easy", origin="oracle",
            is_success=is_success, image_px=PX,
        )
    )  # fmt: skip


def shrunk(run: Recipe) -> Recipe:
    ponder = replace(run.ponder, image_px=(16, 16), eyes=(Eye(camera=0, box=(0.0, 0.25, 0.5, 0.75)),), vision_depth=1)
    example = replace(run.example, max_invocations=2, max_queries=2, text_dropout=0.0)
    return replace(run, ponder=ponder, example=example, num_steps=2, batch_episodes=2)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> dict[str, Recipe]:
    stages = {run.name.rpartition("/")[2]: shrunk(run) for run in stages_of(recipes.recipe("small"))}
    curriculum = Curriculum(name="small", stages=tuple(stages.values()))
    monkeypatch.setitem(recipes.RECIPES, "small", lambda: curriculum)
    return stages


def options(folder: Path, out: Path, **changes: object) -> TrainOptions:
    return replace(
        TrainOptions(recipe="small", data=(folder,), out=out, save_every=1, progress=False),
        **changes,  # type: ignore[arg-type]
    )


def trainer_of(run: Recipe, folder: Path) -> Trainer:
    data = TrainingSet(folder)
    model, bundle = build(run, data, options(folder, folder / "unused"))
    data = TrainingSet(folder, sight=train._sight(run, model))
    return Trainer(model, train.Batches(data, run, model, bundle, World()), run.train)


def snapshot(model: JointModel, system: str) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in model.named_parameters() if name.startswith(system)}


@pytest.mark.parametrize(
    ("stage", "still", "moves"), [("looking", "pounce.", "ponder."), ("motor", "ponder.", "pounce.")]
)
def test_a_stage_moves_its_own_system_alone(
    folder: Path, small: dict[str, Recipe], stage: str, still: str, moves: str
) -> None:
    trainer = trainer_of(small[stage], folder)
    before, other = snapshot(trainer.model, still), snapshot(trainer.model, moves)
    reports = list(trainer.run(2))
    assert all(torch.equal(now, before[name]) for name, now in snapshot(trainer.model, still).items())
    assert any(not torch.equal(now, other[name]) for name, now in snapshot(trainer.model, moves).items())
    assert (reports[0].flow_matching == 0.0) == (stage == "looking")
    assert (reports[0].alignment > 0.0) == (stage == "looking")
    assert (reports[0].num_supervised > 0) == (stage == "looking")


def test_places_in_mind_are_learned_where_they_weigh(folder: Path, small: dict[str, Recipe]) -> None:
    without, some, more = (
        next(iter(trainer_of(replace(small["looking"], w4=w4), folder).run(1))) for w4 in (0.0, 0.5, 1.5)
    )
    assert without.placing == 0.0
    assert some.placing == more.placing > 0.0
    assert more.total - some.total == pytest.approx(some.placing, rel=1e-4)
    trainer = trainer_of(replace(small["looking"], w3=0.0, w4=1.0), folder)
    reports = list(trainer.run(30))
    assert reports[-1].placing < reports[0].placing


def test_lessons_that_are_missing_are_missed(folder: Path, small: dict[str, Recipe]) -> None:
    trainer = trainer_of(replace(small["looking"], w4=1.0), folder)
    episodes, invocations = trainer._batches(0)
    with pytest.raises(ValueError, match="place lessons of every row; the batch has none"):
        trainer.model(replace(episodes, place_lessons=()), invocations, None)  # type: ignore[arg-type]


def test_eyes_that_are_kept_stay_as_they_are(folder: Path, small: dict[str, Recipe]) -> None:
    trainer = trainer_of(replace(small["looking"], keeps_eyes=True), folder)
    before = snapshot(trainer.model, "ponder.")
    list(trainer.run(2))
    is_same = {name: torch.equal(now, before[name]) for name, now in snapshot(trainer.model, "ponder.").items()}
    assert all(same for name, same in is_same.items() if ".visual." in name)
    assert not all(same for name, same in is_same.items() if ".visual." not in name)


def test_who_only_follows_says_nothing_and_always_reads(folder: Path, small: dict[str, Recipe]) -> None:
    model, _ = build(small["looking"], TrainingSet(folder), options(folder, folder / "unused"))
    config = replace(small["looking"].example, text_dropout=1.0, slips=1.0)
    told = replace(TrainingSet(folder)[0], is_told=True)
    silent, wordless = (
        make_example(episode, model.ponder.format, config, np.random.default_rng(0))
        for episode in (told, replace(told, is_told=False))
    )
    assert silent.is_grounded
    assert not wordless.is_grounded
    assert silent.slip is None
    assert len(silent.row().ids) > len(wordless.row().ids)
    assert not len(silent.row().supervised_index)
    assert len(wordless.row().supervised_index)


def test_ponder_learns_from_episodes_that_nobody_is_to_imitate(folder: Path, small: dict[str, Recipe]) -> None:
    """Corrections may begin after a short row has ended."""
    data = TrainingSet(folder)
    late = [replace(data[number], imitated_from=data[number].num_ticks - 1) for number in range(len(data))]
    data._cache.update(enumerate(late))
    run = replace(small["looking"], example=replace(small["looking"].example, max_queries=1))
    model, bundle = build(run, data, options(folder, folder / "unused"))
    episodes, invocations = Batches(data, run, model, bundle, World())(0)
    assert episodes.num_episodes == run.batch_episodes
    assert len(invocations.actions_INA) > 0


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_shares_of_a_batch_are_as_long_as_each_other(folder: Path, small: dict[str, Recipe], share: float) -> None:
    class Lengths:
        """Seven episodes to imitate and four that are watched."""

        num_imitated = 7
        rows = (30, 900, 200, 400, 650, 80, 510, 260, 120, 300, 240)

        def __len__(self) -> int:
            return len(self.rows)

        def num_rows(self, number: int) -> int:
            return self.rows[number]

    run = replace(small["looking"], batch_episodes=8)
    model, bundle = build(run, TrainingSet(folder), options(folder, folder / "unused"))
    lengths: Any = Lengths()
    shares = [Batches(lengths, run, model, bundle, World(rank=rank, size=2), share) for rank in (0, 1)]
    seen = set()
    for seed in range(30):
        drawn = [each._draw(np.random.default_rng(seed)) for each in shares]
        np.testing.assert_array_equal(*drawn)
        numbers = drawn[0].tolist()
        watched = [number for number in numbers if number >= Lengths.num_imitated]
        assert len(watched) == min(round(8 * share), 7)
        assert watched == numbers[8 - len(watched) :]
        long, short = (sum(Lengths.rows[numbers[place]] for place in each._places) for each in shares)
        kinds = numbers[: 8 - len(watched)], watched
        longest = [max((Lengths.rows[number] for number in kind), default=0) for kind in kinds]
        assert abs(long - short) <= sum(longest)  # of either kind; in any order it could be that of all
        seen.update(numbers)
    assert len(seen) == {0.0: 7, 0.3: 11, 1.0: 11}[share]


def test_a_stage_makes_only_what_it_reads(folder: Path, small: dict[str, Recipe]) -> None:
    stages = small["motor"], small["looking"], replace(small["joint"], w3=0.0), small["joint"]
    motor, looking, joint, aligned = (trainer_of(stage, folder)._batches(0) for stage in stages)
    assert (motor[0].rows, motor[0].frames, len(motor[0].stand_ins)) == ((), (), 2)
    assert motor[1].inputs.images.shape[1] == 0  # the small POUNCE reads no pictures
    assert len(looking[0].rows) == len(looking[0].stand_ins) == 2
    assert looking[1].inputs.images.shape[1] == 0
    assert (len(joint[0].rows), joint[0].stand_ins, len(joint[1].actions_INA)) == (2, (), 4)
    assert len(aligned[0].stand_ins) == 2


def test_all_stages_follow_each_other_and_the_last_is_what_is_served(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    train.train(options(folder, out))
    assert not (out / "motor" / "ponder").exists()
    assert not (out / "looking" / "pounce").exists()
    served, last = load_ponder(out / "ponder"), load_ponder(out / "joint" / "ponder")
    assert not served.is_random
    for (name, mine), (_, theirs) in zip(served.named_parameters(), last.named_parameters(), strict=True):
        assert torch.equal(mine, theirs), name
    bundle = load_bundle(out / "pounce")
    assert (bundle.statistics.space, len(bundle.statistics.reach)) == ("ee_delta", bundle.model.config.horizon)
    assert len(bundle.tokenizer.encode("press it\n")) < 8
    with pytest.raises(ValueError, match="holds a finished run"):
        train.train(options(folder, out))


def test_the_newest_of_either_system_is_served(
    folder: Path, tmp_path: Path, small: dict[str, Recipe], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the last stage trains one of them alone."""
    monkeypatch.setitem(
        recipes.RECIPES, "small", lambda: Curriculum(name="small", stages=(small["joint"], small["looking"]))
    )
    train.train(options(folder, tmp_path))
    for stage, system in (("looking", "ponder"), ("joint", "pounce")):
        one, other = (at / system / "model.safetensors" for at in (tmp_path, tmp_path / stage))
        assert one.read_bytes() == other.read_bytes()


def test_stages_run_apart_are_the_run_in_one_go(folder: Path, tmp_path: Path) -> None:
    train.train(options(folder, tmp_path / "together"))
    for stage in (
        "reaching",
        "motor",
        "looking",
        "grounding",
        "mending",
        "refining",
        "joint",
    ):  # neither system waits for the other
        train.train(options(folder, tmp_path / "apart", stage=stage))
    for system in ("ponder", "pounce"):
        one, other = (tmp_path / name / system / "model.safetensors" for name in ("together", "apart"))
        assert one.read_bytes() == other.read_bytes()


def test_a_stage_that_does_not_exist_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="refining, joint; there is no 'driving'"):
        train.train(options(folder, tmp_path / "run", stage="driving"))
    with pytest.raises(ValueError, match="tiny has no stages"):
        train.train(options(folder, tmp_path / "run", recipe="tiny", stage="joint"))


def test_pictures_kept_small_are_what_whole_ones_become(folder: Path, small: dict[str, Recipe]) -> None:
    run = small["joint"]
    model, bundle = build(run, TrainingSet(folder), options(folder, folder / "unused"))
    form, pounce_px = model.ponder.format, run.pounce.image_px
    whole, kept = TrainingSet(folder), TrainingSet(folder, sight=Sight(form=form, pounce_px=pounce_px))
    config = ExampleConfig(clocks=run.example.clocks)
    examples = [make_example(data[1], form, config, np.random.default_rng(3)) for data in (whole, kept)]
    assert examples[0].row().ids == examples[1].row().ids
    assert torch.equal(*(row_frames(e.episode, form, e.schedule) for e in examples))
    batches = [
        train.collate_pounce([e], model.pounce.config, bundle.tokenizer, bundle.statistics).inputs for e in examples
    ]
    assert torch.equal(batches[0].images, batches[1].images)


@pytest.mark.parametrize("pounce_px", [None, 32])
def test_sights_kept_on_disk_are_those_of_the_videos(
    folder: Path, small: dict[str, Recipe], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pounce_px: int | None
) -> None:
    model, _ = build(small["joint"], TrainingSet(folder), options(folder, folder / "unused"))
    sight = Sight(form=model.ponder.format, pounce_px=pounce_px)
    decoded = list(TrainingSet(folder, sight=sight))
    assert_alike(decoded, list(TrainingSet(folder, sight=sight, sights=tmp_path)))
    files = sorted(tmp_path.glob("*/*.npz"))
    assert len(files) == NUM_EPISODES
    files[0].write_bytes(files[0].read_bytes()[:-40])
    assert_alike(decoded, list(TrainingSet(folder, sight=sight, sights=tmp_path)))  # made again
    monkeypatch.setattr(Dataset, "frames", lambda *_: pytest.fail("a video was read"))
    assert_alike(decoded, list(TrainingSet(folder, sight=sight, sights=tmp_path)))
    other = replace(sight, pounce_px=16)
    with pytest.raises(pytest.fail.Exception, match="a video was read"):
        TrainingSet(folder, sight=other, sights=tmp_path)[0]


def assert_alike(some: list[TrainingEpisode], others: list[TrainingEpisode]) -> None:
    for one, other in zip(some, others, strict=True):
        assert one.sights is not None
        assert other.sights is not None
        for its, theirs in ((one.frames, other.frames), (one.sights, other.sights)):
            for views, same in zip(its, theirs, strict=True):
                assert all(np.array_equal(*pair) for pair in zip(views, same, strict=True))


def test_a_full_disk_keeps_no_sights_and_loses_nothing(
    folder: Path, small: dict[str, Recipe], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    model, _ = build(small["joint"], TrainingSet(folder), options(folder, folder / "unused"))
    sight = Sight(form=model.ponder.format, pounce_px=None)
    monkeypatch.setattr(np, "savez", full)
    assert_alike(list(TrainingSet(folder, sight=sight)), list(TrainingSet(folder, sight=sight, sights=tmp_path)))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_several_flow_samples_are_the_mean_of_single_ones(folder: Path, small: dict[str, Recipe]) -> None:
    trainer = trainer_of(small["motor"], folder)
    episodes, batch = trainer._batches(0)
    both = Draws.draw(batch, flow.sample_times, 0.0, [torch.Generator().manual_seed(s) for s in (1, 2)], num_samples=2)
    loss = trainer.model(episodes, batch, both).flow_matching
    count = len(batch.actions_INA)
    singles = [
        replace(both, noise_SNA=both.noise_SNA[part], time_S=both.time_S[part])
        for part in (slice(0, count), slice(count, None))
    ]
    apart = torch.stack([trainer.model(episodes, batch, one).flow_matching for one in singles])
    torch.testing.assert_close(loss, apart.mean())
    assert trainer.model(episodes, batch, both).num_rows == 2 * count * batch.actions_INA.shape[1]


def test_rows_in_their_own_measure_have_one_spread_and_come_back(folder: Path) -> None:
    data = TrainingSet(folder)
    statistics = data.statistics(6, "ee_delta", by_row=True)
    episode = data[0]
    ticks = np.arange(0, NUM_ROWS - 6)
    chunks = statistics.normalise_chunks(episode.action_T8, episode.state_T8[ticks], ticks[:, None] + np.arange(6))
    spread_N = np.abs(chunks[..., :3]).mean(axis=(0, 2))
    assert spread_N.max() < 1.5 * spread_N.min()
    back = statistics.absolute_targets(chunks[3], episode.state_T8[3])
    reached, meant = (tool_poses(rows[:, :7]).position_m for rows in (back, episode.action_T8[3:9]))
    np.testing.assert_allclose(reached, meant, atol=1e-4)  # the arm has a joint to spare: poses come back, not joints
    tail = statistics.normalise_targets(episode.action_T8[5:9], episode.state_T8[3], first_row=2)
    np.testing.assert_allclose(tail, chunks[3, 2:], atol=1e-5)
    with pytest.raises(ValueError, match="chunks of 6 rows, came 7"):
        statistics.normalise_targets(episode.action_T8[:7], episode.state_T8[0])


def test_a_row_without_its_texts_keeps_its_queries(folder: Path, small: dict[str, Recipe]) -> None:
    model, _ = build(small["looking"], TrainingSet(folder), options(folder, folder / "unused"))
    told, untold = (
        make_example(
            TrainingSet(folder)[0],
            model.ponder.format,
            replace(small["looking"].example, text_dropout=share, max_queries=None),
            np.random.default_rng(0),
        )
        for share in (0.0, 1.0)
    )
    assert len(told.row().carrier_index) == len(untold.row().carrier_index)
    assert len(told.row().supervised_index) > len(untold.row().supervised_index)
    assert torch.equal(told.stand_ins(128), untold.stand_ins(128))


def test_what_is_watched_teaches_ponder_alone(folder: Path, tmp_path: Path, small: dict[str, Recipe]) -> None:
    """A failed episode of a policy: in PONDER's rows like any other, in POUNCE's invocations and statistics not."""
    watched = _dataset(tmp_path / "watched", seeds=range(7, 10), is_success=False)
    alone, both = TrainingSet(folder), TrainingSet(folder, watched=(watched,))
    assert (alone.num_imitated, both.num_imitated, len(both)) == (NUM_EPISODES, NUM_EPISODES, NUM_EPISODES + 3)
    assert [both[n].is_watched for n in range(len(both))] == [False] * NUM_EPISODES + [True] * 3
    assert both.statistics(4) == alone.statistics(4)
    assert both.hash != alone.hash
    run = replace(small["joint"], batch_episodes=4)
    model, bundle = build(run, both, options(folder, tmp_path))
    for share, num_watched in ((0.0, 0), (0.5, 2), (1.0, 3)):
        batches = Batches(both, run, model, bundle, World(), share)
        for step in range(5):
            episodes, invocations = batches(step)
            assert episodes.num_episodes == 4
            assert set(invocations.episode_I.tolist()) == set(range(4 - num_watched))


def test_shares_that_are_none_and_batches_to_look_at_only_are_refused(
    folder: Path, tmp_path: Path, small: dict[str, Recipe]
) -> None:
    both = TrainingSet(folder, watched=(_dataset(tmp_path / "watched", seeds=range(7, 8)),))
    model, bundle = build(small["joint"], both, options(folder, tmp_path))
    with pytest.raises(ValueError, match="--watch-share must be in"):
        Batches(both, small["joint"], model, bundle, World(), 1.5)
    second_of_two = Batches(both, small["joint"], model, bundle, World(rank=1, size=2), 0.5)
    with pytest.raises(ValueError, match="lower --watch-share"):
        second_of_two(0)


def test_where_pounce_learns_only_watched_episodes_are_seen_otherwise(
    folder: Path, tmp_path: Path, small: dict[str, Recipe]
) -> None:
    both = TrainingSet(folder, watched=(_dataset(tmp_path / "watched", seeds=range(7, 8)),))
    run = small["joint"]
    model, _ = build(run, both, options(folder, tmp_path))
    for number in range(len(both)):
        views = [
            make_example(both[number], model.ponder.format, run.example, np.random.default_rng(seed)).view
            for seed in range(8)
        ]
        assert (set(views) == {AS_IT_IS}) == (number < NUM_EPISODES)
    with pytest.raises(ValueError, match="augment watched episodes only"):
        replace(run, example=replace(run.example, augments="all"))
    relit = replace(run.example, augments="all", augmentation=Augmentation(max_gain=0.2))
    assert replace(run, example=relit).example == relit  # light moves nothing
