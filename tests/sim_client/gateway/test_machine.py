"""The gateway's end of the bus: clients' episodes against the clock service and both servers, in one thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock import schedules
from clock.check import disagreements
from clock.policies import policy_of
from protocol import messages as m
from protocol.errors import TransportError
from protocol.mcap_log import read_log
from protocol.topics import COGNITION, HEALTH, QUERY, TICK
from sim_client.gateway.body import Body
from sim_client.gateway.exchange import Busy, Finish, Observed, Refused, Step
from sim_client.gateway.options import GatewayOptions, ScheduleOptions
from sim_client.gateway.pictures import EncodedPicture
from sim_client.gateway.reading import videos

StepOf = Callable[..., Step]


def play(bench: Any, step_of: StepOf, num_requests: int, **first: Any) -> list[Any]:
    """An episode of a client whose joints go where they are commanded."""
    answers = [bench.ask(step_of(0, begins=True, **first))]
    for request in range(1, num_requests):
        answers.append(bench.ask(step_of(request, state=answers[-1].rows_NA[-1])))
    return answers


def test_one_row_per_request_is_the_episode_that_a_simulated_robot_would_have_had(
    bench: Any, new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], step_of: StepOf
) -> None:
    """Bit for bit: whoever steps the world, and over whichever protocol, the schedule is the same."""
    instruction, num_ticks = "put the cube in the bin", 45
    twin = new_rig()
    info = episode_info(schedules.paper(), instruction=instruction, seed=0)
    _, world = twin.run(info, num_ticks)
    replayed = type(world)(num_ticks)
    rows = []
    for tick in range(num_ticks):
        seen = replayed.look()
        step = step_of(frames=seen.frames, state=seen.state, begins=tick == 0, instruction=instruction)
        rows.append(bench.ask(step).rows_NA[0])
        replayed.step(rows[-1])
    assert [row.tobytes() for row in rows] == world.commands


def test_a_client_that_tells_all_it_saw_gets_that_episode_in_chunks_too(
    bench_with: Callable[..., Any], new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo],
    step_of: StepOf,
) -> None:  # fmt: skip
    """Every row is promised before the ticks in which it is commanded, and nothing differs."""
    instruction, num_ticks = "put the cube in the bin", 81
    twin = new_rig()
    _, world = twin.run(episode_info(schedules.paper(), instruction=instruction, seed=0), num_ticks)
    bench = bench_with(num_rows=20)
    replayed = type(world)(num_ticks)
    seen = [Observed(replayed.look().frames, replayed.look().state)]
    while len(replayed.commands) < num_ticks:
        begins = not replayed.commands
        step = step_of(
            frames=seen[-1].frames, state=seen[-1].state, begins=begins, since=seen[:-1], instruction=instruction
        )
        seen = []
        for row in bench.ask(step).rows_NA:
            snapshot = replayed.step(row)
            seen.append(Observed(snapshot.frames, snapshot.state))
    assert replayed.commands[:num_ticks] == world.commands


@pytest.mark.parametrize("num_rows", [1, 7, 16, 20])
def test_the_log_of_an_episode_follows_from_itself(
    bench_with: Callable[..., Any], step_of: StepOf, tmp_path: Path, num_rows: int
) -> None:
    schedule = schedules.paper() if num_rows == 1 else _every(num_rows)
    bench = bench_with(schedule, num_rows=num_rows, out=tmp_path)
    answers = play(bench, step_of, 45 if num_rows == 1 else 4, task="Some Task/1")
    bench.tell(Finish(status=m.TaskStatus.SUCCESS, reason="says the test"))
    (path,) = tmp_path.rglob("*.mcap")
    record = read_log(path)
    assert not record.recovered
    assert next(disagreements(record), None) is None
    promised = np.concatenate([answer.rows_NA for answer in answers])
    sent = np.stack([action.values for action in record.actions])
    assert sent.tobytes() == promised[: len(sent)].tobytes()
    assert len(promised) - len(sent) == num_rows - 1  # of the last answer nobody heard what became of it
    assert record.info.task == "Some-Task-1"
    assert record.result is not None
    assert (record.result.status, record.result.is_success) == (m.TaskStatus.SUCCESS, True)
    assert len(record.invocations) == (3 if num_rows == 1 else 4)


def test_a_robot_without_cameras_is_played(
    bench_with: Callable[..., Any], step_of: StepOf, robot_with: Callable[..., m.Robot], tmp_path: Path
) -> None:
    body = Body(3, lambda state, px: robot_with(cameras=(), image_height=px[0], image_width=px[1]))
    bench = bench_with(body=body, policy=policy_of("none"), out=tmp_path, patience_ns=20_000_000_000)
    spec = replace(bench.rig.pounce_engine.spec, num_cameras=0, num_carriers=0)
    bench.rig.pounce_engine.spec = bench.rig.pounce._node._spec = spec
    for request in range(25):
        bench.ask(step_of(request, begins=request == 0, frames={}))
    bench.tell(Finish())
    (path,) = tmp_path.rglob("*.mcap")
    record = read_log(path)
    assert {tick.level for tick in record.ticks} == {m.Level.PLAY}
    assert next(disagreements(record), None) is None


def test_held_the_first_six_steps_count_as_by_the_official_server(
    bench_with: Callable[..., Any], step_of: StepOf, tmp_path: Path
) -> None:
    """Its System 1 first fires at the seventh observation: 300 ms after the first."""
    options = GatewayOptions(dialect="vla-eval", timing=ScheduleOptions(wait="hold"))
    bench = bench_with(options.schedule(0), out=tmp_path)
    answers = play(bench, step_of, 30)
    assert [answer.tick for answer in answers] == [*range(30)]
    assert [answer.levels[0] for answer in answers] == [m.Level.HOLD] * 6 + [m.Level.PLAY] * 24
    bench.tell(Finish())
    (path,) = tmp_path.rglob("*.mcap")
    record = read_log(path)
    assert [(each.tick, each.age_ns) for each in record.invocations] == [(6, 300_000_000), (26, 300_000_000)]
    assert next(disagreements(record), None) is None


def test_the_horizon_of_a_schedule_is_pounce_s_own(
    bench_with: Callable[..., Any], step_of: StepOf, tmp_path: Path
) -> None:
    plan = GatewayOptions(dialect="openpi")
    bench = bench_with(plan.schedule(0, 16), out=tmp_path)
    bench.rig.pounce_engine.spec = replace(bench.rig.pounce_engine.spec, horizon=16, control_hz=20)
    play(bench, step_of, 20)
    bench.tell(Finish())
    (path,) = tmp_path.rglob("*.mcap")
    record = read_log(path)
    assert {(chunk.horizon, chunk.t_row0) for chunk in record.chunks} == {(16, 0), (16, 16)}
    assert next(disagreements(record), None) is None


def test_a_policy_of_another_rate_is_refused_by_name(bench_with: Callable[..., Any], step_of: StepOf) -> None:
    bench = bench_with()
    bench.rig.pounce_engine.spec = replace(bench.rig.pounce_engine.spec, control_hz=15)
    with pytest.raises(Refused, match="POUNCE's rows are for 15 Hz, arm takes 20 commands a second"):
        bench.ask(step_of(begins=True))


def test_more_rows_than_a_chunk_has_are_refused_and_the_next_client_may_try(
    bench_with: Callable[..., Any], step_of: StepOf
) -> None:
    bench = bench_with(num_rows=21)
    for client in ("anna", "bert"):
        with pytest.raises(Refused, match="--rows 21: POUNCE's chunks have 20 rows"):
            bench.ask(step_of(begins=True), client)


def test_with_null_cognition_ponder_is_queried_and_pounce_reads_none_of_it(
    bench_with: Callable[..., Any], step_of: StepOf, tmp_path: Path
) -> None:
    options = GatewayOptions(dialect="vla-eval", timing=ScheduleOptions(cognition="null"))
    bench = bench_with(options.schedule(0), out=tmp_path)
    play(bench, step_of, 45)
    bench.tell(Finish())
    (path,) = tmp_path.rglob("*.mcap")
    record = read_log(path)
    assert len(record.cognitions) == 3
    assert [each.ref_query for each in record.invocations] == [None] * 3
    assert next(disagreements(record), None) is None


def _every(num_ticks: int) -> m.Schedule:
    return replace(schedules.paper(), invoke_period_ticks=num_ticks)


@pytest.mark.parametrize("schedule", [schedules.paper(), schedules.realtime()], ids=["lockstep", "live"])
def test_without_a_ponder_pounce_plays_alone(
    bench_with: Callable[..., Any], step_of: StepOf, tmp_path: Path, schedule: m.Schedule
) -> None:
    bench = bench_with(schedule, policy="pounce", out=tmp_path)
    video = tuple(step_of().frames for _ in range(30))
    answers = play(bench, step_of, 5, demo=video)
    assert {answer.levels[0] for answer in answers} == {m.Level.PLAY}
    bench.tell(Finish())
    (path,) = tmp_path.rglob("*.mcap")
    record = read_log(path)
    assert (record.info.policy, record.info.has_demo, record.queries) == ("pounce", False, [])
    assert next(disagreements(record), None) is None


def test_the_video_reaches_ponder_once_a_second(bench: Any, step_of: StepOf) -> None:
    opened: list[Any] = []
    open_engine = bench.rig.ponder_engine.open
    bench.rig.ponder_engine.open = lambda session, opening, progress: (
        opened.append(opening),
        open_engine(session, opening, progress),
    )[1]
    video = [step_of(shade).frames for shade in range(45)]
    bench.ask(step_of(begins=True, demo=video))
    (opening,) = opened
    assert opening.instruction == "put the cube in the bin"
    assert [int(views[0][0, 0, 0]) for views in opening.demo_frames] == [0, 20, 40]
    assert [len(views) for views in opening.demo_frames] == [2, 2, 2]


@pytest.mark.parametrize("num_rows", [1, 5])
def test_an_answer_has_the_gate_score_that_ponder_computed_with_the_cognition_behind_it(
    bench_with: Callable[..., Any], step_of: StepOf, num_rows: int
) -> None:
    bench = bench_with(num_rows=num_rows)
    engine, take = bench.rig.ponder_engine, bench.rig.listen(TICK)
    computed, fire = [], engine.fire
    engine.fire = lambda *given, **named: (computed.append(answer := fire(*given, **named)), answer)[1]
    answers = play(bench, step_of, 85 // num_rows)
    take()
    behind = {tick.tick: tick.ref_query for tick in bench.rig.said[m.Tick]}
    assert len({behind[answer.tick] for answer in answers}) >= 3
    for answer in answers:
        assert answer.told["gate_score"] == computed[behind[answer.tick]].gate_score
    assert len({answer.told["gate_score"] for answer in answers}) >= 3


def test_without_a_gate_or_a_cognition_there_is_no_score(bench_with: Callable[..., Any], step_of: StepOf) -> None:
    null = replace(schedules.paper(), delivery=m.Delivery(kind=m.DeliveryKind.NULL))
    for bench, has_gate in ((bench_with(), False), (bench_with(null), True)):
        bench.rig.ponder_engine.has_gate = has_gate
        take = bench.rig.listen(COGNITION)
        answers = play(bench, step_of, 30)
        take()
        assert [c.gate_score is None for c in bench.rig.said[m.Cognition]] == [not has_gate] * 2
        assert {answer.told["gate_score"] for answer in answers} == {None}


def test_a_second_client_is_told_who_has_the_robot_until_that_one_finishes(bench: Any, step_of: StepOf) -> None:
    bench.ask(step_of(begins=True), client="anna")
    with pytest.raises(Busy, match="driven by anna"):
        bench.ask(step_of(begins=True), client="berta")
    bench.ask(step_of(1), client="anna")  # untouched by it
    bench.tell(Finish(), client="berta")  # says nothing about anna's
    bench.ask(step_of(2), client="anna")
    bench.tell(Finish(), client="anna")
    assert bench.ask(step_of(begins=True), client="berta").tick == 0


def test_a_client_that_fell_silent_loses_the_robot(bench_with: Callable[..., Any], step_of: StepOf) -> None:
    bench = bench_with(idle_ns=0)
    bench.ask(step_of(begins=True), client="anna")
    assert bench.ask(step_of(begins=True), client="berta").tick == 0
    with pytest.raises(Refused, match="no episode is open"):
        bench.ask(step_of(1), client="anna")


def test_an_episode_that_was_never_begun_is_refused(bench: Any, step_of: StepOf) -> None:
    with pytest.raises(Refused, match="no episode is open"):
        bench.ask(step_of())
    assert bench.ask(step_of(may_begin=True)).tick == 0
    assert bench.ask(step_of(may_begin=True)).tick == 1


def test_each_beginning_is_an_episode_of_its_own(bench: Any, step_of: StepOf) -> None:
    hear = bench.rig.listen(TICK, QUERY)
    for _ in range(3):
        assert [answer.tick for answer in play(bench, step_of, 3)] == [0, 1, 2]
    bench.tell(Finish())
    hear()
    assert len({tick.header.episode for tick in bench.rig.said[m.Tick]}) == 3
    assert [query.query for query in bench.rig.said[m.Query]] == [0, 0, 0]
    assert bench.rig.clock.conductor is None


def test_a_draining_gateway_plays_its_episode_to_the_end_and_begins_no_other(bench: Any, step_of: StepOf) -> None:
    bench.ask(step_of(begins=True))
    assert not bench.machine.drain()
    assert bench.ask(step_of(1)).tick == 1
    with pytest.raises(Refused, match="draining"):
        bench.ask(step_of(begins=True))
    assert bench.machine.drain()


def test_a_gateway_that_drains_leaves_when_its_client_has_finished(bench: Any, step_of: StepOf) -> None:
    bench.ask(step_of(begins=True))
    bench.machine.submit("anna", Finish())
    bench.machine.run(lambda: False, lambda: True)
    with pytest.raises(Refused, match="stopped"):
        bench.machine.submit("anna", step_of(begins=True))


def test_pictures_that_change_their_size_are_refused_and_the_episode_goes_on(bench: Any, step_of: StepOf) -> None:
    bench.ask(step_of(begins=True))
    big = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(Refused, match="expected 4 x 4 px as at first, came 8 x 8"):
        bench.ask(step_of(frames={"front": big, "wrist": big}))
    assert bench.ask(step_of()).tick == 1


def test_a_camera_of_another_size_is_refused_before_an_episode_begins(
    bench_with: Callable[..., Any], step_of: StepOf, picture_of: Callable[[int], np.ndarray], tmp_path: Path
) -> None:
    bench = bench_with(out=tmp_path)
    frames = {"front": picture_of(0), "wrist": np.zeros((2, 2, 3), np.uint8)}
    with pytest.raises(Refused, match=r"wrist: expected 4 x 4 px as of the front camera, came 2 x 2\. See --image-px"):
        bench.ask(step_of(begins=True, frames=frames))
    assert bench.rig.clock.conductor is None
    assert not [*tmp_path.rglob("*.mcap")]


def test_pictures_of_another_size_seen_in_between_are_refused_and_the_episode_goes_on(
    bench_with: Callable[..., Any], step_of: StepOf, picture_of: Callable[[int], np.ndarray]
) -> None:
    bench = bench_with(_every(2), num_rows=2)
    bench.ask(step_of(begins=True))
    seen = Observed({"front": picture_of(0), "wrist": np.zeros((2, 2, 3), np.uint8)}, step_of().state)
    with pytest.raises(Refused, match="wrist: expected 4 x 4 px as at first, came 2 x 2"):
        bench.ask(step_of(since=[seen]))
    assert bench.ask(step_of()).tick == 2


def test_a_video_that_cannot_be_read_ends_its_episode_and_the_next_may_try(
    bench_with: Callable[..., Any], step_of: StepOf, tmp_path: Path
) -> None:
    bench = bench_with(out=tmp_path)
    broken = videos({"front": [EncodedPicture("png", b"none", (4, 4, 3))], "wrist": [np.zeros((4, 4, 3), np.uint8)]})
    with pytest.raises(Refused, match="cannot be read as png"):
        bench.ask(step_of(begins=True, demo=broken), client="anna")
    (path,) = tmp_path.rglob("*.mcap")
    record = read_log(path)
    assert record.result is not None
    assert record.result.status == m.TaskStatus.ABORTED
    assert bench.ask(step_of(begins=True), client="bert").tick == 0


@pytest.mark.parametrize("state", [[45, 0, 0], [0, -1e30, 0]])
def test_a_state_in_other_units_is_refused_and_the_episode_goes_on(
    bench: Any, step_of: StepOf, state: list[float]
) -> None:
    wrong = np.array(state, np.float32)
    with pytest.raises(Refused, match=r"which arm cannot measure: expected -4 to 4\..*--robot-file"):
        bench.ask(step_of(begins=True, state=wrong))
    bench.ask(step_of(begins=True))
    with pytest.raises(Refused, match="in its units and order"):
        bench.ask(step_of(state=wrong))
    assert bench.ask(step_of()).tick == 1


@pytest.mark.parametrize("schedule", [schedules.paper(), schedules.realtime()])
def test_pictures_that_a_server_cannot_read_are_refused_with_a_hint(
    bench_with: Callable[..., Any], step_of: StepOf, schedule: m.Schedule
) -> None:
    bench = bench_with(schedule)
    big = np.zeros((8, 8, 3), np.uint8)
    for _ in range(2):
        with pytest.raises(
            Refused, match=r"ponder refuses .*'front' gives 8 x 8 px; PONDER reads 4 x 4 px.*--image-px"
        ):
            bench.ask(step_of(begins=True, frames={"front": big, "wrist": big}))
    bench.ask(step_of(begins=True))


def test_pictures_are_resized_where_that_was_asked_for(bench_with: Callable[..., Any], step_of: StepOf) -> None:
    bench = bench_with(image_px=4)
    big = np.zeros((8, 6, 3), np.uint8)
    assert bench.ask(step_of(begins=True, frames={"front": big, "wrist": big})).tick == 0


def test_an_instruction_that_is_too_long_is_refused_and_the_next_episode_is_played(
    bench_with: Callable[..., Any], step_of: StepOf, tmp_path: Path
) -> None:
    bench = bench_with(out=tmp_path)
    with pytest.raises(Refused, match="instruction: expected at most 20000 characters, came 30000"):
        bench.ask(step_of(0, begins=True, instruction="x" * 30_000))
    assert len(play(bench, step_of, 3)) == 3
    assert len(list(tmp_path.rglob("*.mcap*"))) == 1


def test_what_the_servers_refuse_is_told_and_the_next_may_try(
    bench_with: Callable[..., Any], step_of: StepOf, robot_with: Callable[..., m.Robot]
) -> None:
    bench = bench_with(_every(0))  # no schedule at all
    with pytest.raises(Refused, match="invoke_period_ticks"):
        bench.ask(step_of(begins=True), client="anna")
    with pytest.raises(Refused, match="invoke_period_ticks"):
        bench.ask(step_of(begins=True), client="berta")


def test_a_silent_machine_ends_the_episode_and_says_so_until_the_next(
    bench_with: Callable[..., Any], step_of: StepOf
) -> None:
    bench = bench_with(patience_ns=0)
    bench.rig.pounce_engine.invoke = _refuse
    with pytest.raises(Refused, match="no command within"):
        bench.ask(step_of(begins=True))
    with pytest.raises(Refused, match="the episode is over"):
        bench.ask(step_of(may_begin=True))


def test_live_an_answer_waits_for_the_first_command_only(bench_with: Callable[..., Any], step_of: StepOf) -> None:
    bench = bench_with(schedules.realtime(), num_rows=3)
    first = bench.ask(step_of(begins=True))
    second = bench.machine.submit("anna", step_of(1))
    bench.machine.step()
    answer = second.result(0)
    assert answer is not None
    assert answer.tick >= first.tick
    assert answer.rows_NA.shape == (3, 3)
    bench.tell(Finish())


def test_live_a_client_that_waits_no_longer_does_not_stop_the_work(
    bench_with: Callable[..., Any], step_of: StepOf
) -> None:
    bench = bench_with(schedules.realtime())
    waiting = bench.machine.submit("anna", step_of(begins=True))
    assert not waiting.cancel()
    assert bench.ask(step_of(1)).rows_NA.shape == (1, 3)
    assert waiting.done()
    bench.tell(Finish())


def test_live_commands_that_stay_away_end_the_episode(bench_with: Callable[..., Any], step_of: StepOf) -> None:
    bench = bench_with(schedules.realtime())
    bench.ask(step_of(begins=True))
    bench.rig.clock.step = lambda: False
    bench.rig.bus._participants[0] = lambda: False
    with pytest.raises(Refused, match="the episode is over: no command for"):
        _ask_for_ever(bench, step_of)


def _refuse(*arguments: Any) -> Any:
    raise ValueError("not today")


def _ask_for_ever(bench: Any, step_of: StepOf) -> None:
    while True:
        bench.ask(step_of(1))


def test_what_comes_after_the_end_is_refused(bench: Any, step_of: StepOf, working: Callable[..., Any]) -> None:
    with working(bench.machine):
        assert bench.machine.submit("anna", step_of(begins=True)).result(20) is not None
    with pytest.raises(Refused, match="the gateway was stopped"):
        bench.machine.submit("anna", step_of())
    assert bench.rig.clock.conductor is None


def test_a_gateway_waits_for_its_servers_and_tells_how_far_they_are(
    bench: Any, caplog: pytest.LogCaptureFixture
) -> None:
    pounce = bench.rig.links["pounce"]
    bench.rig.links["ponder"].publish(HEALTH, m.Health(state=m.ServingState.READY), at_ns=0)
    progress = iter([0.25, 0.5, 1.0])

    def never_stops() -> bool:
        share = next(progress, 1.0)
        state = m.ServingState.READY if share == 1.0 else m.ServingState.WARMING
        pounce.publish(HEALTH, m.Health(state=state, progress=share), at_ns=0)
        return False

    with caplog.at_level("INFO"):
        bench.machine.await_servers(never_stops)
    told = [record.getMessage() for record in caplog.records if "server=pounce" in record.getMessage()]
    assert [line.strip().split("state=")[1] for line in told] == ["warming (25%)", "warming (50%)", "ready"]


def test_a_gateway_whose_servers_are_never_ready_says_what_is_missing(bench_with: Callable[..., Any]) -> None:
    machine = bench_with(patience_ns=0).machine
    machine._servers.hear()
    with pytest.raises(TransportError, match=r"--patience-s\): ponder is not there, pounce is not there"):
        machine.await_servers(lambda: False)
