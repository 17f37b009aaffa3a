"""A collected dataset for training: whole episodes, decoded once and cached up to a memory limit."""

from __future__ import annotations

import copy
import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dual_system.data.dataset import Dataset, Entry
from dual_system.data.episode import IMPORTED, Rows
from dual_system.data.video import FPS
from dual_system.models.action_space import ROBOT_DIM, ActionSpace, actions_in, num_dims, states_in
from dual_system.models.frame_sampling import FrameSampling
from dual_system.models.images import resized
from dual_system.models.normalisation import Quantiles, RobotStatistics
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.pi05.prompt import with_subgoal
from dual_system.models.ponder.context import ContextFormat
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.models.pounce.family import AnyPounceConfig, sampling_of
from dual_system.models.windows import Box, Windows
from dual_system.tasks.seeds import UNTRAINED, split_of
from dual_system.training.chunks import chunk_ticks
from dual_system.training.episode import Frame, Picture, TrainingEpisode
from dual_system.training.frozen_towers import FrozenTowers
from dual_system.training.parallel import World
from dual_system.training.picture_store import PictureStore, Views

_QUANTILES = (0.01, 0.99)
_MIN_REACH = 1e-3
_MIN_SPAN = 1e-3
"""Smallest span of a dim: one that hardly moves is not stretched to fill [-1, 1]."""
_RARE = 0.1
"""Share of a native dim's range below which its quantiles say that it moves rarely; then the range is the span."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSizes:
    """Picture sizes of a run. Cached at these sizes, hundreds of episodes fit in memory."""

    form: ContextFormat | None = None
    """PONDER's format, whose reader makes its images from the views; None: PONDER is not run."""
    pounce_px: int | None = None
    """Side of POUNCE's pictures, resized as in serving; None: POUNCE reads none."""
    windows: tuple[Box, ...] = ()
    """POUNCE's, one a camera."""
    past: FrameSampling | None = None
    """The past pictures of a POUNCE with a frame memory, which needs ``pounce_px``."""

    @property
    def keys(self) -> dict[str, str]:
        """Identifies the sizes of each system that reads pictures: equal keys give equal pictures of an episode."""
        windows = f" {self.windows}" if self.windows else ""
        keys = {} if self.pounce_px is None else {"pounce": f"pounce {self.pounce_px}{windows}"}
        return keys if self.form is None else keys | {"ponder": f"ponder {self.form.reader} {self.form.image_px}"}

    def read(self, system: str, views: tuple[Picture, ...]) -> tuple[Picture, ...]:
        """What a system reads of a robot's pictures at one instant."""
        return self.of_ponder(views) if system == "ponder" else self.of_pounce(views)

    def of_ponder(self, views: tuple[Picture, ...]) -> tuple[Picture, ...]:
        return () if self.form is None else tuple(self.form.reader.images(views, self.form.image_px))

    def of_pounce(self, views: tuple[Picture, ...]) -> tuple[Picture, ...]:
        if self.pounce_px is None:
            return ()
        if self.windows:
            return tuple(Windows(self.windows).images(views, (self.pounce_px, self.pounce_px)))
        return tuple(resized(view, self.pounce_px) for view in views)

    @classmethod
    def of(cls, form: ContextFormat | None, pounce: AnyPounceConfig | None) -> PictureSizes:
        """What networks of these configurations read; None for one that is not run."""
        if pounce is None or not pounce.num_cameras:
            return cls(form=form)
        windows = pounce.windows if isinstance(pounce, PounceConfig) else ()
        return cls(form=form, pounce_px=pounce.image_px, windows=windows, past=sampling_of(pounce))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Source:
    """An episode in a dataset."""

    dataset: Dataset
    entry: Entry

    def rows(self) -> Rows:
        return self.dataset.rows(self.entry.index)

    def frames(self, rows: Sequence[int]) -> Iterator[tuple[Picture, ...]]:
        """Yields every camera's picture at each of these rows."""
        return self.dataset.views(self.entry, rows)

    @property
    def key(self) -> bytes:
        """Identifies the episode's pictures: the scene, the states and actions, and the rendered rows."""
        rows = self.rows()
        scene = f"{self.entry.task} {self.entry.seed} {self.entry.difficulty} {self.dataset.image_px}"
        return b" ".join((scene.encode(), rows.state.tobytes(), rows.action.tobytes(), rows.is_rendered.tobytes()))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Looks:
    """What systems read of an episode's pictures: from their stores, or else from its videos."""

    sizes: PictureSizes
    stores: Mapping[str, PictureStore]
    """By system; none without a folder."""
    are_features: bool = False
    """The stores hold what frozen towers make of the pictures, which no video has."""

    def at(self, source: _Source, key: bytes, rows: Sequence[int], systems: Sequence[str]) -> dict[str, Views]:
        """The views of these systems at distinct rows of an episode that is stored under ``key``.

        Raises OSError if they are features and a store lacks them, because the disk is full or a file is damaged.
        """
        stores = {system: store for system, store in self.stores.items() if system in systems}
        kept = {system: store.read(key, len(rows)) for system, store in stores.items()}
        found = {system: views for system, views in kept.items() if views is not None}
        lacking = [system for system in systems if system not in found]
        if lacking and self.are_features:
            raise OSError(
                f"{stores[lacking[0]].folder}: no features of {source.entry.task} {source.entry.seed}, or a damaged "
                "file; make room there, and start again"
            )
        whole = list(source.frames(rows)) if lacking else []
        for system in lacking:
            found[system] = [self.sizes.read(system, each) for each in whole]
            if system in stores:
                stores[system].write(key, found[system])
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotShape:
    """What a dataset says of its robot, and POUNCE's configuration has to fit."""

    cameras: tuple[str, ...]
    demo_cameras: tuple[str, ...]
    state_dim: int
    action_dim: int

    @classmethod
    def of(cls, dataset: Dataset) -> RobotShape:
        return cls(
            cameras=dataset.cameras,
            demo_cameras=dataset.demo_cameras,
            state_dim=dataset.state_dim,
            action_dim=dataset.action_dim,
        )

    def __str__(self) -> str:
        shown = "" if self.demo_cameras == self.cameras else f", demonstrations in {', '.join(self.demo_cameras)}"
        return f"cameras {', '.join(self.cameras)}, state {self.state_dim}, action {self.action_dim}{shown}"

    def dims_in(self, space: ActionSpace) -> tuple[int, int]:
        """Dims of the network's state and actions in a space. Raises ValueError if it is another robot's."""
        dims = num_dims(space)
        if dims is None:
            return self.state_dim, self.action_dim
        if (self.state_dim, self.action_dim) != (ROBOT_DIM, ROBOT_DIM):
            raise ValueError(
                f"space {space!r} is the Panda's, with {ROBOT_DIM} numbers of state and of action; the data have "
                f"{self.state_dim} and {self.action_dim}. Take a recipe whose space is native (robocasa_dc, "
                "tiny_robocasa_dc)"
            )
        return dims, dims


