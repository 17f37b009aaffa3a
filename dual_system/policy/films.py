"""Stage A1 for PONDER: films of things that are covered and marked, and texts that say where they are.

    python -m dual_system.policy.films --out FOLDER --films 4000

They stand in for the films and texts of a pretrained multimodal LLM. Nothing is to be done in them, and no text is a
subgoal of a task: the instruction names some things, and the text at the end says where each of them is, though its
mark is gone or a container stands over it. A film is stored as an episode of an arm at rest, its beginning as a
demonstration as often as not, so whatever trains PONDER on episodes reads it.
"""

# A film is S seconds long and has two pictures a second of each camera.

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray

import dual_system.tasks.headless  # noqa: F401 - before mujoco is imported
from dual_system.data.collect import DONE, INTERRUPTED, MachineOptions, collect, print_line, workers_on
from dual_system.data.episode import PANDA, About, EpisodeWriter, Package, RobotColumns, Row
from dual_system.data.video import FPS
from dual_system.models.ponder.coordinates import TEXT_PX
from dual_system.models.windows import placed_in
from dual_system.policy.studio import IMAGE_PX, NAMES, WINDOWS, Studio
from dual_system.tasks import sight
from dual_system.tasks.containers import HIDING_Z_M
from dual_system.tasks.geometry import Array, pose
from dual_system.tasks.panda import HOME_OPENING_M, HOME_QPOS
from dual_system.tasks.scene import FRONT, SceneFullError
from protocol.command_line import command, parse
from protocol.version import DISTRIBUTION

FIRST_SEED = 6_000_000
NAME = "Film"
PICTURE_HZ = 2
_CUBES = {name: kind for kind, name in enumerate(NAMES) if name.endswith("cube")}
_NUMBERS = ("first", "second", "third", "fourth")
_MARK_S = 2
_AFTER_S = 2
"""Seconds that a film goes on after its text began: a query falls into them whenever it comes."""
_MOST_NAMED = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Film:
    """What was seen, what was asked and what is right."""

    views: tuple[Mapping[str, NDArray[np.uint8]], ...]
    """Two a second."""
    instruction: str
    text: str
    """Places as <y, x> in pixels of the front picture, as in the tasks' texts."""
    seconds: int
    """Until all has happened that happens."""


