"""A robot's own program, by its own client: stepped by the schedule, stopped with its robot, and never jerked."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import ponderpounce_client as client
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from clock.check import disagreements
from protocol import messages as m
from protocol.mcap_log import read_log
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Refused, Step, Terms
from sim_client.gateway.ponderpounce import STATE_KEY, PonderpounceDialect
from sim_client.gateway.websocket import WebsocketSide

MAX_BYTES = 100_000
PictureOf = Callable[[int], np.ndarray]


@pytest.fixture
def dialect(terms_with: Callable[..., Terms]) -> PonderpounceDialect:
    return PonderpounceDialect(terms_with(cameras={"front": "front", "wrist": "wrist"}, state_key=STATE_KEY))


def observe(picture_of: PictureOf, **changes: Any) -> bytes:
    pictures = {
        name: {"__ndarray__": True, "data": picture_of(1).tobytes(), "dtype": "|u1", "shape": [4, 4, 3]}
        for name in ("front", "wrist")
    }
    message = {"kind": "observe", "seq": 3, "state": [0.0, 1.0, 2.0], "state_ns": 5, "images": pictures}
    return bytes(msgpack.packb({key: value for key, value in (message | changes).items() if value is not None}))


def understood(asked: ClientRequest) -> Step:
    assert isinstance(asked.request, Step)
    return asked.request


def test_pictures_bring_their_instants_by_the_camera_s_name(
    dialect: PonderpounceDialect, picture_of: PictureOf
) -> None:
    assert understood(dialect.read(observe(picture_of))).captured_ns == {}
    assert understood(dialect.read(observe(picture_of, captured_ns={"wrist": -7}))).captured_ns == {"wrist": -7}
    for odd in ([5], {"wrist": "now"}, {"front": 1 << 62}):
        with pytest.raises(Refused, match=r"captured_ns|wrist|front"):
            dialect.read(observe(picture_of, captured_ns=odd))


@given(
    row=st.lists(st.floats(-3, 3, width=32), min_size=1, max_size=9),
    tick=st.integers(0, 10**6),
    level=st.sampled_from([level for level in m.Level if level]),
    deadline_ns=st.integers(-(10**18), 10**18),
)
def test_a_command_reaches_the_program_bit_for_bit(
    terms_with: Callable[..., Terms], row: list[float], tick: int, level: m.Level, deadline_ns: int
) -> None:
    values = np.array([row], np.float32)
    answer = Answer(rows_NA=values, tick=tick, levels=(level,), deadline_ns=deadline_ns)
    told = msgpack.unpackb(PonderpounceDialect(terms_with()).answer(ClientRequest(None, 7), answer))
    assert np.array(told["values"], np.float32).tobytes() == values.tobytes()
    assert (told["kind"], told["seq"], told["tick"], told["level"]) == ("command", 7, tick, level.name)
    assert (told["deadline_ns"], told["expires_ns"]) == (deadline_ns, deadline_ns + 150_000_000)


def test_what_the_robot_says_of_itself_comes_through(dialect: PonderpounceDialect, picture_of: PictureOf) -> None:
    step = understood(dialect.read(observe(picture_of, robot_state="protective_stop", robot_text="joint 3")))
    assert (step.robot_state, step.robot_text) == (m.RobotState.PROTECTIVE_STOP, "joint 3")
    assert (step.taken_ns, step.state.tolist(), step.begins) == (5, [0, 1, 2], False)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"seq": None}, "seq: expected"),
        ({"seq": -1}, "seq: expected"),
        ({"kind": "obey"}, "expected time, begin, observe or end"),
        ({"state": [0.0]}, "expected 3 numbers, came 1"),
        ({"state_ns": 1.5}, "expected nanoseconds"),
        ({"state_ns": True}, "expected nanoseconds"),
        ({"state_ns": 1 << 63}, "expected nanoseconds"),
        ({"state_ns": None}, "expected 'state_ns'"),
        ({"images": []}, "pictures by camera"),
        ({"images": {}}, "expected 'front'"),
        ({"robot_state": "fine"}, "robot_state: expected ok, user_stop"),
        ({"robot_state": []}, "robot_state: expected ok, user_stop"),
        ({"kind": "begin"}, "expected 'instruction'"),
        ({"kind": "begin", "instruction": "go", "speed": 1.5}, "speed: expected 0.1 to 1"),
        ({"kind": "begin", "instruction": "go", "speed": float("nan")}, "speed: expected 0.1 to 1"),
        ({"kind": "begin", "instruction": "go", "speed": True}, "speed: expected 0.1 to 1"),
    ],
)
def test_what_cannot_be_used_is_told_with_its_number(
    dialect: PonderpounceDialect, picture_of: PictureOf, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(Refused, match=sentence):
        dialect.read(observe(picture_of, **changes))
    told = msgpack.unpackb(dialect.refuse("a sentence"))
    assert (told["kind"], told["why"]) == ("refused", "a sentence")


@pytest.mark.parametrize(("success", "status"), [(True, "SUCCESS"), (False, "FAIL"), (None, "ONGOING")])
def test_the_program_says_how_it_ended(dialect: PonderpounceDialect, success: bool | None, status: str) -> None:
    asked = dialect.read(msgpack.packb({"kind": "end", "seq": 1, "success": success, "reason": "done"}))
    assert isinstance(asked.request, Finish)
    assert (asked.request.status.name, asked.request.reason) == (status, "done")


# -- the whole way: client, websocket, gateway, clock service, both servers


class Arm:
    """A robot in this process whose servos are there at once. ``displace`` is a person's hand."""

    def __init__(self) -> None:
        self.joints = np.zeros(3, np.float32)
        self.said = "ok"
        self.sent: list[np.ndarray] = []
        self.moved: list[float] = []
        self.tick = -1

    def observe(self) -> Any:
        frame = np.full((4, 4, 3), len(self.sent) % 256, np.uint8)
        return client.Observation(self.joints.copy(), {"front": frame, "wrist": frame}, robot_state=self.said)

    def obey(self, command: Any) -> None:
        """Notes the movement per tick: a test that is late leaves ticks out."""
        assert self.said == "ok"
        self.moved.append(float(np.abs(command.values - self.joints).max()) / (command.tick - self.tick))
        self.sent.append(command.values)
        self.joints, self.tick = command.values.copy(), command.tick


