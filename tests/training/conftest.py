"""Episodes and datasets of noise, small enough to train on within a test."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path

import numpy as np
import pytest

from dual_system.data.episode import About, EpisodeWriter, Package, Row, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.training.episode import TrainingEpisode

PX = 64
NUM_ROWS = 45
CHANGE_ROW = 60
"""Row at which the second subgoal begins, in episodes that are so long."""


def noise_episode(
    num_ticks: int, *, num_demo: int = 0, seed: int = 0, changes: tuple[int, ...] = (0,)
) -> TrainingEpisode:
    """PONDER and POUNCE both read the two cameras' 64 px pictures; another subgoal begins at each of ``changes``."""
    rng = np.random.default_rng(seed)

    def views() -> tuple[np.ndarray, ...]:
        return tuple(rng.integers(0, 256, (PX, PX, 3), np.uint8) for _ in range(2))

    seen = [views() for _ in range(num_ticks)]
    count_T = np.cumsum(np.isin(np.arange(num_ticks), changes))
    return TrainingEpisode(
        instruction="press the button, then pick",
        demo=tuple(views() for _ in range(num_demo)),
        images=seen,
        views=seen,
        state_TS=rng.uniform(-0.2, 0.2, (num_ticks, 8)).astype(np.float32),
        action_TA=rng.uniform(-0.2, 0.2, (num_ticks, 8)).astype(np.float32),
        subgoals=[f"pick cube {count} at <{count}, 20>" for count in count_T.tolist()],
        is_transition_T=np.isin(np.arange(num_ticks), changes),
        reasoning="Demo selected <77, 103>." if num_demo else "",
    )


def noise_package(
    seed: int, num_demo: int = 0, *, unrendered: Collection[int] = (), num_rows: int = NUM_ROWS, px: int = PX
) -> Package:
    """An episode as it lies on disk; the brightness of its pictures counts its rows."""
    rng, episode = np.random.default_rng(seed), EpisodeWriter(px)
    for index in range(num_demo + num_rows):
        row = Row(
            state=rng.uniform(-0.2, 0.2, 8).astype(np.float32),
            action=rng.uniform(-0.2, 0.2, 8).astype(np.float32),
            tcp_pose=np.zeros(7, np.float32),
            subgoal="pick it",
            grounded_subgoal=f"pick it at <{1 + index // CHANGE_ROW}, 7>",
            is_demonstration=index < num_demo,
            is_transition=index in (num_demo, CHANGE_ROW),
            demonstration_reasoning="Demo selected <3, 4>." if num_demo and index == num_demo else "",
        )
        picture = np.full((px, px, 3), 20 + index, np.uint8)
        episode.add(row, {} if index in unrendered else {"front": picture, "wrist": 255 - picture})
    about = About(
        task="PickHighlight", instruction="pick what was shown", seed=seed, difficulty="easy", origin="oracle",
        is_success=True, image_px=px,
    )  # fmt: skip
    return episode.pack(about)


def write(root: Path, packages: Iterable[Package]) -> Path:
    writer = DatasetWriter(root)
    for package in packages:
        writer.add(unpack(package))
    writer.finish()
    return root


@pytest.fixture(scope="session")
def episode_of_noise() -> Callable[..., TrainingEpisode]:
    return noise_episode


@pytest.fixture(scope="session")
def package_of_noise() -> Callable[..., Package]:
    return noise_package


@pytest.fixture(scope="session")
def write_dataset() -> Callable[[Path, Iterable[Package]], Path]:
    return write


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two episodes, the second after a demonstration of 41 rows."""
    return write(tmp_path_factory.mktemp("data") / "set", [noise_package(0), noise_package(1, 41)])
