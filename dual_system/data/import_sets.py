"""``pp-collect import``: demonstrations of others as a dataset here, to train on.

Reads any LeRobot v3 folder with a mapping file, ``lerobot/robomme`` without one, and RoboMME's own HDF5 files.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from dual_system.data.episode import IMPORTED, About, Episode, EpisodeWriter, Row, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_files import INFO_PATH
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.data.mapping import SourceMapping, read_mapping
from dual_system.data.robomme_h5 import SUFFIXES, RobommeFile
from dual_system.data.source import NO_PICTURE, LeRobotSource, SourceEpisode, at_20_hz, frame_at
from dual_system.data.video import check_image_px
from dual_system.models.arm import tool_poses
from dual_system.tasks.geometry import pose_of
from protocol import files
from protocol.command_line import On, command, parse


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportOptions:
    """Turns demonstrations of others into a dataset that pp-train reads."""

    sources: tyro.conf.Positional[tuple[Path, ...]]
    """LeRobot v3 folders, or RoboMME's HDF5 files."""
    out: Path
    """Folder of the new dataset."""
    mapping: Path | None = None
    """TOML file that names the folders' cameras, state, action and texts (docs/data.md). None: lerobot/robomme's."""
    image_px: int = 256
    """Side of the pictures in pixels; others are scaled, and padded to a square with black."""
    episodes: int | None = None
    """Largest number of episodes of each source. None: all."""
    progress: On = True
    """Do not show a progress bar."""

    def __post_init__(self) -> None:
        check_image_px(self.image_px)


@command("pp-collect import")
def main(argv: list[str] | None = None, prog: str = "pp-collect import") -> int:
    options = parse(ImportOptions, argv, prog=prog)
    num_episodes, num_silent = import_sets(options)
    sys.stdout.write(f"{num_episodes} episodes in {options.out}\n")
    if num_silent:
        sys.stdout.write(
            f"{num_silent} of them have no subgoals: PONDER has no texts to learn from them. Train with w2 = 0 "
            "(--recipe robomme_without_grounding)\n"
        )
    return 0


def import_sets(options: ImportOptions) -> tuple[int, int]:
    """Writes the dataset; returns the number of its episodes, and of those without subgoals.

    Raises:
        DatasetError: there is a dataset already, a source is broken or does not fit the mapping, or nothing is left.
        OSError: a file cannot be read or written.
    """
    if (options.out / INFO_PATH).exists():
        raise DatasetError(f"{options.out} holds a dataset already; use another --out")
    mapping = read_mapping(options.mapping)
    writer = DatasetWriter(files.folder(options.out))
    num_episodes = num_silent = 0
    for path in options.sources:
        for source in _shown(path, mapping, options):
            try:
                episode = as_ours(source, options.image_px)
            except DatasetError as error:
                raise DatasetError(f"{path}: {error}") from None
            with files.writing(options.out):
                writer.add(episode)
            num_episodes += 1
            num_silent += not any(episode.rows.grounded_subgoal)
    if not num_episodes:
        raise DatasetError("none of the sources has an episode")
    with files.writing(options.out):
        writer.finish()
    return num_episodes, num_silent


def _shown(path: Path, mapping: SourceMapping, options: ImportOptions) -> Iterator[SourceEpisode]:
    """Yields the episodes of a source, with a progress bar."""

    def some(source: Any) -> Iterator[SourceEpisode]:
        count = len(source) if options.episodes is None else min(options.episodes, len(source))
        bar = tqdm(zip(range(count), source), total=count, desc=path.name, disable=not options.progress)  # noqa: B905
        yield from (episode for _, episode in bar)

    if path.suffix == ".mcap":
        raise DatasetError(f"{path} is MCAP: pp-collect bags reads rosbag2's, pp-export our logs")
    if path.suffix in SUFFIXES:
        with RobommeFile(path) as file:
            yield from some(file)
    else:
        yield from some(LeRobotSource(path, mapping))


def as_ours(source: SourceEpisode, image_px: int) -> Episode:
    """An episode in our format.

    A subgoal begins with the first text after the demonstration, and wherever the plain text changes: two in a row
    with the same words are one.

    Raises DatasetError if its rate cannot be read, or a demonstration does not come first.
    """
    rows = at_20_hz(source)
    label_N = rows.label_N
    is_demonstration_N = source.is_demonstration_T[label_N]
    start = int(is_demonstration_N.sum())
    if is_demonstration_N[start:].any() or start == len(label_N):
        raise DatasetError(
            f"episode {source.number}: {start} of {len(label_N)} rows are a demonstration; they must come first, and "
            "some rows must follow"
        )
    poses_N7 = tool_poses_7(rows.state_N8)
    writer = EpisodeWriter(image_px)
    pictures = frame_at(source.frames, rows.picture_N[rows.picture_N != NO_PICTURE].tolist())
    said = ""
    for place, label in enumerate(label_N.tolist()):
        is_shown, text = bool(is_demonstration_N[place]), source.subgoal[label] or source.grounded_subgoal[label]
        is_new = not is_shown and bool(text) and text != said
        said = text if is_new else said
        row = Row(
            state=rows.state_N8[place],
            action=rows.action_N8[place],
            tcp_pose=poses_N7[place],
            subgoal=text,
            grounded_subgoal=source.grounded_subgoal[label],
            is_demonstration=is_shown,
            is_transition=is_new,
        )
        has_picture = rows.picture_N[place] != NO_PICTURE
        shown = {camera: _square(frame, image_px) for camera, frame in next(pictures).items()} if has_picture else {}
        writer.add(row, shown)
    about = About(
        task=source.task,
        instruction=source.instruction,
        seed=source.number,
        difficulty=source.difficulty,
        origin=IMPORTED,
        is_success=source.is_success,
        image_px=image_px,
    )
    return unpack(writer.pack(about))


def tool_poses_7(state_N8: NDArray[np.float32]) -> NDArray[np.float32]:
    """Poses (N, 7) of the tool at states (N, 8): xyz [m], quaternion wxyz."""
    poses = tool_poses(state_N8[:, :7])
    placed = np.zeros((len(state_N8), 4, 4))
    placed[:, :3, :3], placed[:, :3, 3] = poses.rotation, poses.position_m
    return np.stack([pose_of(each) for each in placed]).astype(np.float32)


def _square(frame: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    """A picture of any size as a square of ``side_px``, the whole of it, centred on black."""
    height_px, width_px = frame.shape[:2]
    if (height_px, width_px) == (side_px, side_px):
        return frame
    scale = side_px / max(height_px, width_px)
    size = (max(1, round(width_px * scale)), max(1, round(height_px * scale)))
    scaled = np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.BILINEAR))
    found = np.zeros((side_px, side_px, 3), np.uint8)
    top, left = (side_px - size[1]) // 2, (side_px - size[0]) // 2
    found[top : top + size[1], left : left + size[0]] = scaled
    return found


if __name__ == "__main__":
    sys.exit(main())
