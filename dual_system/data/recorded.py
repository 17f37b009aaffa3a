"""A log's episode as a `Recording`: rows joined by tick, pictures, and what PONDER wrote, from when it was ready."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clock.check import disagreements
from dual_system.data.errors import DatasetError
from dual_system.data.language import said
from dual_system.data.recording import Recording, Seen
from dual_system.data.video import Frame
from protocol import files, images
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, Picture, read_pictures

_STYLES = {m.SubgoalKind.SUBGOAL: "subtask", m.SubgoalKind.DEMO_REASONING: "memory"}
_OF_THE_TASK = (m.SubgoalKind.TASK_GROUNDED, m.SubgoalKind.TASK_SIMPLE)


def logs_in(paths: Iterable[Path]) -> list[Path]:
    """The logs, and of a folder all below it in alphabetical order. Raises DatasetError if a folder has none."""
    found: list[Path] = []
    for path in paths:
        inside = sorted(path.rglob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise DatasetError(f"{path} holds no .mcap log; record with pp-eval --record")
        found += inside
    return found


def why_unfit(path: Path, record: EpisodeRecord) -> str:
    """Why a log is no data: it is cut, or does not agree with its own schedule; "" if it is fit."""
    if record.recovered:
        return f"the log is cut: {record.why}"
    if record.result is None:
        return "the log is cut: it has no result"
    with files.reading(path, "log of an episode"):
        found = next(disagreements(record), None)
    return "" if found is None else f"the log does not agree with its schedule (pp-check): {found}"


def recording_of(path: Path, record: EpisodeRecord) -> Recording:
    """Joins a log's messages. A tick without an observation, for which the robot was late, has the newest before it.

    Raises:
        DatasetError: the account of a tick is missing, or an observation of the first or of more than half a second.
    """
    info = record.info
    observations, ticks = joined(path, record, most_held_ticks=info.schedule.control_hz // 2)
    spoken, writer = _spoken(record, ticks)
    return Recording(
        name=str(path),
        robot=info.robot,
        control_hz=info.schedule.control_hz,
        instruction=info.instruction,
        state_NP=np.stack([each.proprio for each in observations]),
        action_NA=np.stack(commands(info.robot, ticks)),
        level=tuple(each.level.name.lower() for each in ticks),
        spoken=spoken,
        seen=_seen(path, info.robot, observations),
        about={
            "episode": info.header.episode,
            "task": info.task,
            "seed": info.seed,
            "difficulty": info.difficulty,
            "origin": info.policy,
            "is_success": record.result is not None and record.result.is_success,
            "texts_by": writer,
            "stream_sha256": record.result.stream_sha256 if record.result else "",
        },
    )


def joined(path: Path, record: EpisodeRecord, *, most_held_ticks: int = 0) -> tuple[list[m.Observation], list[m.Tick]]:
    """Returns observations and ticks 0, 1, 2 ...; the observation after the last tick is left out.

    A tick without an observation has the newest one before it, which may be ``most_held_ticks`` old.

    Raises DatasetError if the account of a tick or such an observation is missing.
    """
    seen = {each.tick: each for each in record.observations}
    done = {each.tick: each for each in record.ticks}
    num_ticks = record.result.num_ticks if record.result else len(done)
    if not num_ticks:
        raise DatasetError(f"{path}: the log has no tick")
    last, shown = -1 - most_held_ticks, []
    for tick in range(num_ticks):
        last = tick if tick in seen else last
        shown.append(last)
    unseen = [tick for tick, newest in enumerate(shown) if tick - newest > most_held_ticks]
    older = f", and any in the {most_held_ticks} ticks before," if most_held_ticks else ""
    for what, missing in (
        ("account", [tick for tick in range(num_ticks) if tick not in done]),
        (f"observation{older}", unseen),
    ):
        if missing:
            raise DatasetError(
                f"{path}: the log lacks the {what} of ticks {missing[:5]} of {num_ticks}: an episode with such gaps "
                "cannot be trained on"
            )
    return [seen[newest] for newest in shown], [done[tick] for tick in range(num_ticks)]


def commands(robot: m.Robot, ticks: Sequence[m.Tick]) -> list[m.Floats]:
    """What was commanded in each tick: the last command again where the clock was late and sent none (`SKIPPED`)."""
    found, last = [], robot.initial_command
    for tick in ticks:
        last = last if tick.level == m.Level.SKIPPED else tick.action
        found.append(last)
    return found


def _spoken(record: EpisodeRecord, ticks: Sequence[m.Tick]) -> tuple[list[dict[str, Any]], str]:
    """The persistent language, and who wrote it: PONDER, from the first tick at which its answer was ready; where it
    wrote nothing, the simulator."""
    hz, num_ticks = record.info.schedule.control_hz, len(ticks)
    ready_ns = {each.index: each.ready_ns for each in record.stamps if each.kind == m.StampKind.COGNITION}
    deadlines_ns = np.array([each.deadline_ns for each in ticks])
    written = []
    for subgoal in (each for each in record.subgoals if each.kind in _STYLES and each.text):
        if subgoal.query in ready_ns:
            tick = int(np.searchsorted(deadlines_ns, ready_ns[subgoal.query]))
        else:
            tick = subgoal.tick if subgoal.query is None else num_ticks  # an answer that never came is no text
        if tick < num_ticks:
            written.append(said(subgoal.text, _STYLES[subgoal.kind], tick / hz))
    if written:
        return written, "ponder"
    kind = next((kind for kind in _OF_THE_TASK if any(each.kind == kind for each in record.subgoals)), None)
    told = [each for each in record.subgoals if each.kind == kind and each.text and each.tick < num_ticks]
    return [said(each.text, "subtask", each.tick / hz) for each in told], "simulator" if told else "nobody"


def _seen(path: Path, robot: m.Robot, observations: Sequence[m.Observation]) -> Iterator[Seen]:
    """Every picture: the exact pixels where the log has them, else what its cameras' channels hold."""
    elsewhere = {}
    for each in dict.fromkeys(observations):  # one that was held is shown once
        for image in each.images:
            if image.codec == m.ImageCodec.RAW:
                yield Seen(image.camera, each.tick, images.unpack(image))
            else:
                elsewhere[image.camera, each.source_ns] = each
    if not elsewhere:
        return
    for picture in read_pictures(path):
        observation = elsewhere.pop((picture.camera, picture.source_ns), None)
        if observation is not None:
            with files.reading(path, f"log with a picture of tick {observation.tick}"):
                frame = unpacked(picture, observation)
            yield Seen(picture.camera, observation.tick, frame)
    if elsewhere:
        (camera, _), observation = next(iter(elsewhere.items()))
        raise DatasetError(
            f"{path}: no picture of {camera} at tick {observation.tick}, which its observation announces"
        )


def unpacked(picture: Picture, observation: m.Observation) -> Frame:
    """Decodes a logged picture, which must have the size that the observation announced."""
    (announced,) = (image for image in observation.images if image.camera == picture.camera)
    codec = m.ImageCodec[picture.format.upper()]
    return images.unpack(replace(announced, codec=codec, data=picture.data))
