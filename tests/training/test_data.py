"""A dataset is read as it was written, at the sizes that the networks read, from videos or from the store."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clock.sampling import EVALUATION, ROBOMME
from dual_system.data.dataset import Dataset
from dual_system.data.episode import Package, unpack
from dual_system.models.action_space import ActionSpace, num_dims
from dual_system.models.arm import tool_poses
from dual_system.models.images import resized
from dual_system.models.normalisation import RobotStatistics
from dual_system.models.pi05.prompt import tiny_tokenizer_for_random_weights, with_subgoal
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import ContextFormat
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce
from dual_system.models.small_pair.reading import CropReader
from dual_system.training.chunks import chunk_ticks
from dual_system.training.collate import collate_pounce
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import ExampleConfig, make_example

NUM_DEMO_ROWS = 41
WHOLE = PictureSizes(pounce_px=64)
"""Pictures as they were written."""

MakePackage = Callable[..., Package]
WriteDataset = Callable[[Path, Iterable[Package]], Path]


@pytest.fixture(scope="module")
def form() -> ContextFormat:
    """Of a PONDER that reads a crop, so that its images are not POUNCE's views."""
    ponder = Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4), seed=1)
    reader = CropReader(camera=0, box=(0, 0.5, 0.5, 1), first_state_id=460, num_finger_bins=8, num_height_bins=40)
    return replace(ponder.format, reader=reader)


def same_pictures(one: TrainingEpisode, other: TrainingEpisode) -> bool:
    columns = zip((one.demo, one.images, one.views), (other.demo, other.images, other.views), strict=True)
    instants = [pair for column in columns for pair in zip(*column, strict=True)]
    return all(np.array_equal(*pair) for mine, theirs in instants for pair in zip(mine, theirs, strict=True))


def brightness(instants: Iterable[tuple[np.ndarray, ...]], camera: int = 0) -> list[float]:
    return [float(pictures[camera].mean()) for pictures in instants]


def test_an_episode_is_read_as_it_was_written(folder: Path, package_of_noise: MakePackage) -> None:
    episode = TrainingSet(folder, sizes=WHOLE)[1]
    written = unpack(package_of_noise(1, NUM_DEMO_ROWS)).rows
    assert episode.num_ticks == 45
    np.testing.assert_array_equal(episode.state_TS, written.state[NUM_DEMO_ROWS:])
    np.testing.assert_array_equal(episode.action_TA, written.action[NUM_DEMO_ROWS:])
    assert episode.reasoning == "Demo selected <3, 4>."
    assert episode.transition_ticks == {0, 60 - NUM_DEMO_ROWS}
    first_and_last = [20 + NUM_DEMO_ROWS, 64 + NUM_DEMO_ROWS]
    assert brightness([episode.views[0], episode.views[44]]) == pytest.approx(first_and_last, abs=2)  # H.264 rounds
    assert brightness(episode.views[:1], camera=1) == pytest.approx([255 - 20 - NUM_DEMO_ROWS], abs=2)


def test_each_system_gets_the_pictures_that_it_reads(folder: Path, form: ContextFormat) -> None:
    whole = TrainingSet(folder, sizes=WHOLE)[1]
    both = TrainingSet(folder, sizes=PictureSizes(form=form, pounce_px=32))[1]
    for tick in (0, 20, 44):
        assert np.array_equal(both.images[tick], form.reader.images(whole.views[tick], (32, 32)))
        assert all(np.array_equal(a, resized(b, 32)) for a, b in zip(both.views[tick], whole.views[tick], strict=True))
    assert brightness(both.demo) == pytest.approx([20, 40, 60], abs=2)  # 1 Hz: rows 0, 20, 40
    ponders, pounces, none = (
        TrainingSet(folder, sizes=sizes)[1]
        for sizes in (PictureSizes(form=form), PictureSizes(pounce_px=32), PictureSizes())
    )
    assert {*ponders.views} == {()} == {*pounces.images} == {*none.views} == {*none.images}
    assert same_pictures(ponders, replace(both, views=ponders.views))
    assert same_pictures(pounces, replace(both, images=pounces.images, demo=pounces.demo))


