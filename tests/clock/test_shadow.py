"""Shadows: servers that are asked like the others, whose answers are in the log and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from clock.check_shadow import check_shadows
from ponder_server.serve import PonderServer
from pounce_server.serve import PounceServer
from protocol import messages as m
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.episode import always
from sim_client.recorder import Recorder

Info = Callable[..., m.EpisodeInfo]
NUM_TICKS = 100


@dataclass
class Shadows:
    """A PONDER and a POUNCE behind those of a rig, on the same bus."""

    rig: Any
    ponder_engine: Any
    pounce_engine: Any

    def __post_init__(self) -> None:
        self.ponder = self.start("ponder", PonderServer, self.ponder_engine)
        self.pounce = self.start("pounce", PounceServer, self.pounce_engine)

    def start(self, proc: str, kind: Any, engine: Any) -> Any:
        link = Link(self.rig.bus, robot="r0", proc=f"{proc}-shadow")
        server = kind(link, engine, Heartbeat(link, "test", "host/monotonic"), "test")
        server.warm_up()
        server.ready()
        self.rig.bus.add_participant(server.step)
        return server


@pytest.fixture
def shadows(rig: Any, fake_ponder: Any, fake_pounce: Any) -> Shadows:
    return Shadows(rig, fake_ponder, fake_pounce)


def recorded(
    rig: Any, info: m.EpisodeInfo, path: Path, num_ticks: int = NUM_TICKS, looks: Callable[[int], bool] = always
) -> tuple[EpisodeRecord, list[bytes]]:
    recorder = Recorder(rig.links["sim"], "jpeg")
    recorder.begin(info, path)
    meanwhile = rig.meanwhile

    def record() -> None:
        recorder.step()
        meanwhile()

    rig.meanwhile = record
    _, world = rig.run(info, num_ticks, looks)
    rig.meanwhile = meanwhile
    recorder.end(m.EpisodeResult(status=m.TaskStatus.ONGOING, is_success=False, reason="", num_ticks=num_ticks))
    return read_log(path), world.commands


def test_with_shadows_the_robot_does_the_same_to_the_bit(
    new_rig: Callable[..., Any], fake_ponder: Any, fake_pounce: Any, episode_info: Info, paper: m.Schedule
) -> None:
    alone, watched = new_rig(), new_rig()
    fake_pounce.spec = replace(fake_pounce.spec, model_hash="another")
    Shadows(watched, fake_ponder, fake_pounce)
    _, without = alone.run(episode_info(paper), NUM_TICKS)
    _, with_them = watched.run(episode_info(paper), NUM_TICKS)
    assert len(fake_pounce.requests) == 5
    assert with_them.commands == without.commands


def test_their_answers_are_in_the_log_beside_those_that_were_used(
    rig: Any, shadows: Shadows, episode_info: Info, paper: m.Schedule, tmp_path: Path
) -> None:
    shadows.pounce_engine.spec = replace(shadows.pounce_engine.spec, model_hash="another")
    shadows.pounce._node._spec = shadows.pounce_engine.spec
    record, _ = recorded(rig, episode_info(paper), tmp_path / "log.mcap")
    assert next(disagreements(record), None) is None
    assert [each.query for each in record.shadow_cognitions] == [each.query for each in record.cognitions]
    assert [each.invocation for each in record.shadow_chunks] == [each.invocation for each in record.chunks]
    assert {each.header.proc for each in record.chunks + record.cognitions} == {"ponder", "pounce"}
    assert {each.model_hash for each in record.chunks} == {"fake-pounce"}
    assert {each.model_hash for each in record.shadow_chunks} == {"another"}
    assert record.cognitions[0].vector.tobytes() == record.shadow_cognitions[0].vector.tobytes()
    assert record.chunks[0].rows.tobytes() == record.shadow_chunks[0].rows.tobytes()


def test_one_with_a_window_sees_its_ticks_and_the_robot_makes_no_pictures_for_it(
    new_rig: Callable[..., Any],
    fake_ponder: Any,
    fake_pounce: Any,
    episode_info: Info,
    paper: m.Schedule,
    tmp_path: Path,
) -> None:
    window = m.ObservationWindow(video_ticks=(-1, 0), state_ticks=(-2, 0))
    fake_pounce.spec = replace(fake_pounce.spec, window=window, model_hash="another")
    commands = []
    for name, padded in (("shown", ()), ("spared", (-1,))):
        rig = new_rig()
        Shadows(rig, fake_ponder, fake_pounce)
        fake_pounce.requests.clear()
        looks = always if name == "shown" else lambda tick, rig=rig: rig.clock.conductor.will_look(tick)
        record, done = recorded(rig, episode_info(paper), tmp_path / f"{name}.mcap", looks=looks)
        commands.append(done)
        assert next(disagreements(record), None) is None
        states = {each.tick: each.proprio for each in record.observations}
        assert len(record.shadow_chunks) == len(record.chunks) >= 5
        for chunk, request in zip(record.shadow_chunks[1:], fake_pounce.requests[1:], strict=True):
            wanted = [states[chunk.t_row0 + offset] for offset in window.state_ticks]
            np.testing.assert_array_equal(request.window.states_TP, wanted)
            assert (chunk.padded_video_ticks, chunk.padded_state_ticks) == (padded, ())
    assert commands[0] == commands[1]


def test_they_are_there_in_the_next_episode_too(
    rig: Any, shadows: Shadows, episode_info: Info, paper: m.Schedule, tmp_path: Path
) -> None:
    for epoch in (1, 2):
        record, _ = recorded(rig, episode_info(paper, epoch=epoch), tmp_path / f"{epoch}.mcap")
        assert next(disagreements(record), None) is None
        assert len(record.shadow_cognitions) == len(record.cognitions) >= 5
        assert len(record.shadow_chunks) == len(record.chunks) >= 5


def test_in_mid_episode_a_pounce_may_join_and_a_ponder_waits_for_the_next(
    rig: Any, fake_ponder: Any, fake_pounce: Any, episode_info: Info, paper: m.Schedule, tmp_path: Path
) -> None:
    come: list[Shadows] = []

    def join() -> None:
        if not come and rig.clock.conductor.num_invocations == 6:
            come.append(Shadows(rig, fake_ponder, fake_pounce))

    rig.meanwhile = join
    record, _ = recorded(rig, episode_info(paper), tmp_path / "1.mcap", 200)
    assert next(disagreements(record), None) is None
    assert record.shadow_cognitions == []
    assert 3 <= len(record.shadow_chunks) <= 5
    record, _ = recorded(rig, episode_info(paper, epoch=2), tmp_path / "2.mcap")
    assert len(record.shadow_cognitions) == len(record.cognitions) >= 5


def test_a_ponder_that_does_not_keep_up_leaves_and_has_no_hole_in_its_context(
    rig: Any, shadows: Shadows, episode_info: Info, paper: m.Schedule, tmp_path: Path
) -> None:
    is_asleep = [False]
    step = shadows.ponder.step

    def sleepy() -> bool:
        if rig.clock.conductor is not None and 3 <= rig.clock.conductor.num_invocations < 14:
            is_asleep[0] = True
            return False
        return bool(step())

    rig.bus._participants[rig.bus._participants.index(step)] = sleepy
    record, _ = recorded(rig, episode_info(paper), tmp_path / "log.mcap", 320)
    assert is_asleep[0]
    assert next(disagreements(record), None) is None
    assert [each.query for each in record.shadow_cognitions] == [*range(len(record.shadow_cognitions))]
    assert 2 <= len(record.shadow_cognitions) <= 5
    assert "shadow_left" in [event.name for event in record.events]


def test_one_that_left_early_does_not_answer_twice(
    rig: Any, shadows: Shadows, episode_info: Info, paper: m.Schedule, tmp_path: Path
) -> None:
    has_left: list[int] = []

    def leave() -> None:
        if not has_left and rig.clock.conductor.num_invocations == 2:
            has_left.append(1)
            shadows.ponder._membership.leave()

    rig.meanwhile = leave
    record, _ = recorded(rig, episode_info(paper), tmp_path / "log.mcap")
    assert has_left
    assert next(disagreements(record), None) is None
    assert 1 <= len(record.shadow_cognitions) <= 3


@pytest.fixture
def record(rig: Any, shadows: Shadows, episode_info: Info, paper: m.Schedule, tmp_path: Path) -> EpisodeRecord:
    return recorded(rig, episode_info(paper), tmp_path / "log.mcap")[0]


def first(record: EpisodeRecord) -> str:
    return str(next(check_shadows(record)))


def test_one_that_nobody_admitted_is_named(record: EpisodeRecord) -> None:
    header = replace(record.shadow_chunks[2].header, boot_id=7)
    record.shadow_chunks[2] = replace(record.shadow_chunks[2], header=header)
    assert "sender: expected one that the clock admitted, found pounce-shadow#7" in first(record)


@pytest.mark.parametrize(
    ("changes", "field"),
    [({"invocation": 99}, "invocation"), ({"age_ns": 1}, "age_ns"), ({"seed": 1}, "seed"), ({"t_row0": 5}, "t_row0")],
)
def test_a_chunk_that_belongs_to_no_request_is_named(
    record: EpisodeRecord, changes: dict[str, Any], field: str
) -> None:
    record.shadow_chunks[1] = replace(record.shadow_chunks[1], **changes)
    assert f"Shadow chunk 1 {field}" in first(record).replace(".", " ")


def test_a_cognition_that_belongs_to_no_request_is_named(record: EpisodeRecord) -> None:
    record.shadow_cognitions[1] = replace(record.shadow_cognitions[1], source_ns=5)
    assert "observation" in first(record)


def test_an_answer_given_twice_is_named(record: EpisodeRecord) -> None:
    record.shadow_chunks.append(record.shadow_chunks[0])
    assert "is_repeated" in first(record)


def test_whatever_a_shadow_answers_no_motion_follows(record: EpisodeRecord) -> None:
    for index, chunk in enumerate(record.shadow_chunks):
        record.shadow_chunks[index] = replace(chunk, rows=np.full_like(chunk.rows, 1e30))
    assert next(disagreements(record), None) is None
