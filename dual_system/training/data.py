"""A collected dataset as training reads it: whole episodes, decoded once and kept while there is room."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dual_system.data.dataset import Dataset, Entry
from dual_system.data.episode import CAMERAS, WANDERING, Rows
from dual_system.data.video import FPS
from dual_system.models.action_space import ActionSpace, actions_in, num_dims, states_in
from dual_system.models.eyes import see
from dual_system.models.images import resized
from dual_system.models.normalisation import Quantiles, RobotStatistics
from dual_system.models.pi05.prompt import with_subgoal
from dual_system.models.ponder.context import ContextFormat
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.models.ponder.showing import Showing
from dual_system.tasks.front_view import front_pixels
from dual_system.training.chunks import chunk_ticks
from dual_system.training.notes import demo_notes, ends_of_moves, laid_out_places, moving_places
from dual_system.training.own_words import as_recorded
from dual_system.training.places import TEXT_PX
from dual_system.training.sight_store import SightStore, Views
from dual_system.training.training_episode import Frame, TrainingEpisode
from dual_system.training.ways import shows_a_way

_QUANTILES = (0.01, 0.99)
_SYSTEMS = ("pounce", "ponder")
_MIN_REACH = 1e-3
_MIN_SPAN = 1e-3
"""A dimension that hardly moves is not blown up to fill [-1, 1]."""
_OVER_A_WAY_M = 0.06
"""How high a stick's tip is led over the places that a way leads to, about. It is seen some ten pixels behind them:
without this the end of a stretch was looked for up to a second late, and the next one's side where none was seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """What a stage reads of the pictures. Kept at these sizes, a set of hundreds of episodes stays in memory."""

    form: ContextFormat | None
    """PONDER's, for its eyes; None: it is not run."""
    pounce_px: int | None
    """Side of POUNCE's pictures, to which they are resized as serving does; None: it gets none."""

    def needs(self, camera: int) -> bool:
        """Whether pictures of the camera of this number are read at all."""
        if self.pounce_px is not None or self.form is None or self.form.eyes is None:
            return True
        return camera <= max(eye.camera for eye in self.form.eyes)  # eyes count from the first camera

    @property
    def kind(self) -> str:
        """All that makes two sights of one episode differ."""
        eyes = None if self.form is None else (self.form.eyes, self.form.image_px)
        return f"{eyes} {self.pounce_px}"

    def of_ponder(self, views: tuple[Frame, ...]) -> tuple[Frame, ...]:
        return () if self.form is None else tuple(see(views, self.form.eyes, self.form.image_px))

    def of_pounce(self, views: tuple[Frame, ...]) -> tuple[Frame, ...]:
        return () if self.pounce_px is None else tuple(resized(view, self.pounce_px) for view in views)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Source:
    """Where an episode lies."""

    dataset: Dataset
    entry: Entry
    is_watched: bool

    def rows(self) -> Rows:
        return self.dataset.rows(self.entry.index)

    def frames(self, cameras: Sequence[str], rows: Sequence[int]) -> Iterator[tuple[Frame, ...]]:
        """Every camera's picture at each of these rows."""
        return zip(*(self.dataset.frames(self.entry.index, camera, rows) for camera in cameras), strict=True)

    @property
    def key(self) -> bytes:
        """Of what can be seen: the scene, what was done in it, and when it was looked at."""
        rows = self.rows()
        scene = f"{self.entry.task} {self.entry.seed} {self.entry.difficulty} {self.dataset.image_px}"
        return b" ".join((scene.encode(), rows.state.tobytes(), rows.action.tobytes(), rows.is_rendered.tobytes()))