def test_pictures_are_resized_as_serving_resizes_them(folder: Path) -> None:
    """A row of whole pictures and one of pictures that are already POUNCE's size are the same inputs."""
    config, form = tiny_pounce(horizon=6), Ponder.random(replace(tiny_cpu(), num_layers=4), seed=1).format
    config = replace(config, pi05=replace(config.pi05, vision=replace(config.pi05.vision, image_px=56)))
    seen = ExampleConfig(clocks=EVALUATION)
    images = []
    for sizes in (WHOLE, PictureSizes(pounce_px=config.image_px)):
        data = TrainingSet(folder, sizes=sizes)
        example = make_example(data[1], form, seen, np.random.default_rng(3))
        statistics = data.statistics(config.horizon)
        images.append(collate_pounce([example], config, tiny_tokenizer_for_random_weights(), statistics).inputs.images)
    assert torch.equal(*images)


@pytest.mark.parametrize("num_demo", [1, 20, 21, 40, 59])
@pytest.mark.parametrize("is_rendered", [True, False])
@pytest.mark.parametrize("demo_hz", [1, 2])
def test_a_demonstration_is_sampled_at_its_rate_and_at_its_end_if_that_was_rendered(
    tmp_path: Path,
    package_of_noise: MakePackage,
    write_dataset: WriteDataset,
    form: ContextFormat,
    num_demo: int,
    is_rendered: bool,
    demo_hz: int,
) -> None:
    last, every = num_demo - 1, 20 // demo_hz
    unrendered = () if is_rendered or last % every == 0 else (last,)
    root = write_dataset(tmp_path / "set", [package_of_noise(1, num_demo, unrendered=unrendered, num_rows=2)])
    episode = TrainingSet(root, sizes=PictureSizes(form=form), demo_hz=demo_hz)[0]
    rows = sorted({*range(0, num_demo, every), *([last] if is_rendered else [])})
    assert brightness(episode.demo) == pytest.approx([20 + row for row in rows], abs=2)
    assert brightness(episode.images[:1]) == pytest.approx([20 + num_demo], abs=2)


@pytest.mark.parametrize("is_rendered", [True, False])
def test_the_set_knows_how_its_demonstrations_are_sampled(
    tmp_path: Path, package_of_noise: MakePackage, write_dataset: WriteDataset, is_rendered: bool
) -> None:
    packages = [
        package_of_noise(seed, num_demo, unrendered=() if is_rendered else (num_demo - 1,), num_rows=2)
        for seed, num_demo in ((1, 42), (2, 46), (3, 0))
    ]
    root = write_dataset(tmp_path / "set", packages)
    assert TrainingSet(root, demo_hz=2).demo_sampling() == DemoSampling(hz=2, to_its_end=is_rendered)
    assert TrainingSet(root).demo_sampling() == DemoSampling(hz=1, to_its_end=is_rendered)


def test_without_demonstrations_nothing_is_known_of_their_sampling(
    tmp_path: Path, package_of_noise: MakePackage, write_dataset: WriteDataset
) -> None:
    root = write_dataset(tmp_path / "set", [package_of_noise(1, num_rows=2)])
    assert TrainingSet(root, demo_hz=2).demo_sampling() is None


def test_a_demonstration_that_was_rendered_more_seldom_is_refused(
    tmp_path: Path, package_of_noise: MakePackage, write_dataset: WriteDataset
) -> None:
    every_second = tuple(row for row in range(41) if row % 20)
    root = write_dataset(tmp_path / "set", [package_of_noise(1, 41, unrendered=every_second)])
    assert len(TrainingSet(root)[0].demo) == 3
    said = r"set: the demonstration of PickHighlight 1 .* 2 of these 5 .*--demonstration-hz 2"
    with pytest.raises(ValueError, match=said):
        TrainingSet(root, demo_hz=2)[0]


