"""``pp-export``: exports recorded episodes as a LeRobot v3 dataset, every row an exact join by tick.

Row k is the observation of tick k, the texts in force then, and the action that was commanded for tick k. Any robot's
log becomes rows ``recorded`` (`recording`). A log of a task here may also become rows for ``training``: it holds no
demonstration, but a seed decides the scene, so the demonstration is performed again and put before the rows; the state
after it must equal the first state of the log.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

from dual_system.data.episode import CAMERAS, About, Episode, EpisodeWriter, Row, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_files import INFO_PATH
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.data.recorded import commands, joined, logs_in, recording_of, unpacked, why_unfit
from dual_system.data.recording import RecordingWriter
from dual_system.data.rollout import Narrator
from dual_system.data.video import FPS, Frame
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.seeds import HELD_OUT, Split, split_of
from dual_system.tasks.task import task_names
from protocol import files, images
from protocol import messages as m
from protocol.command_line import On, command, parse
from protocol.errors import FileError
from protocol.mcap_log import EpisodeRecord, read_log, read_pictures

DONE = 0
SUITE = "RoboMME"
"""The suite of the tasks that are simulated here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Turns recorded episodes into a LeRobot v3 dataset, in the order they are named."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """MCAP logs of sim-client or pp-eval, or folders of them."""
    out: Path
    """Folder of the new dataset."""
    rows: Literal["auto", "training", "recorded"] = "auto"
    """training: a set that pp-train reads, with demonstrations; of tasks simulated here only. recorded: what the logs
    hold, of any one robot, at its own rate, with LeRobot's language columns. auto: training if the first log is of a
    task here, else recorded."""
    unfit: Literal["refuse", "leave-out"] = "refuse"
    """A log that is cut, has a gap or does not agree with its schedule. refuse: stop and name it; leave-out: go on
    without it and say why."""
    texts: Literal["logged", "follow"] = "logged"
    """Subgoal texts of training rows. logged: as recorded; follow: replay every action and write the texts as the scene
    then stands. A dropped object is to be picked up again, coordinates follow pushed objects, and of several objects
    that all count the next one is one that is left. Use follow to train PONDER on policy rollouts."""
    demonstration_hz: Literal[1, 2, 4, 5, 10, 20] = 20
    """Rate of a demonstration's pictures in Hz; its last frame is always rendered. Training reads 1 Hz by default."""
    only_success: bool = False
    """Leave out episodes that did not succeed."""
    progress: On = True
    """Do not show a progress bar."""


@command("pp-export")
def main(argv: list[str] | None = None) -> int:
    options = parse(ExportOptions, argv, prog="pp-export")
    num_episodes, left_out = export(options)
    for told in left_out:
        sys.stderr.write(f"pp-export: left out: {told}\n")
    sys.stdout.write(f"{num_episodes} of {len(logs_in(options.files))} episodes in {options.out}\n")
    return DONE


def export(options: ExportOptions) -> tuple[int, list[str]]:
    """Writes the dataset; returns the number of its episodes, and why logs were left out.

    Raises:
        DatasetError: there is a dataset already, nothing is left to write, or a log is unfit or of a test scene.
        OSError, ProtocolError: a log cannot be read.
        TaskError: a log of a task that does not exist here.
    """
    if (options.out / INFO_PATH).exists():
        raise DatasetError(f"{options.out} holds a dataset already; use another --out")
    if not options.files:
        raise DatasetError("name at least one log")
    logs = logs_in(options.files)
    writer = (_Training if _is_for_training(options, logs[0]) else _Recorded)(options)
    num_episodes, left_out = 0, list[str]()
    for path in tqdm(logs, unit="episode", disable=not options.progress):
        try:
            record = read_log(path)
            if options.only_success and not (record.result and record.result.is_success):
                continue
            refuse_split(path, record.info, HELD_OUT)
            if why := why_unfit(path, record):
                raise DatasetError(f"{path}: {why}")
            with files.writing(options.out):
                writer.add(path, record)
        except (DatasetError, FileError) as error:
            if options.unfit == "refuse":
                raise DatasetError(f"{error}. --unfit leave-out goes on without such logs") from None
            left_out.append(str(error))
            continue
        num_episodes += 1
    if not num_episodes:
        why = "; ".join(left_out) or "none of the logs is of an episode that succeeded; leave out --only-success"
        raise DatasetError(f"nothing to write: {why}")
    with files.writing(options.out):
        writer.finish()
    return num_episodes, left_out


