"""Reads a dataset of ours: episodes, their rows, and any of their pictures. Needs neither torch nor lerobot."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dual_system.data import lerobot_v3 as v3
from dual_system.data.episode import Rows, from_table
from dual_system.data.errors import DatasetError
from dual_system.data.video import FPS, read_frames


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One episode of a dataset, as ``meta/episodes`` lists it."""

    index: int
    task: str
    instruction: str
    seed: int
    difficulty: str
    origin: str
    is_success: bool
    recovery: str
    num_rejected: int
    noise_rad: float  # 0 without noise
    num_rows: int
    num_demonstration_rows: int
    corrected_from: int  # see `About`
    first_row: int  # its number among all rows of the dataset


class Dataset:
    """A v3 folder that `pp-collect` or `pp-export` made.

    Raises:
        DatasetError: the folder holds no such dataset.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        try:
            self.described: dict[str, Any] = json.loads((root / v3.INFO_PATH).read_text())
            listed = pq.read_table(root / v3.EPISODES_PATH)
        except FileNotFoundError as error:
            raise DatasetError(f"{root} holds no dataset (no {error.filename}); pp-collect makes one") from None
        if self.described["codebase_version"] != v3.VERSION or "num_demonstration_rows" not in listed.column_names:
            raise DatasetError(f"{root} is a dataset of {self.described['codebase_version']}, but not one of ours")
        self.image_px: int = self.described["features"][v3.video_key("front")]["shape"][0]
        wanted = [name for name in listed.column_names if not name.startswith("stats/")]
        self._listed = listed.select(wanted).to_pylist()
        self.episodes = tuple(map(_entry, self._listed))
        self._row_groups = _row_groups(self._listed)

    def rows(self, episode: int) -> Rows:
        """The rows of an episode."""
        listed = self._listed[episode]
        path = v3.DATA_PATH.format(chunk_index=listed["data/chunk_index"], file_index=listed["data/file_index"])
        table = pq.ParquetFile(self.root / path).read_row_group(self._row_groups[episode])
        return from_table(table.rename_columns([v3.OUR_NAMES.get(name, name) for name in table.column_names]))

    def frames(self, episode: int, camera: str, rows: Sequence[int]) -> NDArray[np.uint8]:
        """The pictures (n, image_px, image_px, 3) that one camera took in some rows, which ascend.

        Raises:
            IndexError: the episode has no such row.
        """
        listed, key = self._listed[episode], v3.video_key(camera)
        if rows and not 0 <= rows[0] <= rows[-1] < listed["length"]:
            raise IndexError(f"rows {rows[0]} to {rows[-1]} of an episode of {listed['length']} rows")
        path = v3.VIDEO_PATH.format(
            video_key=key,
            chunk_index=listed[f"videos/{key}/chunk_index"],
            file_index=listed[f"videos/{key}/file_index"],
        )
        begin = round(listed[f"videos/{key}/from_timestamp"] * FPS)
        return np.stack(list(read_frames(self.root / path, [begin + row for row in rows])))


def _entry(listed: dict[str, Any]) -> Entry:
    same = ("task", "seed", "difficulty", "origin", "is_success", "recovery", "num_rejected", "num_demonstration_rows")
    return Entry(
        index=listed["episode_index"],
        instruction=listed["tasks"][0],
        num_rows=listed["length"],
        first_row=listed["dataset_from_index"],
        noise_rad=listed.get("noise_rad", 0.0),
        corrected_from=listed.get("corrected_from", 0),
        **{name: listed[name] for name in same},
    )


def _row_groups(listed: Sequence[dict[str, Any]]) -> list[int]:
    """Returns each episode's row group within its file; episodes were written one by one."""
    seen: Counter[tuple[int, int]] = Counter()
    groups = []
    for each in listed:
        place = (each["data/chunk_index"], each["data/file_index"])
        groups.append(seen[place])
        seen[place] += 1
    return groups