@pytest.fixture
def gateway(
    bench_with: Callable[..., Any], terms_with: Callable[..., Terms], working: Any, listening: Any,
    robot_with: Callable[..., m.Robot], tmp_path: Path,
) -> Iterator[Any]:  # fmt: skip
    """A real robot's gateway at real time: its rig, its url and its folder of logs."""
    from sim_client.gateway.body import Body

    def describe(state: m.Floats, image_px: tuple[int, int]) -> m.Robot:
        size = {"image_height": image_px[0], "image_width": image_px[1]}
        return robot_with(is_simulated=False, initial_command=state.copy(), **size)

    bench = bench_with(schedules.realtime(), body=Body(3, describe), out=tmp_path, waits_for_person=True)
    bench.rig.bus.add_participant(bench.machine.tell_time)
    terms = terms_with(
        mode=m.Mode.REALTIME, cameras={"front": "front", "wrist": "wrist"}, state_key=STATE_KEY,
        robot=describe(np.zeros(3, np.float32), (1, 1)),
    )  # fmt: skip
    with (
        working(bench.machine),
        listening(WebsocketSide(bench.machine, terms, PonderpounceDialect, MAX_BYTES)) as port,
    ):
        yield bench.rig, f"ws://127.0.0.1:{port}", tmp_path


def until(asked: Any, arm: Arm, level: str, longest: int = 100) -> Any:
    """Steps until the schedule is on this rung."""
    for _ in range(longest):
        command = asked.step(arm.observe())
        if arm.said == "ok" and command.level not in ("STOPPED", "DECELERATE"):
            arm.obey(command)
        if command.level == level:
            return command
    pytest.fail(f"no {level} within {longest} ticks")


