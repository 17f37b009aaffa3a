"""GR-1's demonstrations of the scenes: which video belongs to a seed, and which of its frames are shown."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

VIDEO_HZ = 20
_PER_CHUNK = 100  # LeRobot's chunks of this data set


class DemonstrationError(ValueError):
    """A demonstration that is not there, or cannot be read."""


class Demonstrations:
    """The videos of a LeRobot data set per task, ``ROOT/TASK/videos/chunk-000/observation.images.CAMERA/``.

    ``cameras``: the file video_key_map_gr1.json, which says whose camera filmed a task.
    """

    def __init__(self, root: Path, cameras: Path) -> None:
        found = json.loads(cameras.read_text(encoding="utf-8"))
        if not isinstance(found, dict) or not all(isinstance(each, str) for each in found.values()):
            raise DemonstrationError(f"{cameras}: expected the name of a camera for each task")
        self._root, self._cameras, self._file = root, found, cameras

    def video_of(self, task: str, seed: int) -> tuple[int, Path]:
        """The demonstration of a scene: the one with its number. Some tasks have fewer, and numbers have gaps: then the
        seed modulo their number counts through those that are there, as in the released server."""
        if task not in self._cameras:
            raise DemonstrationError(
                f"{self._file} has no camera for {task}; it has {', '.join(sorted(self._cameras))}"
            )
        name = "observation.images." + self._cameras[task].replace("observation.images.", "", 1)
        folder = self._root / task / "videos"
        numbers = sorted(int(path.stem.rpartition("_")[2]) for path in folder.glob(f"chunk-*/{name}/episode_*.mp4"))
        if not numbers:
            raise DemonstrationError(f"{folder}: expected chunk-000/{name}/episode_000000.mp4 and others, came none")
        number = seed if seed in numbers else numbers[seed % len(numbers)]
        return number, folder / f"chunk-{number // _PER_CHUNK:03d}" / name / f"episode_{number:06d}.mp4"


def shown(num_frames: int, demo_hz: int, max_frames: int) -> list[int]:
    """The frames of a video that are shown: every (20 / ``demo_hz``)-th, of these at most so many, evenly spread."""
    indices = list(range(0, num_frames, max(1, round(VIDEO_HZ / demo_hz))))
    if 0 < max_frames < len(indices):
        indices = [indices[at] for at in np.linspace(0, len(indices) - 1, max_frames, dtype=int)]
    return indices


def frames_of(path: Path) -> list[np.ndarray]:
    """All frames (height, width, 3) uint8 RGB of a video, by PyAV or OpenCV. Raises DemonstrationError without any."""
    try:
        import av
    except ImportError:
        found = _by_opencv(path)
    else:
        with av.open(str(path.absolute())) as container:  # FFmpeg takes "run:1" at its beginning for a protocol
            found = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    if not found:
        raise DemonstrationError(f"{path}: no frame can be read")
    return found


def _by_opencv(path: Path) -> list[np.ndarray]:
    import cv2

    video, found = cv2.VideoCapture(str(path)), []
    while True:
        is_read, frame = video.read()
        if not is_read:
            video.release()
            return found
        found.append(np.ascontiguousarray(frame[..., ::-1]))
