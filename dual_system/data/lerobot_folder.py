"""Reads a LeRobotDataset v3 folder as LeRobot's own tools write and edit it.

Many episodes share a file. ``meta/episodes`` lists which numbers the rows of an episode have and when its frames begin;
how rows are grouped in a file, and whether episodes are numbered without gaps, means nothing. Tables that contradict
each other are refused with both numbers: the alternative is an episode with another one's rows or pictures.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_files import DATA_PATH, INFO_PATH, MAX_HZ, MIN_HZ, VERSION, VIDEO_PATH
from dual_system.data.video import read_frames, read_header
from dual_system.hub import local_folder
from protocol.files import read_object, require_file

EPISODES_GLOB = "meta/episodes/chunk-*/file-*.parquet"
MAX_FILE_ROWS, MAX_FILE_BYTES = 20_000_000, 4 * 2**30
"""Largest parquet file that is read, by what its footer declares; LeRobot writes 100 MB."""
MAX_TEXT_BYTES = 500_000_000
"""Most text that is read at once: one episode's, or a file of meta/episodes."""
_NUMBERING = ("index", "episode_index", "frame_index", "timestamp")
_OLDER = "LeRobot converts older ones: python -m lerobot.datasets.v30.convert_dataset_v21_to_v30"
_OTHER = "No way from this version is known here; lerobot 0.4.4 and 0.6.1 write the one that is read"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where an episode lies."""

    length: int  # rows
    first_row: int  # LeRobot's ``index`` of its first row
    data: Path
    videos: dict[str, tuple[Path, int]]  # by feature: the file, and the number of the episode's first frame there


class LeRobotFolder:
    """The episodes of a v3 folder: their rows as tables, their frames as arrays.

    Attributes:
        info: contents of ``meta/info.json``.
        fps: rows per second.
        features: LeRobot's description of every column and camera.
        listed: rows of ``meta/episodes`` without statistics.

    Raises:
        DatasetError: the folder holds no v3 dataset, a file is missing or broken, or its tables disagree.
    """

    def __init__(self, root: Path) -> None:
        self.root = root = local_folder(root, "dataset")
        if not (root / INFO_PATH).exists():
            raise DatasetError(f"{root} holds no dataset (no {INFO_PATH}); pp-collect makes one")
        with reading(root / INFO_PATH):
            self.info = read_object(root / INFO_PATH)
        if (version := self._field("codebase_version", str)) != VERSION:
            way_out = _OLDER if version.startswith(("v1.", "v2.")) else _OTHER
            raise DatasetError(f"{root} is a LeRobot dataset of version {version}, and {VERSION} is read. {way_out}")
        self.fps: float = self._field("fps", int, float)
        if not MIN_HZ <= self.fps <= MAX_HZ:
            raise DatasetError(f"{root / INFO_PATH}: fps is {self.fps}, expected a rate of {MIN_HZ} to {MAX_HZ} Hz")
        self.features: dict[str, dict[str, Any]] = self._field("features", dict)
        if strange := [name for name, feature in self.features.items() if not isinstance(feature, dict)]:
            raise DatasetError(f"{root / INFO_PATH}: features {strange} are described by no object")
        for name, expected in (("data_path", DATA_PATH), ("video_path", VIDEO_PATH)):
            if (found := self._field(name, str, type(None))) not in (expected, None):
                raise DatasetError(
                    f"{root / INFO_PATH}: {name} is {found!r}, expected {expected!r} as LeRobot writes it"
                )
        self.cameras, self._stills = (
            tuple(name for name, feature in self.features.items() if feature.get("dtype") == kind)
            for kind in ("video", "image")
        )
        self.listed = list(self._listed())
        if not self.listed:
            raise DatasetError(f"{root}: meta/episodes lists no episode")
        self._places = {self._number(each, "episode_index"): self._place(each) for each in self.listed}
        self._check_places()

    def rows(self, episode: int, columns: Sequence[str]) -> pa.Table:
        """Returns columns of an episode's rows, in order; ``episode`` is its ``episode_index``.

        Raises:
            DatasetError: the file is broken, or its rows are not those that ``meta/episodes`` lists.
        """
        place = self._places[episode]
        with reading(place.data):
            file = _opened(place.data)
            if missing := sorted({*columns, *_NUMBERING} - set(file.schema_arrow.names)):
                raise ValueError(f"{place.data} has no column {', '.join(missing)}")
            changed_ns = place.data.stat().st_mtime_ns
            groups = _groups(_footer(place.data, changed_ns), place)
            table = _read(place.data, changed_ns, groups, (*_NUMBERING, *columns))
            numbers = table["index"]
            begin, end = place.first_row, place.first_row + place.length
            table = table.filter(pc.and_(pc.greater_equal(numbers, begin), pc.less(numbers, end)))
            self._check_rows(episode, place, table)
            return _spelled_out(table.select(list(columns)))

    def frames(self, episode: int, camera: str, rows: Sequence[int]) -> NDArray[np.uint8]:
        """Returns the frames (n, height, width, 3) of one camera at ascending rows of an episode.

        Args:
            episode: its ``episode_index``.
            camera: name of a feature of videos or of pictures, which lie among the rows.
            rows: numbers within the episode.

        Raises:
            IndexError: the episode has no such row.
            DatasetError: the video is broken, or has fewer frames than the episode has rows.
        """
        place = self._places[episode]
        if rows and not 0 <= rows[0] <= rows[-1] < place.length:
            raise IndexError(f"rows {rows[0]} to {rows[-1]} of an episode of {place.length} rows")
        if camera in self._stills:
            stored = self.rows(episode, [camera])[camera].take(list(rows))
            with reading(place.data):
                return np.stack([_decoded(each) for each in stored.to_pylist()])
        path, begin = place.videos[camera]
        with reading(path):
            return np.stack(list(read_frames(path, [begin + row for row in rows], fps=self.fps)))

    def _field(self, name: str, *kinds: type) -> Any:
        value = self.info.get(name)
        if name not in self.info or not isinstance(value, kinds):
            wanted = " or ".join(kind.__name__ for kind in kinds)
            came = repr(value)[:80] if name in self.info else "nothing"
            raise DatasetError(f"{self.root / INFO_PATH}: expected {name!r} of type {wanted}, came {came}")
        return value

    def _listed(self) -> Iterator[dict[str, Any]]:
        paths = sorted(self.root.glob(EPISODES_GLOB))
        if not paths:
            raise DatasetError(f"{self.root} lists no episodes (no {EPISODES_GLOB})")
        for path in paths:
            with reading(path):
                file = _opened(path)
                names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
                rows = _spelled_out(file.read(columns=names)).to_pylist()
            yield from rows

    def _place(self, listed: dict[str, Any]) -> Place:
        episode = self._number(listed, "episode_index")
        length, begin, end = (
            self._number(listed, name) for name in ("length", "dataset_from_index", "dataset_to_index")
        )
        if not 0 < length == end - begin:
            raise DatasetError(
                f"{self.root}: meta/episodes gives episode {episode} {length} rows, and the numbers {begin} to "
                f"{end} (dataset_from_index, dataset_to_index), which are {end - begin}"
            )
        numbers = {name: self._number(listed, f"data/{name}") for name in ("chunk_index", "file_index")}
        return Place(
            length=length,
            first_row=begin,
            data=self.root / DATA_PATH.format(**numbers),
            videos={camera: self._video(listed, camera, episode, length) for camera in self.cameras},
        )

    def _video(self, listed: dict[str, Any], camera: str, episode: int, length: int) -> tuple[Path, int]:
        if "/" in camera:
            raise DatasetError(f"{self.root / INFO_PATH}: feature {camera!r} names a path; LeRobot allows no '/'")
        at = f"videos/{camera}/"
        numbers = {name: self._number(listed, at + name) for name in ("chunk_index", "file_index")}
        begin, end = (self._number(listed, f"{at}{name}_timestamp", int, float) * self.fps for name in ("from", "to"))
        if abs(end - begin - length) > 1:
            raise DatasetError(
                f"{self.root}: meta/episodes gives episode {episode} {length} rows, and {end - begin:.1f} frames of "
                f"{camera} at {self.fps} fps"
            )
        return self.root / VIDEO_PATH.format(video_key=camera, **numbers), round(begin)

    def _number(self, listed: dict[str, Any], name: str, *kinds: type) -> Any:
        value: Any = listed.get(name)
        if type(value) not in (kinds or (int,)) or not 0 <= value < 2**62:  # NaN is not
            raise DatasetError(f"{self.root}: meta/episodes: expected a number for {name}, came {value!r}")
        return value

    def _check_places(self) -> None:
        """Raises DatasetError if an episode is listed twice, episodes share frames, or a file is broken."""
        if len(self._places) < len(self.listed):
            raise DatasetError(f"{self.root}: meta/episodes lists {len(self.listed)} episodes with "
                               f"{len(self._places)} different numbers")  # fmt: skip
        for path in {place.data for place in self._places.values()}:
            with reading(path):
                _opened(path)
        for camera in self.cameras:
            spans = sorted((*place.videos[camera], place.length, episode) for episode, place in self._places.items())
            for (path, begin, length, episode), (other_path, other_begin, _, other) in pairwise(spans):
                if path == other_path and begin + length > other_begin:
                    raise DatasetError(
                        f"{path}: episode {episode} has the frames {begin} to {begin + length - 1}, and episode "
                        f"{other} begins at {other_begin}; meta/episodes gives one frame to both"
                    )
            ends = {path: (begin + length, episode) for path, begin, length, episode in spans}
            for path, (end, episode) in ends.items():
                with reading(path):
                    self._check_video(path, camera, end, episode)

    def _check_video(self, path: Path, camera: str, num_frames: int, episode: int) -> None:
        """Raises ValueError unless a video has the rate, the size and at least the frames that the tables say."""
        require_file(path)
        header, shape = read_header(path), self.features[camera].get("shape")
        if abs(header.fps - self.fps) > 0.01 * self.fps:
            raise ValueError(f"{path} has {header.fps:.2f} frames a second, {INFO_PATH} says {self.fps}")
        if header.num_frames and header.num_frames < num_frames:
            raise ValueError(
                f"{path} has {header.num_frames} frames; episode {episode} ends at its frame {num_frames - 1}"
            )
        if shape is None or not {header.height_px, header.width_px} <= {*shape}:
            raise ValueError(
                f"{path} has frames of {header.height_px} x {header.width_px} px, {INFO_PATH} says {shape}"
            )

    def _check_rows(self, episode: int, place: Place, table: pa.Table) -> None:
        """Raises ValueError if the rows with an episode's numbers are too few or too many, or another episode's."""
        numbers, episodes, frames, times_s = (table[name].cast(pa.float64()).to_numpy() for name in _NUMBERING)
        expected = np.arange(place.length)
        told = f"{place.data}: episode {episode} has the rows {place.first_row} to {place.first_row + place.length - 1}"
        if len(numbers) != place.length:
            raise ValueError(f"{told}, which are {place.length}; there are {len(numbers)} with such an index")
        if not np.array_equal(numbers, place.first_row + expected):
            raise ValueError(f"{told}; their index does not ascend by one")
        if others := sorted({*episodes.tolist()} - {episode}):
            raise ValueError(f"{told}; these are of episode {', '.join(f'{other:.0f}' for other in others[:5])}")
        if not np.array_equal(frames, expected):
            raise ValueError(f"{told}; their frame_index is not 0 to {place.length - 1}")
        late_s = np.abs(times_s - expected / self.fps)
        if late_s.max() > 0.25 / self.fps:
            row = int(late_s.argmax())
            raise ValueError(f"{told}; number {row} is at {times_s[row]:.3f} s, not {row / self.fps:.3f} s")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turns whatever a library says of a broken file into a `DatasetError` that names the file."""
    try:
        yield
    except (pa.ArrowException, OSError, ValueError, TypeError, IndexError, MemoryError) as error:
        told = (getattr(error, "strerror", None) or str(error)).partition("\n")[0]
        raise DatasetError(told if str(path) in told else f"{path} cannot be read: {told}") from None


