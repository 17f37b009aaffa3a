"""Shared fixtures: one environment per task, and the recorded benchmark episode as plain facts."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # before anything imports mujoco

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import (
    IMAGE_PX,
    MAX_STEPS,
    Environment,
    EpisodeState,
    Snapshot,
    make_environment,
)
from dual_system.tasks.geometry import pose
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import PlacedCube
from dual_system.tasks.reference.pick_highlight import Layout
from dual_system.tasks.scene import add_button, add_cube, add_disc, table_scene
from dual_system.tasks.task import make_task


@pytest.fixture(scope="session")
def environment() -> Callable[[str], Environment]:
    """Returns one environment without cameras per task name; building a scene takes longer than resetting it."""
    return functools.cache(lambda name: make_environment(name, render=False))


class Remembering(Environment):
    """An environment without cameras that acts out the video of a start once: a start seen lately is restored."""

    def __init__(self, name: str) -> None:
        super().__init__(make_task(name), image_px=IMAGE_PX, render=False, max_steps=MAX_STEPS)
        self._starts: dict[tuple[int, str | None, Any], EpisodeState] = {}

    def reset(self, seed: int, difficulty: str | None = None, *, layout: Any = None) -> Snapshot:
        start = (seed, difficulty, layout)
        if start in self._starts:
            return self.restore(self._starts[start])
        snapshot = super().reset(seed, difficulty, layout=layout)
        if self.has_demonstration:
            self._starts[start] = self.save()
            for oldest in list(self._starts)[:-6]:
                del self._starts[oldest]
        return snapshot


@pytest.fixture(scope="session")
def remembering() -> Callable[[str], Environment]:
    """As `environment`, for tests that often begin with the same video."""
    return functools.cache(Remembering)


@pytest.fixture(scope="session")
def play() -> Callable[[Environment, Iterable[np.ndarray]], Snapshot]:
    """Steps an environment through actions until they or the episode end; returns the last snapshot."""

    def through(env: Environment, actions: Iterable[np.ndarray]) -> Snapshot:
        for action in actions:
            snapshot = env.step(action)
            if snapshot.status is not Status.ONGOING:
                break
        return snapshot

    return through


@pytest.fixture(scope="session")
def until_subtask() -> Callable[[Environment, int], Snapshot]:
    """Plays the oracle's episode up to the step that makes a subtask current; returns that snapshot."""

    def until(env: Environment, index: int) -> Snapshot:
        for action in env.oracle():
            snapshot = env.step(action)
            if snapshot.subtask_index == index:
                return snapshot
        raise AssertionError(f"the oracle never came to subtask {index}")

    return until


@pytest.fixture(scope="session")
def hoist() -> Callable[[Environment, str], Snapshot]:
    """Lets a prop hang in the air for one step, as if somebody had lifted it; returns what is seen then."""

    def hang(env: Environment, name: str) -> Snapshot:
        env.physics.place(name, pose(0.3, 0.4, 0.3))
        env.physics.refresh()
        return env.step(np.append(panda.HOME_QPOS, 1.0))

    return hang


@pytest.fixture(scope="session")
def pick_highlight(environment: Callable[[str], Environment]) -> Environment:
    return environment("PickHighlight")


@pytest.fixture(scope="session")
def rendered() -> Iterator[Environment]:
    """PickHighlight with cameras; only for tests marked sim."""
    with make_environment("PickHighlight") as env:
        yield env


@pytest.fixture(scope="session")
def _small_world() -> Physics:
    spec = table_scene()
    add_cube(spec, "cube")
    add_button(spec, "button")
    add_disc(spec, "disc")
    return Physics(spec)


@pytest.fixture
def world(_small_world: Physics) -> Physics:
    """The table with a cube, a button and a disc, freshly reset."""
    _small_world.reset()
    return _small_world


@pytest.fixture(scope="session")
def recording() -> dict[str, Any]:
    """Measured values of one episode of the real benchmark."""
    return json.loads((Path(__file__).parent / "data" / "pick_highlight_train006.json").read_text())


@pytest.fixture(scope="session")
def recorded_layout(recording: dict[str, Any]) -> Layout:
    return pick_highlight_layout(recording)


def pick_highlight_layout(recording: dict[str, Any]) -> Layout:
    """The recorded scene in our terms."""
    return Layout(
        button_xy_m=tuple(recording["button_xy_m"]),
        cubes=tuple(PlacedCube(**cube) for cube in recording["cubes"]),
        targets=tuple(recording["targets"]),
    )