def test_a_small_cache_reads_the_same(folder: Path) -> None:
    large, small = TrainingSet(folder, sizes=WHOLE), TrainingSet(folder, sizes=WHOLE, cache_mb=0)
    for number in (0, 1, 0):
        assert same_pictures(large[number], small[number])
    assert len(small._cache) == 1


@pytest.mark.parametrize("pounce_px", [None, 32])
def test_stored_pictures_are_those_of_the_videos(
    folder: Path, form: ContextFormat, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pounce_px: int | None
) -> None:
    sizes = PictureSizes(form=form, pounce_px=pounce_px)

    def stored(sizes: PictureSizes) -> list[TrainingEpisode]:
        return [*TrainingSet(folder, sizes=sizes, store=tmp_path)]

    decoded = [*TrainingSet(folder, sizes=sizes)]
    assert all(map(same_pictures, decoded, stored(sizes)))
    files = sorted(tmp_path.glob("*/*.npz"))
    assert len(files) == len(decoded) * len(sizes.keys), "one of each system"
    files[0].write_bytes(files[0].read_bytes()[:-40])
    assert all(map(same_pictures, decoded, stored(sizes)))  # the damaged one is made again
    monkeypatch.setattr(Dataset, "frames", lambda *_: pytest.fail("a video was decoded"))
    assert all(map(same_pictures, decoded, stored(sizes)))
    for other in (replace(sizes, pounce_px=16), replace(sizes, form=replace(form, image_grid=(2, 2)))):
        with pytest.raises(pytest.fail.Exception, match="a video was decoded"):
            stored(other)


def test_demonstrations_of_other_rates_are_stored_beside_each_other(folder: Path, tmp_path: Path) -> None:
    ponder = Ponder.random(replace(tiny_cpu(), image_px=(64, 64), num_layers=4), seed=1)
    for demo_hz in (1, 2, 1):
        sizes = PictureSizes(form=ponder.format)
        episode = TrainingSet(folder, sizes=sizes, store=tmp_path, demo_hz=demo_hz)[1]
        assert len(episode.demo) == 1 + 2 * demo_hz
        assert brightness(episode.images[:1]) == pytest.approx([20 + NUM_DEMO_ROWS], abs=2)
    assert len([*tmp_path.rglob("*.npz")]) == 2


def test_a_full_disk_stores_nothing_and_loses_nothing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    decoded, stored = TrainingSet(folder, sizes=WHOLE), TrainingSet(folder, sizes=WHOLE, store=tmp_path)
    assert all(map(same_pictures, decoded, stored))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_pictures_of_two_sizes_are_refused(
    folder: Path,
    tmp_path: Path,
    package_of_noise: Callable[..., Package],
    write_dataset: Callable[[Path, Iterable[Package]], Path],
) -> None:
    larger = write_dataset(tmp_path / "larger", [package_of_noise(0, num_rows=5, px=128)])
    with pytest.raises(ValueError, match=r"pictures of \[64, 128\] px in .*larger; .*--image-px"):
        TrainingSet(folder, larger)


def test_a_task_without_an_episode_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="has no successful episode of StopCube; it has PickHighlight"):
        TrainingSet(folder, tasks=("StopCube",))


def test_the_texts_of_a_set_are_all_that_pounce_will_read(folder: Path) -> None:
    data = TrainingSet(folder)
    prompts, form = data.instructions_with_subgoals(), Ponder.random(replace(tiny_cpu(), num_layers=4), seed=0).format
    for number in range(len(data)):
        example = make_example(data[number], form, ExampleConfig(clocks=ROBOMME), np.random.default_rng(number))
        assert example.written[-1]
        assert {with_subgoal(example.episode.instruction, text) for text in ("", *example.written)} <= set(prompts)
    assert set(data.instructions()) < set(prompts)


