"""``pp-album``: pictures in which everything is named and placed, as a dataset.

What a pretrained model has seen by the million, and a network from scratch has not: what things look like, and where in
a picture they are. Every row is a scene of its own, drawn as the task draws its episodes, with the arm anywhere above
the table; the grounded text tells all that the front camera sees of it, from left to right. Nobody acts. One episode
of the dataset is a page of such rows, so it is read, stored and looked at like any other.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

import dual_system.tasks.headless  # noqa: F401 - before mujoco is imported
from dual_system.data.episode import About, EpisodeWriter, Row, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_v3 import INFO_PATH, DatasetWriter
from dual_system.data.video import Frame
from dual_system.tasks import demonstration
from dual_system.tasks.captions import Pixel
from dual_system.tasks.difficulty import DIFFICULTIES, Difficulty
from dual_system.tasks.environment import IMAGE_PX
from dual_system.tasks.geometry import pose, pose_of, transform
from dual_system.tasks.kinematics import Kinematics, UnreachableError
from dual_system.tasks.panda import HOME_OPENING_M, HOME_QPOS
from dual_system.tasks.physics import Physics
from dual_system.tasks.rendering import Cameras
from dual_system.tasks.scene import FRONT, table_scene
from dual_system.tasks.sight import mean_pixel, visible_pixels
from dual_system.tasks.task import Task, TaskError, Thing, make_task

DONE, REFUSED = 0, 2
INSTRUCTION = "tell what you see, and where"
SEPARATOR = ", "

_PAGE = 100
_OF_ONE_DEMONSTRATION = 10
_POSES = 1  # a seed's stream of random numbers, beside the layout's
_STEPS = (0, 50)  # of an episode: some things are only shown for a while
_MIN_PIXELS = 8  # less of a thing is not seen
_TOOL_LOW_M, _TOOL_HIGH_M = (-0.32, -0.3, 0.02), (0.12, 0.3, 0.3)
_HELD_SHARE, _HOME_SHARE = 0.25, 0.15
_LIFTED_M = 0.06
_TRIES = 20
_NEXT_DRAW = 1_000_003  # of a scene that cannot be acted out


@dataclass(frozen=True, slots=True, kw_only=True)
class AlbumOptions:
    """Draws scenes of a task and names what is in their pictures."""

    out: Path
    """Folder of the new dataset."""
    task: str = "PickHighlight"
    pictures: int = 8000
    """Rounded up to whole pages of 100."""
    seed: int = 3_000_000
    """The first scene's; episodes of these seeds should not be evaluated."""
    demonstrated: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Instants of demonstrations in place of scenes that stand still."""
    image_px: int = IMAGE_PX
    progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True
    """Show a progress bar."""


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(AlbumOptions, args=argv, prog="pp-album", description=AlbumOptions.__doc__)
    try:
        make_album(options)
    except (DatasetError, TaskError, OSError) as error:
        sys.stderr.write(f"pp-album: {error}\n")
        return REFUSED
    sys.stdout.write(f"{_num_pages(options) * _PAGE} pictures in {options.out}\n")
    return DONE


def make_album(options: AlbumOptions) -> None:
    """Writes the dataset.

    Raises:
        DatasetError: there is a dataset already.
        TaskError: no such task, or one that does not name its things, or demonstrates nothing.
        OSError: a full disk.
    """
    if (options.out / INFO_PATH).exists():
        raise DatasetError(f"{options.out} holds a dataset already; use another --out")
    with closing(Studio(options.task, options.image_px)) as studio:
        writer = DatasetWriter(options.out)
        for page in tqdm(range(_num_pages(options)), unit="page", disable=not options.progress):
            first_seed = options.seed + page * _PAGE
            rows = EpisodeWriter(options.image_px)
            for seed in range(first_seed, first_seed + _PAGE):
                if not options.demonstrated:
                    rows.add(*studio.picture(seed))
                elif seed % _OF_ONE_DEMONSTRATION == 0:
                    for row, frames in studio.demonstrated(seed, _OF_ONE_DEMONSTRATION):
                        rows.add(row, frames)
            about = About(
                task=options.task,
                instruction=INSTRUCTION,
                seed=first_seed,
                difficulty="",
                origin="album",
                is_success=True,
                image_px=options.image_px,
            )
            writer.add(unpack(rows.pack(about)))
        writer.finish()


def require_named(name: str) -> Task[Any, Any]:
    """Makes a task. Raises TaskError if there is none of that name, or it does not name its things."""
    task = make_task(name)
    if type(task).things is Task.things:
        raise TaskError(f"task {name!r} does not name its things (Task.things); PickHighlight does")
    return task


class Studio:
    """Scenes of one task that stand still. Close it after use."""

    def __init__(self, task: str, image_px: int) -> None:
        """Raises TaskError if there is no such task, or it does not name its things."""
        self.task, self.image_px = require_named(task), image_px
        spec = table_scene(self.task.robot)
        self.task.furnish(spec)
        self.physics = Physics(spec)
        self._kinematics = Kinematics(self.physics.model)
        self._cameras = Cameras(self.physics, image_px)

    def picture(self, seed: int) -> tuple[Row, dict[str, Frame]]:
        """One scene, what there is to say of it, and both cameras' pictures; equal seeds give equal ones."""
        rng, physics = np.random.default_rng([seed, _POSES]), self.physics
        layout, _ = self.arranged(seed)
        step, memory = int(rng.choice(_STEPS)), self.task.imagined(rng, layout)
        for now in range(step + 1):  # scripts move things at their own steps only
            self.task.stage(physics, layout, memory, now)
        things = self.task.things(layout, step, memory)
        # what is highlighted lies where it lies
        self.pose_tool(rng, [thing.body for thing in things if thing.is_movable] if step == 0 else [])
        return self._row(things), self.frames()

    def demonstrated(self, seed: int, count: int) -> Iterator[tuple[Row, dict[str, Frame]]]:
        """So many instants of the demonstration of one scene, in order; equal seeds give equal ones.

        Raises TaskError if the task demonstrates nothing.
        """
        rng, task, physics = np.random.default_rng([seed, _POSES]), self.task, self.physics
        for tries_left in reversed(range(_TRIES)):
            layout, _ = self.arranged(seed + _NEXT_DRAW * (_TRIES - 1 - tries_left))
            try:
                video, _ = demonstration.perform(task, layout, task.demonstration(layout), physics, lambda part: None)
                break
            except UnreachableError:  # as an environment, which draws again
                if tries_left == 0:
                    raise
        if not video:
            raise TaskError(f"task {task.name!r} demonstrates nothing; leave --demonstrated out")
        for step in np.sort(rng.permutation(len(video))[:count]).tolist():
            physics.load(video[step].physics)
            yield self._row(task.things(layout, step, video[step].memory)), self.frames()

    def _row(self, things: Sequence[Thing]) -> Row:
        physics = self.physics
        return Row(
            state=physics.state().astype(np.float32),
            action=physics.command().astype(np.float32),
            tcp_pose=self.tcp_pose(),
            subgoal=INSTRUCTION,
            grounded_subgoal=told(physics, things),
            is_transition=True,
        )

    def arranged(self, seed: int) -> tuple[Any, Difficulty]:
        """Puts up the scene of a seed; returns its layout and how difficult it is."""
        difficulty = DIFFICULTIES[seed % len(DIFFICULTIES)]
        layout = self.task.sample(np.random.default_rng(seed), difficulty)
        self.physics.reset()
        self.task.arrange(self.physics, layout)
        self.physics.refresh()
        return layout, difficulty

    def tcp_pose(self) -> NDArray[np.float32]:
        """The tool's, (7,)."""
        return pose_of(self.physics.tcp_transform()).astype(np.float32)

    def frames(self) -> dict[str, Frame]:
        """What both cameras see now."""
        return self._cameras.frames()

    def point(self, body: str) -> Pixel | None:
        """Where the front camera sees the middle of a body, row and column; None if too little of it shows."""
        return _point(self.physics, body)

    def close(self) -> None:
        """Frees the renderer."""
        self._cameras.close()

    def pose_tool(self, rng: np.random.Generator, movable: Sequence[str]) -> None:
        """Puts the tool somewhere above the table, pointing down, sometimes with a thing between its fingers."""
        physics = self.physics
        if rng.random() < _HOME_SHARE:
            return
        opening_m = float(rng.choice([0.0, HOME_OPENING_M / 2, HOME_OPENING_M]))
        upright = self._kinematics.tcp(HOME_QPOS)
        for _ in range(_TRIES):
            yaw_rad = rng.uniform(-np.pi / 4, np.pi / 4)
            target = transform(pose(0.0, 0.0, 0.0, yaw_rad)) @ upright
            target[:3, 3] = rng.uniform(_TOOL_LOW_M, _TOOL_HIGH_M)
            try:
                joints = self._kinematics.solve(target, HOME_QPOS)
            except UnreachableError:
                continue
            is_held = rng.random() < _HELD_SHARE and target[2, 3] > _LIFTED_M and bool(movable)
            physics.pose_arm(joints, HOME_OPENING_M / 2 if is_held else opening_m)
            if is_held:
                x_m, y_m, z_m = target[:3, 3]
                physics.place(str(rng.choice(movable)), pose(x_m, y_m, z_m, yaw_rad))
                physics.refresh()
            return


def told(physics: Physics, things: Sequence[Thing]) -> str:
    """What the front camera sees of ``things``, from left to right: "red cube at <y, x>, button at <y, x>"."""
    seen = []
    for thing in things:
        point = _point(physics, thing.body)
        if point is not None:
            seen.append((point[1], point[0], thing.name))
    return SEPARATOR.join(f"{name} at <{y}, {x}>" for x, y, name in sorted(seen))


def _point(physics: Physics, body: str) -> Pixel | None:
    pixels = visible_pixels(physics, FRONT, body, IMAGE_PX)
    return mean_pixel(pixels) if len(pixels) >= _MIN_PIXELS else None


def _num_pages(options: AlbumOptions) -> int:
    return -(-options.pictures // _PAGE)


if __name__ == "__main__":
    sys.exit(main())
