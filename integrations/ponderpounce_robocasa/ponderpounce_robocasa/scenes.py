"""Predefined scenes: ``ROOT/TASK/SEED`` with environment.xml, ep_meta.json and initial_state.npz."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


class SceneError(ValueError):
    """A scene that is not there, or cannot be restored."""


@dataclass(frozen=True)
class Scene:
    """One restored start. ``state``: MuJoCo's, flattened by robosuite: time, positions, velocities."""

    task: str
    seed: int
    xml: str
    meta: dict[str, Any]
    state: np.ndarray

    @property
    def instruction(self) -> str:
        return str(self.meta["lang"])


def seeds_of(root: Path, task: str) -> list[int]:
    """Seeds of a task's scenes, ascending. Raises SceneError if there are none."""
    folder = root / task
    found = sorted(int(each.name) for each in folder.glob("*") if each.is_dir() and each.name.isdigit())
    if not found:
        raise SceneError(f"{folder}: expected folders named by seeds, came none")
    return found


def read_scene(root: Path, task: str, seed: int) -> Scene:
    """Reads a scene. Raises SceneError, OSError if a file is missing or is not what it should be."""
    folder = root / task / str(seed)
    meta = json.loads((folder / "ep_meta.json").read_text(encoding="utf-8"))
    if not isinstance(meta, dict) or not isinstance(meta.get("lang"), str) or not meta["lang"].strip():
        raise SceneError(f"{folder / 'ep_meta.json'}: expected an object with the instruction as lang")
    with np.load(folder / "initial_state.npz", allow_pickle=False) as arrays:
        if len(arrays.files) != 1:
            raise SceneError(f"{folder / 'initial_state.npz'}: expected one array, came {', '.join(arrays.files)}")
        state = np.asarray(arrays[arrays.files[0]], np.float64)
    if state.ndim == 2 and len(state):  # a recorded trajectory begins with the state
        state = state[0]
    if state.ndim != 1:
        raise SceneError(f"{folder / 'initial_state.npz'}: expected a flattened state, came {state.shape}")
    return Scene(task, seed, (folder / "environment.xml").read_text(encoding="utf-8"), meta, state)


def restore(env: Any, scene: Scene) -> dict[str, Any]:
    """Puts a scene into RoboCasa's environment: meta, XML, state; returns the first observation.

    Raises SceneError if the simulator is not in the scene's state afterwards.
    """
    env.set_ep_meta(scene.meta)
    env.reset()
    env.reset_from_xml_string(env.edit_model_xml(scene.xml))
    env.sim.reset()
    env.sim.set_state_from_flattened(scene.state)
    env.sim.forward()
    for name in ("update_sites", "update_state"):  # RoboCasa's fixtures follow what they are told
        if hasattr(env, name):
            getattr(env, name)()
    reached = np.asarray(env.sim.get_state().flatten())
    if not np.array_equal(reached, scene.state):
        expected, came = (f"{len(each)} numbers, the first {each[:3].tolist()}" for each in (scene.state, reached))
        raise SceneError(f"{scene.task} {scene.seed}: after restoring expected a state of {expected}, came {came}")
    observation: dict[str, Any] = env._get_observations(force_update=True)
    return observation