def chunks_of(data: TrainingSet, statistics: RobotStatistics, horizon: int) -> np.ndarray:
    """Every chunk of every episode as the network learns it, (M, N, D)."""
    chunks = []
    for number in range(len(data)):
        episode = data[number]
        ticks = chunk_ticks(np.arange(episode.num_ticks), horizon, episode.num_ticks)
        chunks.append(statistics.normalise_chunks(episode.action_TA, episode.state_TS, ticks))
    return np.concatenate(chunks)


@pytest.mark.parametrize("space", ["joint_delta", "ee_delta"])
def test_statistics_put_the_data_into_the_networks_range(folder: Path, space: ActionSpace) -> None:
    data = TrainingSet(folder)
    statistics = data.statistics(horizon=4, space=space)
    states = np.concatenate([statistics.normalise_states(data[number].state_TS) for number in range(len(data))])
    chunks = chunks_of(data, statistics, 4)
    assert chunks.shape == (len(states), 4, num_dims(space))
    for numbers in (states, chunks):
        assert np.mean(np.abs(numbers) <= 1.0) == pytest.approx(0.98, abs=0.02)


def test_rows_normalised_by_row_have_one_spread_and_come_back(
    tmp_path: Path, package_of_noise: MakePackage, write_dataset: WriteDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = TrainingSet(write_dataset(tmp_path / "set", [package_of_noise(0)]))
    episode = data[0]
    walk = np.array([0, 0.2, 0, -2.2, 0, 2.4, 0.8, 0.04], np.float32)
    steady = walk + np.arange(episode.num_ticks, dtype=np.float32)[:, None] * 0.01  # later rows move farther
    source = data._sources[0]
    rows = replace(source.rows(), state=steady, action=steady + np.float32(0.02))
    monkeypatch.setattr(type(source), "rows", lambda _: rows)
    statistics = data.statistics(6, "ee_delta", by_row=True)
    ticks = np.arange(episode.num_ticks - 6)
    chunks = statistics.normalise_chunks(rows.action, steady[ticks], ticks[:, None] + np.arange(6))
    spread_N = np.abs(chunks[..., :3]).mean(axis=(0, 2))
    assert spread_N.max() < 1.5 * spread_N.min()
    back = statistics.absolute_targets(chunks[3], steady[3])
    reached, meant = (tool_poses(each[:, :7]).position_m for each in (back, rows.action[3:9]))
    np.testing.assert_allclose(reached, meant, atol=1e-4)  # the arm has a joint to spare: poses come back, not joints
    tail = statistics.normalise_targets(rows.action[5:9], steady[3], first_row=2)
    np.testing.assert_allclose(tail, chunks[3, 2:], atol=1e-5)
    with pytest.raises(ValueError, match="chunks of 6 rows, came 7"):
        statistics.normalise_targets(rows.action[:7], steady[0])


@pytest.mark.parametrize("seed", [500_000, 800_000, 820_099])
def test_scenes_for_measurements_are_not_trained_on(
    tmp_path: Path, package_of_noise: MakePackage, write_dataset: WriteDataset, seed: int
) -> None:
    data = TrainingSet(write_dataset(tmp_path / "set", [package_of_noise(0), package_of_noise(seed)]))
    with pytest.raises(ValueError, match=rf"1 of 2 episodes .*PickHighlight {seed} .*--split rollouts"):
        data.require_trainable()


@pytest.mark.parametrize("change", [{"origin": "import"}, {"task": "WipeTheTable"}, {"seed": 1_000_000}, {"seed": 7}])
def test_others_episodes_and_other_splits_are_trained_on(
    tmp_path: Path, package_of_noise: MakePackage, write_dataset: WriteDataset, change: dict[str, Any]
) -> None:
    data = TrainingSet(write_dataset(tmp_path / "set", [package_of_noise(800_000)]))
    data._sources = [replace(source, entry=replace(source.entry, **change)) for source in data._sources]
    data.require_trainable()