@pytest.mark.realtime
def test_every_tick_is_told_once_with_a_deadline_of_this_clock(gateway: Any) -> None:
    _, url, _ = gateway
    arm = Arm()
    with client.Client(url) as asked:
        asked.begin(arm.observe(), "lift")
        commands = [asked.step(arm.observe())]
        for _ in range(12):
            arm.obey(commands[-1])
            commands.append(asked.step(arm.observe()))
            assert commands[-1].deadline_ns <= time.monotonic_ns() <= commands[-1].expires_ns + 1_000_000_000
        asked.end(success=True)
    ticks = [command.tick for command in commands]
    assert ticks[0] == 0
    assert all(later > earlier for earlier, later in pairwise(ticks))
    periods = {(b.deadline_ns - a.deadline_ns) / (b.tick - a.tick) for a, b in pairwise(commands[6:])}
    assert all(abs(period - 50e6) < 20e6 for period in periods)
    assert {command.level for command in commands} == {"PLAY"}


@pytest.mark.realtime
def test_stop_displace_release_engage_and_no_step_is_above_the_limit(
    gateway: Any, robot_with: Callable[..., m.Robot], tmp_path: Path
) -> None:
    """The arm is where a person left it, and nothing snaps back."""
    rig, url, out = gateway
    arm, limit = Arm(), float(robot_with().max_step[0]) + 1e-6
    with client.Client(url) as asked:
        asked.begin(arm.observe(), "lift")
        until(asked, arm, "PLAY")
        for _ in range(5):
            until(asked, arm, "PLAY")
        arm.said = "user_stop"
        until(asked, arm, "STOPPED")
        arm.joints = arm.joints + np.float32(0.5)
        left_at = arm.joints.copy()
        assert rig.clock.conductor.engage(0) != ""  # refused while the robot is stopped
        until(asked, arm, "STOPPED")
        arm.said = "ok"
        for _ in range(3):
            until(asked, arm, "STOPPED")
        assert (arm.joints == left_at).all()
        engage(rig)
        until(asked, arm, "PLAY")
        for _ in range(15):
            until(asked, arm, "PLAY")
        asked.end()
    assert len(arm.moved) > 15
    assert max(arm.moved) <= limit
    (path,) = out.rglob("*.mcap")
    record = read_log(path)
    assert next(disagreements(record), None) is None
    assert {tick.robot_state for tick in record.ticks} == {m.RobotState.OK, m.RobotState.USER_STOP}


def engage(rig: Any) -> None:
    """A person's ``pp-engage``."""
    until_s = time.monotonic() + 5
    while why_not := rig.clock._on_engage(m.EngageRequest(operator="test")).error:
        assert time.monotonic() < until_s, why_not
        time.sleep(0.01)  # another thread's clock: there is nothing to wait on


@pytest.mark.realtime
def test_half_the_speed_is_half_the_step_and_a_dry_run_is_named_in_the_log(
    gateway: Any, robot_with: Callable[..., m.Robot]
) -> None:
    _, url, out = gateway
    arm = Arm()
    with client.Client(url) as asked:
        asked.begin(arm.observe(), "lift", speed=0.5, dry_run=True)
        for _ in range(3):
            asked.step(arm.observe())
        asked.end()
    (path,) = out.rglob("*.mcap")
    record = read_log(path)
    assert record.info.robot.max_step.tolist() == pytest.approx((robot_with().max_step / 2).tolist())
    assert not record.info.robot.max_lead.any()
    assert "dry_run" in {event.name for event in record.events}
    assert next(disagreements(record), None) is None


@pytest.mark.realtime
def test_a_refusal_is_raised_and_the_next_observation_is_taken(gateway: Any) -> None:
    _, url, _ = gateway
    arm = Arm()
    with client.Client(url) as asked:
        with pytest.raises(client.Refused, match="no episode is open"):
            asked.step(arm.observe())
        asked.begin(arm.observe(), "lift")
        with pytest.raises(client.Refused, match="which arm cannot measure"):
            asked.step(replace(arm.observe(), state=[99, 0, 0]))
        assert asked.step(arm.observe()).tick == 0


def test_nobody_there_is_lost() -> None:
    with pytest.raises(client.Lost, match="expected pp-gateway --dialect ponderpounce"):
        client.Client("ws://127.0.0.1:9", patience_s=1.0)
