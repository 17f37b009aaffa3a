"""Episodes recorded by others, as they lie there; and their rows made into ours: paired and brought to 20 Hz.

A row here is what was seen before its action, at 20 Hz. Nothing is invented on the way but states between two rows
of a slower recording, which are interpolated; pictures are repeated there, and commands held, as the robot held them.
"""

# T rows of the source, N rows of ours

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.data.episode import CAMERAS, require_finite
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_folder import LeRobotFolder
from dual_system.data.mapping import FINGER_M, GRIPPER, SourceMapping
from dual_system.data.video import FPS, Frame

Frames = Callable[[str, Sequence[int]], NDArray[np.uint8]]
"""(camera, ascending rows of the source) -> (n, height, width, 3)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceEpisode:
    """An episode of somebody else's recording, columns in our units."""

    task: str
    instruction: str
    number: int
    difficulty: str = "unknown"
    is_success: bool = True
    rows_hz: float
    state_T8: NDArray[np.float32]
    action_T8: NDArray[np.float32]
    """Absolute joint targets and the gripper's command."""
    subgoal: tuple[str, ...]
    grounded_subgoal: tuple[str, ...]
    is_demonstration_T: NDArray[np.bool_]
    frames: Frames

    @property
    def num_rows(self) -> int:
        return len(self.state_T8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Row20:
    """Rows of ours as columns, and where their parts come from."""

    state_N8: NDArray[np.float32]
    action_N8: NDArray[np.float32]
    label_N: NDArray[np.intp]
    """The source's row whose texts and flag hold."""
    picture_N: NDArray[np.intp]
    """The source's row whose pictures are shown; `NO_PICTURE`: the last ones are repeated."""


NO_PICTURE = -1


def paired(episode: SourceEpisode, source: Path) -> SourceEpisode:
    """Returns an episode of ``source``, whose rows show what their action led to, as rows of what was seen before it.

    What a row shows goes with the next row's action, and so do the texts, which are of that action; what the last
    action led to has no row. Raises DatasetError if there is one row.
    """
    if episode.num_rows < 2:
        raise DatasetError(
            f"{source}: episode {episode.number}: {episode.num_rows} row; an action needs what was seen before it"
        )
    return replace(
        episode,
        state_T8=episode.state_T8[:-1],
        action_T8=episode.action_T8[1:],
        subgoal=episode.subgoal[1:],
        grounded_subgoal=episode.grounded_subgoal[1:],
        is_demonstration_T=episode.is_demonstration_T[1:],
    )


def at_20_hz(episode: SourceEpisode) -> Row20:
    """An episode's rows at 20 Hz.

    A faster recording gives every n-th row, with the last command before the next one; a slower one n rows for each.

    Raises DatasetError unless one rate is a multiple of the other.
    """
    fewer, more = episode.rows_hz / FPS, FPS / episode.rows_hz
    if fewer == int(fewer):
        step = int(fewer)
        kept = np.arange(0, episode.num_rows - step + 1, step)
        return Row20(
            state_N8=episode.state_T8[kept],
            action_N8=episode.action_T8[kept + step - 1],
            label_N=kept,
            picture_N=kept,
        )
    if more != int(more):
        raise DatasetError(
            f"episode {episode.number}: {episode.rows_hz:g} rows a second; only rates that divide {FPS} or are a "
            "multiple of it are read. Resample the folder first, or state the true rate as rows_hz in the mapping file"
        )
    count = int(more)
    at_N = np.arange(episode.num_rows * count) / count
    source_N = at_N.astype(np.intp)
    between = [np.interp(at_N, np.arange(episode.num_rows), column) for column in episode.state_T8.T]
    return Row20(
        state_N8=np.stack(between, axis=1).astype(np.float32),
        action_N8=episode.action_T8[source_N],
        label_N=source_N,
        picture_N=np.where(at_N == source_N, source_N, NO_PICTURE),
    )


def in_force(texts: Sequence[str], done_text: str) -> tuple[str, ...]:
    """Texts with ``done_text`` replaced by the one before it."""
    found: list[str] = []
    for text in texts:
        is_none = bool(done_text) and done_text in text
        found.append((found[-1] if found else "") if is_none else text)
    return tuple(found)


class LeRobotSource:
    """The episodes of a LeRobot v3 folder under a mapping.

    Raises:
        DatasetError: the folder is broken (`LeRobotFolder`), or lacks what the mapping names.
    """

    def __init__(self, root: Path, mapping: SourceMapping) -> None:
        self._root, self._mapping = root, mapping
        self._folder = LeRobotFolder(root)
        wanted = {**{name: "camera" for name in self._cameras.values()}, **dict.fromkeys(mapping.columns(), "column")}
        missing = [f"{kind} {name!r}" for name, kind in wanted.items() if name not in self._folder.features]
        if missing:
            raise DatasetError(
                f"{root} has no {', '.join(missing)}; it has {', '.join(sorted(self._folder.features))}. Name what is "
                "what in a mapping file (--mapping)"
            )

    @property
    def _cameras(self) -> dict[str, str]:
        return {camera: getattr(self._mapping.cameras, camera) for camera in CAMERAS}

    def __len__(self) -> int:
        return len(self._folder.listed)

    def __iter__(self) -> Iterator[SourceEpisode]:
        for listed in self._folder.listed:
            yield self._episode(listed)

    def _episode(self, listed: dict[str, Any]) -> SourceEpisode:
        mapping, number = self._mapping, listed["episode_index"]
        table = self._folder.rows(number, mapping.columns())
        try:
            state_T8 = mapping.state.read(_numbers(table, mapping.state.column), FINGER_M)
            action_T8 = mapping.action.read(_numbers(table, mapping.action.column), GRIPPER)
            is_demonstration_T = np.zeros(len(state_T8), np.bool_)
            if mapping.demonstration:
                flags_T = _numbers(table, mapping.demonstration).reshape(-1)
                require_finite(f"column {mapping.demonstration}", flags_T)
                is_demonstration_T = flags_T.astype(np.bool_)
            subgoal = self._texts(table, mapping.subgoal)
            grounded = self._texts(table, mapping.grounded_subgoal or mapping.subgoal)
        except ValueError as error:
            raise DatasetError(f"{self._root}: episode {number}: {error}") from None
        if mapping.action_kind == "delta":
            action_T8[:, :-1] += state_T8[:, :-1]
        tasks = listed.get("tasks")
        if not isinstance(tasks, list) or not tasks or not isinstance(tasks[0], str):
            raise DatasetError(f"{self._root}: meta/episodes: expected tasks of episode {number}, came {tasks!r}")
        episode = SourceEpisode(
            task=mapping.task or self._root.name,
            instruction=tasks[0],
            number=number,
            rows_hz=mapping.rows_hz or self._folder.fps,
            state_T8=state_T8,
            action_T8=action_T8,
            subgoal=subgoal,
            grounded_subgoal=grounded,
            is_demonstration_T=is_demonstration_T,
            frames=lambda camera, rows: self._folder.frames(number, self._cameras[camera], rows),
        )
        return paired(episode, self._root) if mapping.order == "action first" else episode

    def _texts(self, table: Any, column: str) -> tuple[str, ...]:
        if not column:
            return ("",) * table.num_rows
        texts = table[column].to_pylist()
        if not all(text is None or isinstance(text, str) for text in texts):
            raise ValueError(f"column {column} has the type {table[column].type}, expected texts")
        return in_force([text or "" for text in texts], self._mapping.done_text)


def _numbers(table: Any, column: str) -> NDArray[Any]:
    """(T, D) of a column of lists, (T,) of one of numbers. Raises ValueError if it is of something else."""
    try:
        return np.asarray(table[column].to_pylist(), np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"column {column} has the type {table[column].type}, expected numbers") from None


def frame_at(frames: Frames, rows: Sequence[int]) -> Iterator[dict[str, Frame]]:
    """Yields the pictures of all cameras at ascending rows, a second's worth at a time."""
    for begin in range(0, len(rows), FPS):
        part = rows[begin : begin + FPS]
        shown = {camera: frames(camera, part) for camera in CAMERAS}
        for place in range(len(part)):
            yield {camera: shown[camera][place] for camera in CAMERAS}