class TrainingSet:
    """Episodes by number. ``pp-collect`` and ``pp-export`` make the folders.

    Where a dataset holds only some pictures (``--frames training``), a tick without its own has the one before it,
    as in the video, and what PONDER is to say there is of the tick that it shows (`TrainingEpisode.as_seen`).
    """

    def __init__(
        self,
        *roots: Path,
        watched: Sequence[Path] = (),
        tasks: Sequence[str] = (),
        sight: Sight | None = None,
        cache_mb: int = 4000,
        sights: Path | None = None,
        demo_hz: int = 1,
    ) -> None:
        """Reads the episodes of ``tasks``, or all; their pictures whole, or as ``sight`` says.

        Args:
            roots: folders of episodes to imitate; those that did not succeed are left out.
            watched: folders of episodes that come after them, to be looked at only (`TrainingEpisode.is_watched`).
            tasks: those to read; () for all.
            sight: see its class.
            cache_mb: of pictures that are kept.
            sights: a folder for what ``sight`` makes of pictures, to be read instead of videos from then on.
            demo_hz: how often demonstrations are looked at, a divisor of 20; reading one whose pictures were rendered
                more seldom raises ValueError.

        Raises:
            DatasetError: a folder holds no dataset of ours.
            ValueError: no episode of these tasks is in a folder, or the folders' pictures differ in size.
        """
        self._sight, self._demo_hz = sight, demo_hz
        self._store = None if sights is None or sight is None else SightStore(sights, sight.kind)
        self._sources = [source for root in roots for source in _sources(Dataset(root), tasks, is_watched=False)]
        self.num_imitated = len(self._sources)
        for folder in watched:
            self._sources += _sources(Dataset(folder), tasks, is_watched=True)
        sizes = {source.dataset.image_px for source in self._sources}
        if len(sizes) > 1:
            folders = ", ".join(map(str, (*roots, *watched)))
            raise ValueError(f"pictures of {sorted(sizes)} px in {folders}; collect all at one --image-px")
        (self.image_px,) = sizes
        self._cache: OrderedDict[int, TrainingEpisode] = OrderedDict()
        self._cache_bytes = cache_mb * 1_000_000
        self._cached_bytes = 0

    def __len__(self) -> int:
        return len(self._sources)

    @property
    def hash(self) -> str:
        """16 hex digits over which episodes these are and what was done in them."""
        digest = hashlib.blake2b(digest_size=8)
        for source in self._sources:
            entry = source.entry
            digest.update(f"{entry.task} {entry.seed} {entry.instruction}".encode())
            digest.update(source.rows().action.tobytes())
        return digest.hexdigest()

    @property
    def names(self) -> list[tuple[str, int]]:
        """Task and seed of every episode, in order."""
        return [(source.entry.task, source.entry.seed) for source in self._sources]

    def num_rows(self, number: int) -> int:
        """How long an episode is, without reading it; a demonstration counts."""
        return self._sources[number].entry.num_rows

    def showing(self, demo_hz: int) -> Showing | None:
        """How demonstrations are shown when they are looked at so often; None if there are none.

        To their end if most of those have their last frame rendered that end between two looks.
        """
        begins = [source.entry.num_demonstration_rows for source in self._sources]
        shown = [(source, begin - 1) for source, begin in zip(self._sources, begins, strict=True) if begin]
        ends = [bool(source.rows().is_rendered[last]) for source, last in shown if last % (FPS // demo_hz)]
        return Showing(hz=demo_hz, to_its_end=2 * sum(ends) > len(ends)) if shown else None

    def instructions(self) -> list[str]:
        """Every instruction once, in order."""
        return sorted({source.entry.instruction for source in self._sources})

    def told(self) -> list[str]:
        """Every instruction, alone and with each subgoal of its episodes, in order: see `prompt.with_subgoal`."""
        found = {
            with_subgoal(source.entry.instruction, normalised_text(text))
            for source in self._sources
            for text in {"", *source.rows().grounded_subgoal}
        }
        return sorted(found)

    def texts(self) -> list[str]:
        """All that PONDER reads or says in these episodes, each text once, in order."""
        found = set()
        for source in self._sources:
            rows = source.rows()
            said = {*rows.grounded_subgoal, *rows.demonstration_reasoning} - {""}
            found |= {source.entry.instruction, *(normalised_text(text) for text in said)}
        return sorted(found)

    def tools(self, number: int) -> list[str]:
        """Where the front camera sees the tool in every row of an episode, ``<y, x>``."""
        return _seen_at(self._sources[number].rows().tcp_pose)

    def __getitem__(self, number: int) -> TrainingEpisode:
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        episode = self._read(number)
        self._cache[number] = episode
        self._cached_bytes += _num_bytes(episode)
        while self._cached_bytes > self._cache_bytes and len(self._cache) > 1:
            _, dropped = self._cache.popitem(last=False)
            self._cached_bytes -= _num_bytes(dropped)
        return episode

    def _read(self, number: int) -> TrainingEpisode:
        source = self._sources[number]
        entry, rows = source.entry, source.rows()
        start = entry.num_demonstration_rows
        demo = _looked_at(start, rows, self._demo_hz)
        if blank := [row for row in demo if not rows.is_rendered[row]]:
            raise ValueError(
                f"{source.dataset.root}: the demonstration of {entry.task} {entry.seed} is to be looked at "
                f"{self._demo_hz} times a second, and {len(blank)} of these {len(demo)} pictures were not rendered; "
                f"collect with --demonstration-hz {self._demo_hz}"
            )
        num_shown, shown = len(demo), [*demo, *range(start, entry.num_rows)]
        own = np.maximum.accumulate(np.where(rows.is_rendered, np.arange(len(rows.is_rendered)), 0))
        views, sights = self._pictures(source, own, shown)
        moving = moving_places(entry.task, entry.seed, entry.difficulty, entry.num_rows)
        demo_texts = [rows.grounded_subgoal[row] for row in demo]
        over_m = _OVER_A_WAY_M if shows_a_way(demo_texts) else 0.0
        tools = _seen_at(rows.tcp_pose[demo], below_m=over_m)
        moves = [[texts[row] for row in demo] for texts in ends_of_moves(rows.grounded_subgoal[:start])]
        episode = TrainingEpisode(
            instruction=entry.instruction,
            demo=tuple((views if sights is None else sights)[:num_shown]),
            demo_subgoals=demo_texts,
            demo_tools=tools,
            demo_notes=demo_notes(
                demo_texts,
                tools,
                [moving[row] for row in demo],
                (moves[0], moves[1]),
                laid_out_places(entry.task, entry.seed, entry.difficulty) if start else "",
            ),
            frames=views[num_shown:],
            sights=None if sights is None else sights[num_shown:],
            state_T8=rows.state[start:],
            action_T8=rows.action[start:],
            subgoals=rows.grounded_subgoal[start:],
            is_transition_T=rows.is_transition[start:],
            reasoning=rows.demonstration_reasoning[start],
            imitated_from=entry.corrected_from,
            is_watched=source.is_watched,
            is_told=entry.origin == WANDERING,
            unreached=entry.unreached,
            moving=() if start else moving,  # what a demonstration showed is at rest by then
            said=[as_recorded(text) for text in (rows.said or ())[start:]],
        )
        sees = self._sight is None or self._sight.form is not None
        return episode.as_seen((own[start:] - start).clip(min=0)) if sees else episode

    def _pictures(
        self, source: _Source, own: NDArray[np.intp], shown: Sequence[int]
    ) -> tuple[list[tuple[Frame, ...]], list[tuple[Frame, ...]] | None]:
        """POUNCE's views of the rows, and PONDER's where they are other ones. ``own``: the row each picture is of."""
        sight = self._sight
        if sight is not None and sight.form is None and sight.pounce_px is None:
            return [()] * len(shown), [()] * len(shown)
        taken = [int(own[row]) for row in shown]  # rows between two looks repeat the one before
        once = sorted(set(taken))
        if sight is None:
            whole = dict(zip(once, source.frames(CAMERAS, once), strict=True))
            return [whole[row] for row in taken], None
        views, sights = (dict(zip(once, each, strict=True)) for each in self._seen(source, sight, once))
        return [views[row] for row in taken], [sights[row] for row in taken]

    def _seen(self, source: _Source, sight: Sight, rows: Sequence[int]) -> tuple[Views, ...]:
        """What POUNCE and what PONDER see in these rows; from the store, if there is one and it has them."""
        key = source.key + (f" {self._demo_hz}".encode() if self._demo_hz != 1 else b"")
        if self._store is not None and (kept := self._store.read(key, len(rows), _SYSTEMS)) is not None:
            return kept
        whole = list(source.frames([c for n, c in enumerate(CAMERAS) if sight.needs(n)], rows))
        views, sights = [sight.of_pounce(each) for each in whole], [sight.of_ponder(each) for each in whole]
        if self._store is not None:
            self._store.write(key, dict(zip(_SYSTEMS, (views, sights), strict=True)))
        return views, sights

    def statistics(self, horizon: int, space: ActionSpace = "joint_delta", *, by_row: bool = False) -> RobotStatistics:
        """Quantiles of the states as the network reads them, and of the actions as it learns them in an `action_space`.

        All rows of a chunk are pooled, as the released RoboMME statistics are; ``by_row`` first brings every row to
        the same spread (`RobotStatistics.reach`). Of the episodes to imitate alone.
        """
        states, actions = [], []
        for source in self._sources[: self.num_imitated]:
            rows = source.rows()
            state, action = _own(rows, rows.state), _own(rows, rows.action)
            begin = source.entry.corrected_from
            ticks = chunk_ticks(np.arange(begin, len(action)), horizon, len(action))
            state = state[begin:]
            chunks_TND = actions_in(space, action, state, ticks)
            states.append(states_in(space, state).astype(np.float32))
            actions.append(chunks_TND.astype(np.float32))
        actions_MND = np.concatenate(actions)
        reach_N = _reach(actions_MND[..., :-1]) if by_row else np.ones(horizon)
        actions_MND[..., :-1] /= reach_N[:, None]
        return RobotStatistics(
            state=_quantiles(np.concatenate(states)),
            action=_quantiles(actions_MND.reshape(-1, num_dims(space))),
            space=space,
            reach=tuple(reach_N.tolist()) if by_row else (),
        )


def _sources(dataset: Dataset, tasks: Sequence[str], *, is_watched: bool) -> list[_Source]:
    entries = [e for e in dataset.episodes if (is_watched or e.is_success) and (not tasks or e.task in tasks)]
    if not entries:
        there = ", ".join(sorted({e.task for e in dataset.episodes}))
        kind = "" if is_watched else "successful "
        raise ValueError(f"{dataset.root} has no {kind}episode of {', '.join(tasks) or 'any task'}; it has {there}")
    return [_Source(dataset=dataset, entry=entry, is_watched=is_watched) for entry in entries]


def _looked_at(num_rows: int, rows: Rows, demo_hz: int) -> list[int]:
    """The rows of a demonstration of so many that PONDER is shown: so many a second, and the last if rendered."""
    return Showing(hz=demo_hz, to_its_end=num_rows > 0 and bool(rows.is_rendered[num_rows - 1])).looks(num_rows, FPS)


def _seen_at(poses_T7: NDArray[np.float32], below_m: float = 0.0) -> list[str]:
    """Where the front camera sees what is so far below the tool, as a text tells a place; at the picture's edge where
    it would leave it."""
    points_T3 = poses_T7[:, :3] - np.array([0.0, 0.0, below_m])
    pixels_T2 = front_pixels(points_T3, TEXT_PX).round().clip(0, TEXT_PX).astype(int)
    return [f"<{y}, {x}>" for y, x in pixels_T2.tolist()]


def _reach(moves_MND: NDArray[np.float32]) -> NDArray[np.float64]:
    """Each row's rms move over that of all rows, dims weighed alike; never 0."""
    squares_ND = np.square(moves_MND, dtype=np.float64).mean(axis=0)
    share_N: NDArray[np.float64] = np.sqrt((squares_ND / squares_ND.mean(axis=0).clip(_MIN_SPAN**2)).mean(axis=1))
    return share_N.clip(_MIN_REACH)


def _own(rows: Rows, column: NDArray[np.float32]) -> NDArray[np.float32]:
    """What the robot itself did, without the demonstration."""
    return column[~rows.is_demonstration]


def _quantiles(values: NDArray[np.float32]) -> Quantiles:
    low, high = np.quantile(values.astype(np.float64), _QUANTILES, axis=0)
    middle, half = (low + high) / 2, np.maximum(high - low, _MIN_SPAN) / 2
    return Quantiles(q01=tuple((middle - half).tolist()), q99=tuple((middle + half).tolist()))


def _num_bytes(episode: TrainingEpisode) -> int:
    """Of its pictures, each counted once however many rows share it."""
    instants = {id(views): views for views in (*episode.demo, *episode.frames, *(episode.sights or ()))}
    return sum(view.nbytes for views in instants.values() for view in views)
