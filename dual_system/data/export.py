"""``pp-export``: exports recorded episodes as a dataset of the same format, every row an exact join by tick.

Row k is the observation of tick k, the texts in force then, and the action that was commanded for tick k. A log holds
no demonstration. Since a seed decides the scene, the demonstration is performed again and put before the rows; the
state after it must equal the first state of the log.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

from dual_system.data.episode import CAMERAS, About, Episode, EpisodeWriter, Row, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_v3 import INFO_PATH, DatasetWriter
from dual_system.data.rollout import Narrator
from dual_system.data.video import FPS, Frame
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from protocol import files, images
from protocol import messages as m
from protocol.command_line import command, parse
from protocol.mcap_log import EpisodeRecord, Picture, read_log, read_pictures

DONE, REFUSED = 0, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Turns recorded episodes into a LeRobot v3 dataset, in the order they are named."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """MCAP logs of sim-client or pp-eval."""
    out: Path
    """Folder of the new dataset."""
    texts: Literal["logged", "follow"] = "logged"
    """Subgoal texts. logged: as recorded; follow: replay every action and write the texts as the scene then stands.
    A dropped object is to be picked up again, coordinates follow pushed objects, and of several objects that all count
    the next one is one that is left. Use follow to train PONDER on policy rollouts."""
    demonstration_hz: Literal[1, 2, 4, 5, 10, 20] = 20
    """Rate of a demonstration's pictures in Hz; its last frame is always rendered. Training reads 1 Hz by default."""
    only_success: bool = False
    """Leave out episodes that did not succeed."""
    progress: bool = True
    """Do not show a progress bar."""


@command("pp-export")
def main(argv: list[str] | None = None) -> int:
    options = parse(ExportOptions, argv, prog="pp-export")
    num_episodes = export(options)
    sys.stdout.write(f"{num_episodes} of {len(options.files)} episodes in {options.out}\n")
    return DONE


def export(options: ExportOptions) -> int:
    """Writes the dataset and returns the number of its episodes.

    Raises:
        DatasetError: there is a dataset already, nothing is left to write, or a log cannot be joined.
        OSError, ProtocolError: a log cannot be read.
        TaskError: a log of a task that does not exist here.
    """
    if (options.out / INFO_PATH).exists():
        raise DatasetError(f"{options.out} holds a dataset already; use another --out")
    writer = DatasetWriter(files.folder(options.out))
    num_episodes = 0
    for path in tqdm(options.files, unit="episode", disable=not options.progress):
        record = read_log(path)
        if options.only_success and not (record.result and record.result.is_success):
            continue
        episode = read_episode(path, record, texts=options.texts, demonstration_hz=options.demonstration_hz)
        with files.writing(options.out):
            writer.add(episode)
        num_episodes += 1
    if not num_episodes:
        raise DatasetError("none of the logs is of an episode that succeeded; leave out --only-success")
    with files.writing(options.out):
        writer.finish()
    return num_episodes


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
        raise DatasetError(f"{path}: {info.schedule.control_hz} commands a second; datasets here have {FPS} rows")
    observations, actions = _joined(path, record)
    height_px, width_px = info.robot.image_height, info.robot.image_width
    if height_px != width_px:
        raise DatasetError(f"{path}: pictures of {height_px} x {width_px} px; datasets here have square ones")
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


def _joined(path: Path, record: EpisodeRecord) -> tuple[list[m.Observation], list[m.Floats]]:
    """Returns observations and actions of ticks 0, 1, 2 ...; the observation after the last action is left out."""
    seen = {each.tick: each for each in record.observations}
    done = {each.tick: each.action for each in record.ticks}
    num_ticks = record.result.num_ticks if record.result else len(done)
    missing = [tick for tick in range(num_ticks) if tick not in seen or tick not in done]
    if missing or not num_ticks:
        what = f"ticks {missing[:5]} of {num_ticks}" if missing else "every tick"
        raise DatasetError(
            f"{path}: the log lacks the observation or the account of {what}: an episode with gaps cannot be trained on"
        )
    return [seen[tick] for tick in range(num_ticks)], [done[tick] for tick in range(num_ticks)]


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
                    found[picture.camera] = _pixels(picture, observation)
            if len(found) == len(CAMERAS):
                break
        else:
            raise DatasetError(f"{path}: no pictures of tick {observation.tick}; record with cameras")
        yield found


def _pixels(picture: Picture, observation: m.Observation) -> Frame:
    """Decodes a logged picture, which must have the size that the observation announced."""
    (announced,) = (image for image in observation.images if image.camera == picture.camera)
    codec = m.ImageCodec[picture.format.upper()]
    return images.unpack(replace(announced, codec=codec, data=picture.data))


if __name__ == "__main__":
    sys.exit(main())