def _decoded(stored: Any) -> NDArray[np.uint8]:
    """A picture of a row: LeRobot stores its file's bytes. Raises ValueError if it is none."""
    if not isinstance(stored, dict) or not isinstance(stored.get("bytes"), bytes):
        raise ValueError(f"expected a picture as bytes, came {str(stored)[:80]}")
    return np.asarray(Image.open(io.BytesIO(stored["bytes"])).convert("RGB"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Footer:
    """What a file's end says of all its row groups, of which it may have one for every episode: G."""

    about: pq.FileMetaData
    texts: list[str]
    index_G2: NDArray[np.int64]
    """The first and the last number of a row in each group; where it is unknown, any number."""


def _opened(path: Path) -> pq.ParquetFile:
    require_file(path)
    footer = _footer(path, path.stat().st_mtime_ns)
    return pq.ParquetFile(path.absolute(), metadata=footer.about, read_dictionary=footer.texts)


@lru_cache(maxsize=64)
def _footer(path: Path, changed_ns: int) -> _Footer:
    """Raises ValueError if the file declares more than is read."""
    about = pq.read_metadata(path.absolute())  # pyarrow takes "run:1" at the beginning of a path for a URI's scheme
    num_bytes = sum(about.row_group(number).total_byte_size for number in range(about.num_row_groups))
    if about.num_rows > MAX_FILE_ROWS or num_bytes > MAX_FILE_BYTES:
        raise ValueError(
            f"{path} declares {about.num_rows} rows of {num_bytes} bytes; at most {MAX_FILE_ROWS} and {MAX_FILE_BYTES} "
            "are read"
        )
    columns = [about.schema.column(number) for number in range(about.num_columns)]
    index_G2 = np.tile([np.iinfo(np.int64).min, np.iinfo(np.int64).max], (about.num_row_groups, 1))
    for leaf in (number for number, column in enumerate(columns) if column.path == "index"):
        for group, limits_2 in enumerate(index_G2):
            found = about.row_group(group).column(leaf).statistics
            if found is not None and found.has_min_max:
                limits_2[:] = found.min, found.max
    return _Footer(about=about, texts=[column.path for column in columns if _is_text(column)], index_G2=index_G2)


def _is_text(column: Any) -> bool:
    return bool(column.physical_type == "BYTE_ARRAY")


def _spelled_out(table: pa.Table) -> pa.Table:
    """The table with texts in place of dictionaries, as which `_opened` reads them.

    Raises ValueError if there are too many: a file of a megabyte may repeat one text until memory is full.
    """
    num_bytes, kinds = 0, []
    for field, column in zip(table.schema, table.columns, strict=True):
        is_list = pa.types.is_list(field.type)
        for chunk in column.chunks:
            values = chunk.flatten() if is_list else chunk
            if isinstance(values, pa.DictionaryArray):
                num_bytes += pc.sum(pc.binary_length(values.dictionary).take(values.indices)).as_py() or 0
        kind = field.type.value_type if is_list else field.type
        kind = kind.value_type if pa.types.is_dictionary(kind) else kind
        kinds.append(field.with_type(pa.list_(kind) if is_list else kind))
    if num_bytes > MAX_TEXT_BYTES:
        raise ValueError(f"its texts have {num_bytes} bytes, at most {MAX_TEXT_BYTES} are read")
    return table.cast(pa.schema(kinds))


def _groups(footer: _Footer, place: Place) -> tuple[int, ...]:
    """The row groups that may hold rows of an episode."""
    first_G, last_G = footer.index_G2.T
    meets_G = (last_G >= place.first_row) & (first_G < place.first_row + place.length)
    return tuple(np.flatnonzero(meets_G).tolist())


@lru_cache(maxsize=1)  # one group may hold many episodes, which are often read one after the other
def _read(path: Path, changed_ns: int, groups: tuple[int, ...], columns: tuple[str, ...]) -> pa.Table:
    return _opened(path).read_row_groups(list(groups), columns=list(columns))
