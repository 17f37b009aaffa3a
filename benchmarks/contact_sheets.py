"""Contact sheets for visual comparison: per task, a recorded episode's frames above ours in the same scene.

Eight moments are evenly spread over the recorded video and execution; ours are at the same fractions of the oracle's
episode. Front camera, then wrist camera, recorded above ours in both.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import Image

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco
from benchmarks.recorded import Recording, layout_of, read, recorded_tasks
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, EpisodeState, make_environment
from dual_system.tasks.scene import CAMERAS
from protocol.command_line import parse

_GAP_PX = 4
_DEMO = 0  # frame_phase of the conditioning video


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetsOptions:
    """Contact sheets: recorded frames beside ours."""

    recordings: Path
    """Folder of ``<Task>_train006.json`` and ``.npz``."""
    out: Path
    """Folder for one PNG per task."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks. Empty: all that are recorded."""
    columns: int = 8


def moments(recording: Recording, columns: int) -> list[int]:
    """Indices of stored frames, evenly spread from the first to the last."""
    return np.linspace(0, len(recording.arrays["frame_step"]) - 1, columns).round().astype(int).tolist()


def recorded_frame(recording: Recording, camera: str, index: int) -> NDArray[np.uint8]:
    """One stored frame (256, 256, 3)."""
    start, end = recording.arrays[f"frames_{camera}_offsets"][index : index + 2]
    return simplejpeg.decode_jpeg(recording.arrays[f"frames_{camera}"][start:end].tobytes())


def our_frames(env: Environment, recording: Recording, layout: object, indices: list[int]) -> list[dict[str, NDArray]]:
    """Our frames at the same fractions of video and execution as the recording's."""
    facts, arrays = recording.facts, recording.arrays
    env.reset(facts["seed"], facts["difficulty"], layout=layout)
    past: list[EpisodeState] = [env.save()]
    for action in env.oracle():
        env.step(action, look=False)
        past.append(env.save())
        if past[-1].progress.status is not Status.ONGOING:
            break
    video = list(env.demonstration(look_hz=1))
    frames = []
    for index in indices:
        phase, step = int(arrays["frame_phase"][index]), int(arrays["frame_step"][index])
        if phase == _DEMO and video:
            row = round(step / max(facts["demo_frames"] - 1, 1) * (len(video) - 1))
            frames.append(dict(video[row - row % 20].frames))
        else:
            frames.append(dict(env.restore(past[round(step / facts["exec_steps"] * (len(past) - 1))]).frames))
    return frames


def sheet(rows: list[list[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """Frames (rows, columns) as one picture, with thin white gaps."""
    height, width, _ = rows[0][0].shape
    shape = (len(rows) * (height + _GAP_PX) - _GAP_PX, len(rows[0]) * (width + _GAP_PX) - _GAP_PX, 3)
    picture = np.full(shape, 255, dtype=np.uint8)
    for y, row in enumerate(rows):
        for x, frame in enumerate(row):
            top, left = y * (height + _GAP_PX), x * (width + _GAP_PX)
            picture[top : top + height, left : left + width] = frame
    return picture


def main(argv: list[str] | None = None) -> int:
    options = parse(SheetsOptions, argv, prog="contact-sheets")
    options.out.mkdir(parents=True, exist_ok=True)
    for task in options.tasks or recorded_tasks(options.recordings):
        recording, layout = read(task, options.recordings), layout_of(task)
        if layout is None:
            print(f"{task}: no test places its recorded scene yet")
            continue
        indices = moments(recording, options.columns)
        with make_environment(task) as env:
            ours = our_frames(env, recording, layout, indices)
        rows = []
        for camera in CAMERAS:
            rows += [[recorded_frame(recording, camera, i) for i in indices], [frames[camera] for frames in ours]]
        Image.fromarray(sheet(rows)).save(options.out / f"{task}.png")
        print(f"{task}: {task}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
