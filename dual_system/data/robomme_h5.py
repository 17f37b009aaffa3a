"""RoboMME's own recordings: ``record_dataset_<Task>.h5``, as its recorder writes them (benchmark, `RecordWrapper`).

A time step holds an action and what was seen *after* it, at 20 Hz.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.data.episode import require_finite
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_folder import reading
from dual_system.data.mapping import GRIPPER, ROBOMME, ROBOT_DIM
from dual_system.data.source import SourceEpisode, in_force, paired
from dual_system.data.video import FPS

SUFFIXES = (".h5", ".hdf5")


class RobommeFile:
    """The episodes of one file. A context manager.

    Raises DatasetError if h5py is missing, or the file is none of RoboMME's.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            h5py = importlib.import_module("h5py")
        except ImportError:
            raise DatasetError(f"{path}: reading HDF5 needs h5py: pip install h5py (extra `import`)") from None
        with reading(path):
            self._file: Any = h5py.File(path, "r")
        self._numbers = sorted(int(name.split("_")[1]) for name in self._file if re.fullmatch(r"episode_\d+", name))
        if not self._numbers:
            raise DatasetError(f"{path} holds no episode_<number>; expected RoboMME's record_dataset_<Task>.h5")

    def __enter__(self) -> RobommeFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __len__(self) -> int:
        return len(self._numbers)

    def __iter__(self) -> Iterator[SourceEpisode]:
        for number in self._numbers:
            with reading(self._path):
                try:
                    episode = self._episode(number)
                except KeyError as error:
                    raise ValueError(f"{self._path}: episode {number}: {error.args[0]}") from None
            yield episode

    def _episode(self, number: int) -> SourceEpisode:
        group = self._file[f"episode_{number}"]
        steps = [group[f"timestep_{step}"] for step in _steps(group)]
        joints = np.stack([_vector(step["obs/joint_state"])[: ROBOT_DIM - 1] for step in steps])
        fingers = np.array([_vector(step["obs/gripper_state"])[:1] for step in steps])
        commands = [_vector(step["action/joint_action"]) for step in steps]
        state_T8 = np.concatenate([joints, fingers], axis=1).astype(np.float32)
        action_T8 = np.stack([_with_gripper(command) for command in commands])
        for name, values in (("obs/joint_state or gripper_state", state_T8), ("action/joint_action", action_T8)):
            require_finite(f"{self._path}: episode {number}: {name}", values)
        setup, task = group["setup"], self._path.stem.rpartition("_")[2]
        texts = {
            name: in_force([_text(step["info"][name]) for step in steps], ROBOMME.done_text)
            for name in ("simple_subgoal", "grounded_subgoal")
        }
        cameras = {"front": "obs/front_rgb", "wrist": "obs/wrist_rgb"}

        def frames(camera: str, rows: Sequence[int]) -> NDArray[np.uint8]:
            return np.stack([np.asarray(steps[row][cameras[camera]][()], np.uint8) for row in rows])

        episode = SourceEpisode(
            task=task,
            instruction=_text(setup["task_goal"]),
            number=int(np.ravel(setup["seed"][()])[0]),
            difficulty=_text(setup["difficulty"]),
            rows_hz=FPS,
            state_T8=state_T8,
            action_T8=action_T8,
            subgoal=texts["simple_subgoal"],
            grounded_subgoal=texts["grounded_subgoal"],
            is_demonstration_T=np.array([bool(np.ravel(step["info/is_video_demo"][()])[0]) for step in steps]),
            frames=frames,
        )
        return paired(episode, self._path)


def _steps(group: Any) -> list[int]:
    return sorted(int(name.split("_")[1]) for name in group if re.fullmatch(r"timestep_\d+", name))


def _vector(stored: Any) -> NDArray[np.float64]:
    return np.ravel(np.asarray(stored[()], np.float64))


def _with_gripper(command: NDArray[np.float64]) -> NDArray[np.float32]:
    """A command (8,); the stick's has no gripper, or a number that is ignored."""
    gripper = command[ROBOT_DIM - 1] if len(command) >= ROBOT_DIM else GRIPPER[0]
    return np.append(command[: ROBOT_DIM - 1], gripper).astype(np.float32)


def _text(stored: Any) -> str:
    """A text; of a list of paraphrases the first."""
    value = np.ravel(np.asarray(stored[()], object))[0]
    return value.decode() if isinstance(value, bytes) else str(value)