class _Training:
    """Rows for training, of tasks here."""

    def __init__(self, options: ExportOptions) -> None:
        self._options, self._writer = options, DatasetWriter(files.folder(options.out))
        self.finish = self._writer.finish

    def add(self, path: Path, record: EpisodeRecord) -> None:
        of = self._options
        self._writer.add(read_episode(path, record, texts=of.texts, demonstration_hz=of.demonstration_hz))


class _Recorded:
    """Rows as they were recorded, of any robot."""

    def __init__(self, options: ExportOptions) -> None:
        self._writer = RecordingWriter(files.folder(options.out))
        self.finish = self._writer.finish

    def add(self, path: Path, record: EpisodeRecord) -> None:
        self._writer.add(recording_of(path, record))


def _is_for_training(options: ExportOptions, first: Path) -> bool:
    if options.rows == "auto":
        return _is_ours(read_log(first).info)
    return options.rows == "training"


def refuse_split(path: Path, info: m.EpisodeInfo, refused: frozenset[Split]) -> None:
    """Raises DatasetError for an episode of a scene that was drawn here from a seed of one of these splits."""
    if _is_ours(info) and (split := split_of(info.seed)) in refused:
        raise DatasetError(
            f"{path}: seed {info.seed} of {info.task} is of the {split} split, which no training data may hold; play "
            "episodes for training with pp-eval --split rollouts"
        )


def _is_ours(info: m.EpisodeInfo) -> bool:
    """Whether the episode's scene was drawn here: elsewhere the same seed is another scene."""
    return info.suite == SUITE and info.task in task_names()


def read_episode(
    path: Path,
    record: EpisodeRecord,
    *,
    texts: Literal["logged", "follow"] = "logged",
    demonstration_hz: int = FPS,
) -> Episode:
    """Joins a log's messages, and performs its demonstration again.

    Args:
        texts: as in `ExportOptions`.
        demonstration_hz: rate of the demonstration's pictures.

    Raises:
        DatasetError: something is missing from the log, or its seed gives another scene here.
        TaskError: its task does not exist here.
    """
    info = record.info
    if info.schedule.control_hz != FPS:
        raise DatasetError(
            f"{path}: {info.schedule.control_hz} commands a second; training rows have {FPS}: give --rows recorded"
        )
    observations, ticks = joined(path, record)
    actions = commands(info.robot, ticks)
    height_px, width_px = info.robot.image_height, info.robot.image_width
    if height_px != width_px:
        raise DatasetError(
            f"{path}: pictures of {height_px} x {width_px} px; training rows have square ones: give --rows recorded"
        )
    writer = EpisodeWriter(height_px)
    follows = texts == "follow"
    max_steps = len(actions) + 1  # it ended as it did
    with make_environment(info.task, image_px=height_px, max_steps=max_steps, texts_follow=follows) as environment:
        narrator, first = _again(path, environment, info, observations[0])
        for row, frames in narrator.demonstration(demonstration_hz):
            writer.add(row, frames)
        reasoning = narrator.reasoning()
        if follows:
            captions = _played_again(path, environment, first, observations, actions)
        else:
            captions = texts_by_tick(record.subgoals, len(actions))
        for observation, action, (plain, grounded, is_new), seen in zip(
            observations, actions, captions, _pictures(path, observations), strict=True
        ):
            is_first = observation is observations[0]
            row = Row(
                state=observation.proprio,
                action=action,
                tcp_pose=narrator.tcp_pose(observation.proprio),
                subgoal=plain,
                grounded_subgoal=grounded,
                is_transition=is_new,
                demonstration_reasoning=reasoning if is_first else "",
            )
            writer.add(row, seen)
    about = About(
        task=info.task,
        instruction=info.instruction,
        seed=info.seed,
        difficulty=info.difficulty,
        origin=info.policy,
        is_success=record.result is not None and record.result.is_success,
        image_px=height_px,
    )
    return unpack(writer.pack(about))