class FilmStudio(Studio):
    """Arranges things as for a still, and then covers and marks cubes; each film follows from its seed."""

    def film(self, seed: int) -> Film:
        rng = np.random.default_rng((seed, 79))
        for _ in range(100):
            try:
                film = self._shot(rng)
            except SceneFullError:
                continue
            if film is not None:
                return film
        raise SceneFullError(f"seed {seed}: a hundred draws did not fit on the table")

    def _shot(self, rng: np.random.Generator) -> Film | None:
        """None if nothing can be asked about."""
        physics, seconds = self.physics, int(rng.integers(4, 13))
        physics.reset()
        physics.refresh()
        parked = {name: physics.pose(name) for name in ("6_0", "6_1")}
        placed = self._arrange(rng)
        for disc in parked.keys() & {*placed}:  # a mark comes and goes
            physics.place(disc, parked[disc])
        physics.pose_arm(HOME_QPOS, HOME_OPENING_M)
        physics.refresh()
        cubes = [name for name in placed if int(name[0]) < len(_CUBES)]
        where = {name: physics.position_m(name) for name in placed}
        hidden: list[str] = []
        marked: list[str] = []
        covers = [f"{NAMES.index('container')}_{index}" for index in range(4)]
        rng.shuffle(covers)
        unmarked_at, views = -1, []
        for second in range(seconds):
            bare = [name for name in cubes if name not in hidden]
            if second == unmarked_at:
                physics.place("6_0", parked["6_0"])
            happens = rng.random() if second else 1.0
            if happens < 0.35 and len(hidden) < 3:
                free = [name for name in bare if unmarked_at <= second or name != marked[-1]]
                if free:
                    hidden.append(str(rng.choice(free)))
                    x_m, y_m, _ = where[hidden[-1]]
                    physics.place(covers.pop(), pose(x_m, y_m, HIDING_Z_M, float(rng.uniform(0, 1.5))))
            fresh = [name for name in bare if name not in marked]
            if fresh and 0.35 <= happens < 0.7 and unmarked_at <= second < seconds - _MARK_S:
                marked.append(str(rng.choice(fresh)))
                x_m, y_m, _ = where[marked[-1]]
                physics.place("6_0", pose(x_m, y_m, 0.001, 0.0))
                unmarked_at = second + _MARK_S
            physics.refresh()
            views += [self._cameras.frames()] * PICTURE_HZ
        asked = self._answers(placed, hidden, marked, where)
        if not asked:
            return None
        names = [str(name) for name in rng.permutation([*asked])[:_MOST_NAMED]]
        return Film(
            views=tuple(views),
            instruction=f"say where these are: {', '.join(names)}",
            text="; ".join(f"{name} at {asked[name]}" for name in names),
            seconds=seconds,
        )

    def _answers(
        self, placed: list[str], hidden: list[str], marked: list[str], where: Mapping[str, Array]
    ) -> dict[str, str]:
        """What can be asked about, and where it is: what has one meaning, and lies in the front window."""
        of = {name: [each for each in placed if int(each[0]) == kind] for kind, name in enumerate(NAMES)}
        known = {f"the {name}": of[name][0] for name in (*_CUBES, "button", "target", "peg") if len(of[name]) == 1}
        for what, those in (("marked", marked), ("hidden", hidden)):
            known |= {f"the {number} {what} cube": name for number, name in zip(_NUMBERS, those, strict=False)}
        K, Rt = sight.intrinsic(self.physics, FRONT, TEXT_PX), sight.extrinsic(self.physics, FRONT)
        found = {}
        for said, name in known.items():
            ((x, y),) = sight.project(K, Rt, where[name][None])
            row, column = placed_in(WINDOWS[FRONT], (y / TEXT_PX, x / TEXT_PX))
            if 0 <= row < 1 and 0 <= column < 1:
                color = f", which is {NAMES[int(name[0])].split()[0]}" if said.split()[1] in _NUMBERS else ""
                found[said] = f"<{round(y)}, {round(x)}>{color}"
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmJob:
    """One film to shoot."""

    slot: int

    @property
    def key(self) -> str:
        return f"{NAME}/{self.slot:06d}"


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmsOptions:
    """Shoots films into a LeRobot v3 dataset. The same command again resumes a killed run."""

    out: Path
    """Folder of the dataset."""
    films: int = 4_000
    """Number of films."""
    machine: tyro.conf.OmitArgPrefixes[MachineOptions] = field(default_factory=MachineOptions)

    @property
    def image_px(self) -> int:
        return IMAGE_PX

    @property
    def robot(self) -> RobotColumns:
        return PANDA

    def task_names(self) -> tuple[str, ...]:
        return (NAME,)

    def jobs(self) -> list[FilmJob]:
        return [FilmJob(slot=slot) for slot in range(self.films)]

    def settings(self) -> dict[str, Any]:
        versions = {name: metadata.version(name) for name in (DISTRIBUTION, "mujoco", "numpy", "av", "pyarrow")}
        return {"first_seed": FIRST_SEED, "image_px": IMAGE_PX, "picture_hz": PICTURE_HZ, "versions": versions}


@command("films")
def main(argv: list[str] | None = None) -> int:
    options = parse(FilmsOptions, argv, prog="python -m dual_system.policy.films")
    try:
        report = collect(options, workers_on(options.machine, work_out), say=print_line)
    except KeyboardInterrupt:
        sys.stderr.write("films: interrupted; finished films are kept, the same command goes on\n")
        return INTERRUPTED
    print_line(f"{report.num_episodes} films in {options.out}")
    return DONE


def work_out(job: FilmJob) -> Package:
    """The package of a film."""
    seed = FIRST_SEED + job.slot
    return packed(_studio().film(seed), seed)


@cache
def _studio() -> FilmStudio:
    """A process's own: to build one takes longer than a film."""
    return FilmStudio()


def packed(film: Film, seed: int) -> Package:
    """The film as an episode: up to a random second as a demonstration, and all of it as often as not."""
    rng = np.random.default_rng((seed, 80))
    shown_s = film.seconds if rng.random() < 0.5 else int(rng.integers(film.seconds))
    writer, still = EpisodeWriter(IMAGE_PX), np.append(HOME_QPOS, HOME_OPENING_M).astype(np.float32)
    rest = np.append(HOME_QPOS, 1.0).astype(np.float32)
    begins = {FPS * shown_s, FPS * film.seconds}
    every = FPS // PICTURE_HZ
    for index in range(FPS * (film.seconds + _AFTER_S)):
        text = film.text if index >= FPS * film.seconds else "watch"
        row = Row(
            state=still,
            action=rest,
            subgoal=text,
            grounded_subgoal=text,
            is_demonstration=index < FPS * shown_s,
            is_transition=index in begins,
        )
        is_seen = index % every == 0 or index == FPS * shown_s - 1
        writer.add(row, dict(film.views[min(index // every, len(film.views) - 1)]) if is_seen else {})
    about = About(
        task=NAME, instruction=film.instruction, seed=seed, difficulty="", origin="studio", is_success=True,
        image_px=IMAGE_PX,
    )  # fmt: skip
    return writer.pack(about)


if __name__ == "__main__":
    sys.exit(main())
