"""``pp-wander``: scenes in which everything is elsewhere at every look, and one thing is told of and followed.

Where a thing was named, or lit, is as a rule where it still is: from episodes alone, and from a small share of shoves
too, a PONDER from scratch learns to remember the place and never to look. Here memory is worth nothing but to say which
thing is meant, and the newest picture has to be searched for it, nearest to where it was said to be. Nobody acts; the
arm stands somewhere else at every look, as in an album (`album`). These are episodes to be watched (`pp-train
--watch`): a subgoal's text is a task's own, told when a stint begins, and its coordinates follow the thing.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from dual_system.data.album import Studio
from dual_system.data.episode import WANDERING, About, EpisodeWriter, Row, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_v3 import INFO_PATH, DatasetWriter
from dual_system.data.shove import moved_aside
from dual_system.data.video import FPS
from dual_system.tasks import captions
from dual_system.tasks.environment import IMAGE_PX
from dual_system.tasks.task import TaskError

DONE, REFUSED = 0, 2
_MOVE_SHARE = 0.8  # of the things, those that are elsewhere at the next look
_ROAM_M = 0.07  # from where a thing was first put: further on, others would be as near
_STINT_LOOKS = (3, 8)  # how long one thing is followed
_MAX_LAYOUTS = 40  # whose subgoals can be told


@dataclass(frozen=True, slots=True, kw_only=True)
class WanderOptions:
    """Draws scenes of a task whose things wander, and follows one thing after the other."""

    out: Path
    """Folder of the new dataset."""
    task: str = "PickHighlight"
    episodes: int = 400
    looks: int = 12
    """Of each episode, one a second."""
    seed: int = 4_000_000
    """The first scene's; episodes of these seeds should not be evaluated."""
    image_px: int = IMAGE_PX
    progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True
    """Show a progress bar."""


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(WanderOptions, args=argv, prog="pp-wander", description=WanderOptions.__doc__)
    try:
        make(options)
    except (DatasetError, TaskError, OSError) as error:
        sys.stderr.write(f"pp-wander: {error}\n")
        return REFUSED
    sys.stdout.write(f"{options.episodes} episodes of {options.looks} looks in {options.out}\n")
    return DONE


def make(options: WanderOptions) -> None:
    """Writes the dataset.

    Raises:
        DatasetError: there is a dataset already, or the task has no subgoal that a thing could be followed by.
        TaskError: no such task, or one that does not name its things.
        OSError: a full disk.
    """
    if (options.out / INFO_PATH).exists():
        raise DatasetError(f"{options.out} holds a dataset already; use another --out")
    with closing(Wanderers(options.task, options.image_px)) as wanderers:
        writer = DatasetWriter(options.out)
        seeds = range(options.seed, options.seed + options.episodes)
        for seed in tqdm(seeds, unit="episode", disable=not options.progress):
            rows = EpisodeWriter(options.image_px)
            about = wanderers.film(seed, options.looks, rows)
            writer.add(unpack(rows.pack(about)))
        writer.finish()


class Wanderers(Studio):
    """Scenes of one task whose things move between two looks."""

    def film(self, seed: int, num_looks: int, rows: EpisodeWriter) -> About:
        """Writes one episode, a second of rows for every look; equal seeds give equal ones."""
        rng = np.random.default_rng([seed, 1])
        layout, difficulty = self.arranged(seed)
        instruction = self.task.instruction(layout)
        told = self._told(layout)
        if not told:
            raise DatasetError(f"task {self.task.name} has no subgoal about one thing that can be moved")
        homes = {body: self.physics.position_m(body)[:2].copy() for _, body in told}
        template, body, left = "", "", 0
        point: captions.Pixel | None = None
        for look in range(num_looks):
            if look:
                self._move(rng, homes)
            self.pose_tool(rng, ())
            seen = {each: self.point(each) for each in homes}
            begins = left == 0 or point is None
            if begins:
                template, body = told[rng.integers(len(told))]
                point, left = None, int(rng.integers(*_STINT_LOOKS))
            left -= 1
            point = seen[body] or point
            text = captions.grounded(template, [point]) if point else captions.simple(template)
            row = Row(
                state=self.physics.state().astype(np.float32),
                action=self.physics.command().astype(np.float32),
                tcp_pose=self.tcp_pose(),
                subgoal=captions.simple(template),
                grounded_subgoal=text,
                is_transition=begins,
            )
            rows.add(row, self.frames())
            for _ in range(FPS - 1):
                rows.add(replace(row, is_transition=False), {})
        return About(
            task=self.task.name,
            instruction=instruction,
            seed=seed,
            difficulty=difficulty,
            origin=WANDERING,
            is_success=True,
            image_px=self.image_px,
        )

    def _told(self, layout: Any) -> list[tuple[str, str]]:
        """Templates of subgoals about one movable thing of the scene, with its body, whatever was asked for."""
        layouts = [layout, *self.task.retold(layout)][:_MAX_LAYOUTS]
        subtasks = [each for known in layouts for each in self.task.subtasks(known)]
        told = [(each.text, each.grounds[0]) for each in subtasks if len(each.grounds) == 1]
        return [(template, body) for template, body in told if self.physics.is_free(body)]

    def _move(self, rng: np.random.Generator, homes: Mapping[str, NDArray[np.floating]]) -> None:
        """Puts most things elsewhere, each near where it was and not far from its home."""
        for body, home_m in homes.items():
            place = moved_aside(self.physics, body, rng) if rng.random() < _MOVE_SHARE else None
            if place is not None and np.linalg.norm(place[:2] - home_m) < _ROAM_M:
                self.physics.place(body, place)
                self.physics.refresh()


if __name__ == "__main__":
    sys.exit(main())