def _played_again(
    path: Path,
    environment: Environment,
    snapshot: Snapshot,
    observations: Sequence[m.Observation],
    actions: Sequence[m.Floats],
) -> list[tuple[str, str, bool]]:
    """Returns the texts of every tick as `texts_by_tick` has them, made anew as the scene then stands.

    Raises DatasetError if a state differs from the log's.
    """
    captions, index = [], -1
    for observation, action in zip(observations, actions, strict=True):
        if not np.array_equal(snapshot.state, observation.proprio):
            raise DatasetError(
                f"{path}: at tick {observation.tick} the robot stands at {snapshot.state.tolist()} here and at "
                f"{observation.proprio.tolist()} in the log; export it with the versions that made it, or as logged"
            )
        captions.append((snapshot.simple_subgoal, snapshot.grounded_subgoal, snapshot.subgoal_index != index))
        index = snapshot.subgoal_index
        snapshot = environment.step(action, look=False)
    return captions


def _again(
    path: Path, environment: Environment, info: m.EpisodeInfo, first: m.Observation
) -> tuple[Narrator, Snapshot]:
    """Resets the log's scene. Raises DatasetError unless its first state is the log's."""
    snapshot = environment.reset(info.seed, info.difficulty)
    state = snapshot.state
    if not np.array_equal(state, first.proprio):
        raise DatasetError(
            f"{path}: seed {info.seed} of {info.task} begins at {state.tolist()} here and at {first.proprio.tolist()} "
            f"in the log, which was made with {info.versions}; export it with those versions"
        )
    return Narrator(environment), snapshot


def texts_by_tick(subgoals: Sequence[m.Subgoal], num_ticks: int) -> list[tuple[str, str, bool]]:
    """Returns the simulator's plain and grounded text in force at each tick, and whether a subgoal begins there.

    Texts are logged when they change, and both whenever a subtask begins; a plain one changes at no other time.
    """
    plain = {each.tick: each.text for each in subgoals if each.kind == m.SubgoalKind.TASK_SIMPLE}
    grounded = {each.tick: each.text for each in subgoals if each.kind == m.SubgoalKind.TASK_GROUNDED}
    found, now = [], ("", "")
    for tick in range(num_ticks):
        now = (plain.get(tick, now[0]), grounded.get(tick, now[1]))
        found.append((*now, tick in plain))
    return found


def _pictures(path: Path, observations: Sequence[m.Observation]) -> Iterator[dict[str, Frame]]:
    """Each observation's pictures: the exact pixels where the log has them, else what its cameras' channels hold.

    Yields an empty dictionary at ticks without pictures (`--record-hz`).
    """
    logged = read_pictures(path)
    for observation in observations:
        if not observation.images and observation is not observations[0]:
            yield {}
            continue
        exact = {each.camera: images.unpack(each) for each in observation.images if each.codec == m.ImageCodec.RAW}
        if set(exact) == set(CAMERAS):
            yield exact
            continue
        found: dict[str, Frame] = {}
        for picture in logged:
            if picture.source_ns == observation.source_ns and picture.camera in CAMERAS:
                with files.reading(path, f"log with a picture of tick {observation.tick}"):
                    found[picture.camera] = unpacked(picture, observation)
            if len(found) == len(CAMERAS):
                break
        else:
            raise DatasetError(f"{path}: no pictures of tick {observation.tick}; record with cameras")
        yield found


if __name__ == "__main__":
    sys.exit(main())
