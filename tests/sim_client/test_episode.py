"""The robot's side of an episode: what it does when commands stop, skip or come from two."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from protocol import messages as m
from protocol import topics
from sim_client.episode import RobotSide
from sim_client.recorder import Recorder
from sim_client.silence import CLOCK_SILENCE_NS, STALL_NS, Silence

MS = 1_000_000


class Robot:
    """One side of an episode, whose turns take as long as a test says."""

    def __init__(self, rig: Any, info: m.EpisodeInfo, world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock, self.robot = rig.links["clock"], rig.links["sim"]
        members = [m.Member(proc="clock", boot_id=self.clock.boot_id)]
        for link in (self.clock, self.robot):
            link.enter_episode("s1", info.header.episode, 1, members)
        self.events = rig.listener.subscribe(topics.EVENT)
        self.turns_ns: list[int] = []
        self._now_ns, self._info, self._world = 10**12, info, world
        self._recorder = Recorder(self.robot, "jpeg")
        self._recorder.begin(info, None)
        monkeypatch.setattr(time, "monotonic_ns", lambda: self._now_ns)

    def command(self, tick: int, level: m.Level = m.Level.PLAY) -> None:
        action = m.Action(tick=tick, deadline_ns=tick * 50 * MS, level=level, values=np.zeros(3, np.float32))
        self.clock.publish(topics.ACTION, action, at_ns=0)

    def run(self, turns: list[Callable[[], int]]) -> Any:
        """Plays; each turn does something and says how long it took [ns]."""
        coming = iter(turns)

        def let_others(longest_ns: int) -> None:
            self._now_ns += next(coming, lambda: 20 * MS)()

        actions = self.robot.subscribe(topics.ACTION)
        side = RobotSide(self.robot, actions, self._world, self._recorder, let_others, 10**10)
        return side.run(self._info, self._world.look(), lambda tick: None)


@pytest.fixture
def robot(rig: Any, episode_info: Any, number_world: Any, monkeypatch: pytest.MonkeyPatch) -> Robot:
    return Robot(rig, episode_info(schedules.realtime()), number_world(30), monkeypatch)


def after(robot: Robot, tick: int, took_ns: int = 20 * MS) -> Callable[[], int]:
    """A turn in which a command comes."""

    def turn() -> int:
        robot.command(tick)
        return took_ns

    return turn


def test_a_clock_that_is_silent_is_lost(robot: Robot) -> None:
    outcome = robot.run([after(robot, 0)])
    assert (outcome.status, outcome.reason, outcome.num_ticks) == (m.TaskStatus.ABORTED, "clock lost", 1)
    (event,) = robot.events.drain()
    assert event.name == "clock_lost"


def test_a_stopped_episode_ends_with_what_stopped_it(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_client.episode.STOPPED_S", 0.5)

    def error(name: str, text: str) -> int:
        event = m.Event(severity=m.Severity.ERROR, name=name, text=text, tick=0)
        robot.clock.publish(topics.EVENT, event, at_ns=0)
        return 20 * MS

    def stop(tick: int) -> int:
        robot.command(tick, m.Level.STOPPED)
        return 20 * MS

    told = [lambda: error("state_out_of_range", "state 5 is 9"), lambda: error("level", "PLAY -> HOLD")]
    outcome = robot.run([*told, *(lambda tick=tick: stop(tick) for tick in range(20))])  # type: ignore[misc]
    assert (outcome.status, outcome.num_ticks) == (m.TaskStatus.ABORTED, 11)
    assert outcome.reason == "stopped by the ladder, and nobody engaged it again; the last error: state 5 is 9"


def test_a_robot_that_stood_still_blames_nobody_else(robot: Robot) -> None:
    turns = [after(robot, 0), lambda: CLOCK_SILENCE_NS + 200 * MS, after(robot, 14)]
    outcome = robot.run(turns)
    assert outcome.num_ticks == 15
    names = [(event.name, event.severity) for event in robot.events.drain()]
    assert names[0] == ("robot_stalled", m.Severity.WARNING)


@given(steps=st.lists(st.one_of(st.none(), st.integers(0, 3 * STALL_NS)), max_size=50))
def test_silence_is_the_time_listened_to_since_a_command(steps: list[int | None]) -> None:
    """None is a command; a number is the time until the next look."""
    now_ns, silence, expected_ns = 0, Silence(0), 0
    for step in steps:
        if step is None:
            silence.heard(now_ns)
            expected_ns = 0
            continue
        now_ns += step
        assert silence.look(now_ns) == (step if step >= STALL_NS else 0)
        expected_ns += step if step < STALL_NS else 0
        assert silence.total_ns == expected_ns


def test_a_robot_whose_world_stood_still_blames_nobody_else(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was stopped within a step of the simulation, and what the clock sent meanwhile is not read yet."""
    step = robot._world.step

    def slow(*args: Any, **options: Any) -> Any:
        robot._now_ns += 2 * CLOCK_SILENCE_NS
        return step(*args, **options)

    monkeypatch.setattr(robot._world, "step", slow)
    outcome = robot.run([after(robot, 0), lambda: 20 * MS, after(robot, 14)])
    assert outcome.num_ticks == 15


def test_an_episode_that_ends_in_ticks_that_the_clock_skipped_is_over_there(robot: Robot) -> None:
    outcome = robot.run([after(robot, 0), after(robot, 60)])
    assert (outcome.status, outcome.num_ticks) == (m.TaskStatus.SUCCESS, 30)