class TrainingSet:
    """Episodes by number, from folders of ``pp-collect`` or ``pp-export``.

    If a dataset holds only some pictures (``--frames training``), a tick without its own has the previous one, as in
    the video, and PONDER's texts are those of the rendered tick (`TrainingEpisode.as_seen`).
    """

    def __init__(
        self,
        *roots: Path,
        tasks: Sequence[str] = (),
        sizes: PictureSizes | None = None,
        cache_mb: int = 4000,
        store: Path | None = None,
        demo_hz: int = 1,
    ) -> None:
        """Indexes the successful episodes.

        Args:
            roots: folders of datasets.
            tasks: the tasks to read; () for all.
            sizes: sizes of the pictures; None reads none.
            cache_mb: memory for pictures.
            store: folder for decoded pictures at these sizes, read instead of the videos once it holds them.
            demo_hz: frames per second of demonstrations, a divisor of 20. Reading an episode that was rendered at a
                lower rate raises ValueError.

        Raises:
            DatasetError: a folder holds no dataset of ours.
            ValueError: a folder has no episode of these tasks, or the folders' robots or pictures' sizes differ.
        """
        self.roots = roots
        self._sizes, self._demo_hz = sizes or PictureSizes(), demo_hz
        self._folder = store
        stores = {} if store is None else {each: PictureStore(store, kind) for each, kind in self._sizes.keys.items()}
        self._looks = _Looks(sizes=self._sizes, stores=stores)
        self._sources = [source for root in roots for source in _sources(Dataset(root), tasks)]
        found_px = {source.dataset.image_px for source in self._sources}
        folders = ", ".join(map(str, roots))
        if len(found_px) > 1:
            raise ValueError(f"pictures of {sorted(found_px)} px in {folders}; collect all at one --image-px")
        (self.image_px,) = found_px
        robots = {RobotShape.of(source.dataset) for source in self._sources}
        if len(robots) > 1:
            raise ValueError(f"{folders} are of different robots: {'; '.join(sorted(map(str, robots)))}")
        (self.robot,) = robots
        self._cache: OrderedDict[int, TrainingEpisode] = OrderedDict()
        self._cache_bytes = cache_mb * 1_000_000
        self._cached_bytes = 0

    def __len__(self) -> int:
        return len(self._sources)

    @property
    def hash(self) -> str:
        """16 hex digits over the episodes' tasks, seeds, instructions and actions."""
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
        """Length of an episode, its demonstration included, without reading it."""
        return self._sources[number].entry.num_rows

    def demo_sampling(self) -> DemoSampling | None:
        """Sampling of these demonstrations; None if there are none.

        ``num_views`` is set if they have cameras of their own, ``to_its_end`` if most of those that end between two
        samples have their last frame rendered.
        """
        begins = [source.entry.num_demonstration_rows for source in self._sources]
        shown = [(source, begin - 1) for source, begin in zip(self._sources, begins, strict=True) if begin]
        ends = [bool(source.rows().is_rendered[last]) for source, last in shown if last % (FPS // self._demo_hz)]
        num_views = None if self.robot.demo_cameras == self.robot.cameras else len(self.robot.demo_cameras)
        sampling = DemoSampling(hz=self._demo_hz, to_its_end=2 * sum(ends) > len(ends), num_views=num_views)
        return sampling if shown else None

    def instructions(self) -> list[str]:
        """Distinct instructions, sorted."""
        return sorted({source.entry.instruction for source in self._sources})

    def instructions_with_subgoals(self) -> list[str]:
        """Distinct instructions, alone and with each subgoal of their episodes (`prompt.with_subgoal`), sorted."""
        found = {
            with_subgoal(source.entry.instruction, normalised_text(text))
            for source in self._sources
            for text in {"", *source.rows().grounded_subgoal}
        }
        return sorted(found)

    def require_texts(self) -> None:
        """Raises ValueError if an episode has no subgoals: PONDER would learn that nothing is ever to be said."""
        silent = [source for source in self._sources if not any(source.rows().grounded_subgoal)]
        if silent:
            entry = silent[0].entry
            raise ValueError(
                f"{len(silent)} of {len(self)} episodes have no subgoals (first {entry.task} {entry.seed} of "
                f"{silent[0].dataset.root}), and the recipe trains PONDER to generate them; leave these episodes out, "
                "or take a recipe with w2 = 0 (robomme_without_grounding, robocasa_dc)"
            )

    def require_trainable(self) -> None:
        """Raises ValueError if an episode's scene was drawn here from a seed that nothing is trained on."""
        found = [
            (source, split)
            for source in self._sources
            if (split := split_of(source.entry.seed)) in UNTRAINED and _is_drawn_here(source.entry)
        ]
        if found:
            source, split = found[0]
            raise ValueError(
                f"{len(found)} of {len(self)} episodes are of scenes that nothing is trained on (first "
                f"{source.entry.task} {source.entry.seed} of {source.dataset.root}: {split} split); leave these "
                "folders out, and train on pp-collect's, or on rollouts of pp-eval --split rollouts"
            )

    def texts(self) -> list[str]:
        """Distinct texts that PONDER reads or writes in these episodes, sorted."""
        found = set()
        for source in self._sources:
            rows = source.rows()
            written = {*rows.grounded_subgoal, *rows.demonstration_reasoning} - {""}
            found |= {source.entry.instruction, *(normalised_text(text) for text in written)}
        return sorted(found)

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

    def embedded(self, towers: FrozenTowers, world: World) -> TrainingSet:
        """The same episodes with the features of ``towers`` in the pictures' place, in the store beside the pictures.

        Each process begins with its own share. Raises ValueError if this set has no store.
        """
        if self._folder is None:
            raise ValueError("features of frozen towers are kept beside the pictures: give a --picture-store")
        found, keys = copy.copy(self), self._sizes.keys
        found._cache, found._cached_bytes = OrderedDict(), 0
        stores = {each: PictureStore(self._folder, f"{keys[each]} {towers.keys[each]}") for each in keys}
        found._looks = _Looks(sizes=self._sizes, stores=stores, are_features=True)
        for source in _beginning_with_own(self._sources, world):
            key = self._key(source)
            lacking = [system for system, store in stores.items() if not store.has(key)]
            if lacking:
                pictures = self._looks.at(source, key, sorted({*_instants(source, self._demo_hz)[1]}), lacking)
                for system in lacking:
                    stores[system].write(key, towers.features(system, pictures[system]))
        return found

    def _read(self, number: int) -> TrainingEpisode:
        source = self._sources[number]
        entry, rows = source.entry, source.rows()
        start = entry.num_demonstration_rows
        demo, rendered = _instants(source, self._demo_hz)
        views, images = self._pictures(source, rendered)
        history, num_demo_history = self._history(source, views, len(demo))
        episode = TrainingEpisode(
            instruction=entry.instruction,
            demo=tuple(images[: len(demo)]),
            images=images[len(demo) :],
            views=views[len(demo) :],
            state_TS=rows.state[start:],
            action_TA=rows.action[start:],
            subgoals=rows.grounded_subgoal[start:],
            is_transition_T=rows.is_transition[start:],
            reasoning=rows.demonstration_reasoning[start],
            imitated_from=entry.corrected_from,
            history=history,
            num_demo_history=num_demo_history,
        )
        seen_at = (np.array(rendered[len(demo) :]) - start).clip(min=0)
        return episode if self._sizes.form is None else episode.as_seen(seen_at)

    def _history(self, source: _Source, views: Views, num_demo: int) -> tuple[tuple[Frame, ...], int]:
        """The front pictures on the grid of POUNCE's frame memory, and how many are the demonstration's.

        Raises ValueError if the grid is not the demonstration's, or a picture on it was not rendered.
        """
        past = self._sizes.past
        if past is None:
            return (), 0
        start, stride = source.entry.num_demonstration_rows, past.stride_ticks
        if past.demonstrations.hz != self._demo_hz:
            raise ValueError(
                f"a frame memory with stride_ticks {stride} reads demonstrations at {past.demonstrations.hz} Hz, the "
                f"recipe's demo_hz is {self._demo_hz}"
            )
        is_rendered = source.rows().is_rendered[start::stride]
        if not is_rendered.all():
            raise ValueError(
                f"{source.dataset.root}: POUNCE's memory reads every {stride}th picture of {source.entry.task} "
                f"{source.entry.seed}, and {(~is_rendered).sum()} of these {len(is_rendered)} were not rendered; "
                "collect with --frames all"
            )
        shown = views[: len(past.demonstrations.indices(start, FPS))]
        return tuple(each[0] for each in (*shown, *views[num_demo::stride])), len(shown)

    def _pictures(self, source: _Source, rows: Sequence[int]) -> tuple[Views, Views]:
        """POUNCE's views and PONDER's images at ``rows``, which may repeat."""
        once = sorted(set(rows))
        found = {
            system: dict(zip(once, views, strict=True))
            for system, views in self._looks.at(source, self._key(source), once, list(self._sizes.keys)).items()
        }
        views, images = ([found[each][row] if each in found else () for row in rows] for each in ("pounce", "ponder"))
        return views, images

    def _key(self, source: _Source) -> bytes:
        return source.key + (f" {self._demo_hz}".encode() if self._demo_hz != 1 else b"")

    def statistics(self, horizon: int, space: ActionSpace = "joint_delta", *, by_row: bool = False) -> RobotStatistics:
        """Quantiles of the network's states and actions in an `action_space`.

        All rows of a chunk are pooled, as in the released RoboMME statistics; ``by_row`` first scales every row to
        the same spread (`RobotStatistics.reach`).

        Raises:
            ValueError: the space is another robot's.
        """
        return _statistics(self._sources, self.robot.dims_in(space)[1], horizon, space, by_row=by_row)


def _beginning_with_own(sources: Sequence[_Source], world: World) -> Iterator[_Source]:
    """All episodes, each process's share first."""
    first = len(sources) * world.rank // world.size
    yield from (*sources[first:], *sources[:first])


def _instants(source: _Source, demo_hz: int) -> tuple[list[int], list[int]]:
    """The rows of the demonstration that are read; and the rendered row of each of these and of every own row.

    Raises ValueError if one of the demonstration's was not rendered.
    """
    entry, rows = source.entry, source.rows()
    start = entry.num_demonstration_rows
    sampling = DemoSampling(hz=demo_hz, to_its_end=start > 0 and bool(rows.is_rendered[start - 1]))
    demo = sampling.indices(start, FPS)
    if blank := [row for row in demo if not rows.is_rendered[row]]:
        raise ValueError(
            f"{source.dataset.root}: the demonstration of {entry.task} {entry.seed} is to be sampled "
            f"{demo_hz} times a second, and {len(blank)} of these {len(demo)} pictures were not rendered; "
            f"collect with --demonstration-hz {demo_hz}"
        )
    rendered = np.maximum.accumulate(np.where(rows.is_rendered, np.arange(len(rows.is_rendered)), 0))
    return demo, rendered[[*demo, *range(start, entry.num_rows)]].tolist()


def _statistics(
    sources: Sequence[_Source], num_actions: int, horizon: int, space: ActionSpace, *, by_row: bool
) -> RobotStatistics:
    states, actions = [], []
    for source in sources:
        rows = source.rows()
        own = ~rows.is_demonstration
        state, action, begin = rows.state[own], rows.action[own], source.entry.corrected_from
        ticks = chunk_ticks(np.arange(begin, len(action)), horizon, len(action))
        state = state[begin:]
        states.append(states_in(space, state).astype(np.float32))
        actions.append(actions_in(space, action, state, ticks).astype(np.float32))
    actions_MND = np.concatenate(actions)
    reach_N = _reach(actions_MND[..., :-1]) if by_row else np.ones(horizon)
    actions_MND[..., :-1] /= reach_N[:, None]
    return RobotStatistics(
        state=_quantiles(np.concatenate(states), may_be_rare=space == "native"),
        action=_quantiles(actions_MND.reshape(-1, num_actions), may_be_rare=space == "native"),
        space=space,
        reach=tuple(reach_N.tolist()) if by_row else (),
    )


def _sources(dataset: Dataset, tasks: Sequence[str]) -> list[_Source]:
    entries = [e for e in dataset.episodes if e.is_success and (not tasks or e.task in tasks)]
    if not entries:
        there = ", ".join(sorted({e.task for e in dataset.episodes}))
        wanted = ", ".join(tasks) or "any task"
        raise ValueError(f"{dataset.root} has no successful episode of {wanted}; it has {there}")
    return [_Source(dataset=dataset, entry=entry) for entry in entries]


def _is_drawn_here(entry: Entry) -> bool:
    """Whether the scene is of this simulator: elsewhere the same seed is another scene."""
    from dual_system.tasks.task import task_names  # needs MuJoCo, which most trainings never come to need

    return entry.origin != IMPORTED and entry.task in task_names()


def _reach(moves_MND: NDArray[np.float32]) -> NDArray[np.float64]:
    """Each row's rms move relative to that of all rows, with equal weight per dim; at least `_MIN_REACH`."""
    squares_ND = np.square(moves_MND, dtype=np.float64).mean(axis=0)
    share_N: NDArray[np.float64] = np.sqrt((squares_ND / squares_ND.mean(axis=0).clip(_MIN_SPAN**2)).mean(axis=1))
    return share_N.clip(_MIN_REACH)


def _quantiles(values: NDArray[np.float32], *, may_be_rare: bool) -> Quantiles:
    """``may_be_rare``: a base that drives in one row of two hundred would be at a thousand times its quantiles."""
    low, high = np.quantile(values.astype(np.float64), _QUANTILES, axis=0)
    if may_be_rare:
        least, most = values.min(axis=0), values.max(axis=0)
        is_rare = high - low < _RARE * (most - least)
        low, high = np.where(is_rare, least, low), np.where(is_rare, most, high)
    middle, half = (low + high) / 2, np.maximum(high - low, _MIN_SPAN) / 2
    return Quantiles(q01=tuple((middle - half).tolist()), q99=tuple((middle + half).tolist()))


def _num_bytes(episode: TrainingEpisode) -> int:
    """Bytes of the episode's pictures; one that several ticks share counts once."""
    instants = {id(each): each for each in (*episode.demo, *episode.images, *episode.views)}
    return sum(picture.nbytes for pictures in instants.values() for picture in pictures)
