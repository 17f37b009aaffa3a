"""A robot of LeRobot's base class under our clock, by its own program and by the strategy. `make peers` runs this.

LEROBOT_PYTHON: a Python that has lerobot 0.6, msgpack and websockets (Makefile).
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from protocol.mcap_log import read_log
from sim_client.gateway.body import PANDA
from sim_client.launch import free_ports

pytestmark = [pytest.mark.peers, pytest.mark.e2e]

ROOT = Path(__file__).parents[2]
INTEGRATIONS = ROOT / "integrations"
BESIDE = [
    *(str(INTEGRATIONS / name) for name in ("ponderpounce_client", "lerobot_strategy_ponderpounce")),
    str(ROOT / "tests" / "peers"),
]
PATIENCE_S = 400.0  # to import LeRobot takes a busy machine minutes
REACTION_S = 2.0
"""A command expires 150 ms after its deadline; the rest is for machines with other work."""


def eventually(what: Callable[[], Any], why: Callable[[], str], longest_s: float = PATIENCE_S) -> Any:
    """Waits for another process."""
    until_s = time.monotonic() + longest_s
    while not (found := what()):
        assert time.monotonic() < until_s, why()
        time.sleep(0.02)
    return found


def robot_file() -> str:
    """The Panda of example 04's policy, its joints by LeRobot's names; the fake has degrees and -100 to 100."""
    panda = PANDA.example()
    lines = [
        'name = "fake"', "control_hz = 20", "is_simulated = true", 'cameras = ["front", "wrist"]', "num_proprio = 8",
        f"state_low = {[-4.0] * 8}", f"state_high = {[4.0] * 8}", "max_picture_age_ms = 400",
    ]  # fmt: skip
    limits = zip(panda.command_low.tolist(), panda.command_high.tolist(), panda.max_step.tolist(), strict=True)
    for place, (low, high, step) in enumerate(limits):
        is_gripper = place == 7
        lines += [
            "[[dimension]]", f"state = {place}", f"low = {low}", f"high = {high}", f"step = {step}",
            f'name = "{"gripper" if is_gripper else f"joint_{place + 1}"}"',
            'kind = "gripper"\nunit = "1"' if is_gripper else 'kind = "position"\nat_stop = "hold"\nunit = "rad"',
        ]  # fmt: skip
    return "\n".join(lines)


class Bench:
    """POUNCE of example 04, a clock service and a gateway; ``start`` and ``program``: under LeRobot's Python."""

    def __init__(self, folder: Path) -> None:
        self.out, self.python = folder, os.environ.get("LEROBOT_PYTHON", "")
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        (self.out / "robot.toml").write_text(robot_file())
        at_pounce, at_clock = (f"tcp/127.0.0.1:{port}" for port in free_ports(2))
        self.address = f"127.0.0.1:{free_ports(1)[0]}"
        ours = [sys.executable]
        self._start("pounce", [*ours, str(ROOT / "examples" / "04_your_own_policy.py"), "--serve", at_pounce])
        self.clock = self._start(
            "clock", [*ours, "-m", "clock", "--link.listen", at_clock, "--link.connect", at_pounce, "--allow-starved"]
        )
        self.engaging = [*ours, "-m", "clock.engage", "--link.connect", at_clock]
        self.gateway = self._start(
            "gateway",
            [*ours, "-m", "sim_client.gateway", "--dialect", "ponderpounce", "--ponder", "none",
             "--out", str(self.out), "--robot-file", str(self.out / "robot.toml"), "--listen", self.address,
             "--link.connect", at_clock, at_pounce],
        )  # fmt: skip
        eventually(lambda: " ready " in self.said("gateway"), lambda: self.said("gateway"))

    def _start(self, name: str, command: list[str], path: str = str(ROOT)) -> subprocess.Popen[bytes]:
        environment = os.environ | {"PYTHONPATH": path, "PYTHONUNBUFFERED": "1", "HF_HUB_OFFLINE": "1"}
        with (self.out / f"{name}.txt").open("wb") as file:
            self._processes.append(
                subprocess.Popen(command, stdout=file, stderr=file, stdin=subprocess.DEVNULL, env=environment)
            )
        return self._processes[-1]

    def said(self, name: str) -> str:
        return (self.out / f"{name}.txt").read_text()

    def theirs(self, folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
        """Something under LeRobot's Python; ``folder`` is the fake robot's."""
        self.robot, self._arguments = folder, arguments
        path = os.pathsep.join(filter(None, [*BESIDE, os.environ.get("LEROBOT_EXTRA", "")]))
        return self._start("program", [self.python, *arguments], path)

    def program(self, folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
        """The robot's own program."""
        robot = {"type": "fake", "discover_packages_path": "lerobot_robot_fake", "folder": folder}
        of_robot = [f"--robot.{name}={value}" for name, value in robot.items()]
        command = ["-m", "lerobot_strategy_ponderpounce", "--url", f"ws://{self.address}", "--instruction", "wave"]
        return self.theirs(folder, *command, *of_robot, *arguments)

    def sent(self) -> list[Any]:
        """Instants in ns with a command by key, or what was told else."""
        file = self.robot / "sent.jsonl"
        return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []

    def moving(self, more: int = 30) -> subprocess.Popen[bytes]:
        """Waits for more commands; returns the program that sends them.

        A machine with other work trips the watchdog, and a person engages again; or the gateway ends the episode, as
        it has no command for half a second, and the program begins another one.
        """
        before = seen = len(self.sent())
        at_s = time.monotonic()

        def has_moved() -> bool:
            nonlocal seen, at_s
            if self._processes[-1].poll() is not None:
                assert "no command for" in self.said("program"), self.said("program")
                self.theirs(self.robot, *self._arguments)
            now = len(self.sent())
            if now > seen:
                seen, at_s = now, time.monotonic()
            elif seen and time.monotonic() - at_s > 5:
                self.engage()
                at_s = time.monotonic()
            return now >= before + more

        eventually(has_moved, lambda: self.said("program"))
        return self._processes[-1]

    def holds(self, then_ns: int) -> None:
        """After the reaction to what happened at an instant there is one target and no other, and torque."""
        time.sleep(REACTION_S + 1.0)  # nothing comes: there is nothing to wait on
        late = [what for at_ns, what in self.sent() if at_ns > then_ns + REACTION_S * 1e9]
        assert "torque off" not in late
        assert len({str(what) for what in late if what != "left"}) <= 1, late

    def engage(self) -> None:
        """A person's ``pp-engage``; refused as long as nothing is stopped."""
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        subprocess.run(self.engaging, check=False, capture_output=True, env=environment)

    def log(self, over: int) -> Any:
        """The newest log, as soon as so many episodes are over; it agrees with the schedule."""
        eventually(lambda: self.said("gateway").count(" over ") >= over, lambda: self.said("gateway"))
        found = read_log(max(self.out.rglob("*.mcap"), key=lambda path: path.stat().st_mtime_ns))
        assert next(disagreements(found), None) is None
        return found

    def close(self) -> None:
        for process in reversed(self._processes):
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
                process.wait(30)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    made = Bench(tmp_path_factory.mktemp("bench"))
    if not made.python:
        pytest.skip("LEROBOT_PYTHON is not set; make peers sets it")
    try:
        made.start()
        yield made
    finally:
        made.close()


def played(bench: Bench, log: Any) -> None:
    """The driver got commands of the log, in its own units, and moved by them."""
    rows = [list(row.values()) for _, row in bench.sent() if isinstance(row, dict)]
    told = {tuple(np.round(action.values * ([180 / np.pi] * 7 + [100]), 2)) for action in log.actions}
    strangers = [row for row in np.round(rows, 2) if tuple(row) not in told]
    assert len(rows) >= 30
    assert len(strangers) <= len(rows) / 10  # a tick that was left out is made up for in two steps
    assert np.ptp([row[0] for row in rows]) > 1  # degrees


def test_a_driver_is_refused_read_and_left_as_it_is_written(bench: Bench, tmp_path: Path) -> None:
    process = bench.theirs(tmp_path, str(ROOT / "tests" / "peers" / "lerobot_strategy.py"), "driver", str(tmp_path))
    assert process.wait(PATIENCE_S) == 0, bench.said("program")
    told = json.loads(bench.said("program").splitlines()[-1])
    assert not told["has_registry"]  # 0.6.1 creates its own strategies and no other
    refused = told["refused"]
    assert [name for name, why in refused.items() if why == "taken"] == ["said", "5.0"]
    expected = {
        "silent": "--holds-position", "nan": "floats above 0, came nan", "5": "came 5", "name": "expected elbow.pos",
        "velocity": "came velocities: joint_1", "place": "came [None, 1", "unit": "joint_1: fake has",
        "percent": "came 'rad'", "degrees": "came '%'", "camera": "came front, wrist; see --camera",
    }  # fmt: skip
    assert {name: said for name, said in expected.items() if said not in refused[name]} == {}
    assert told["state"] == pytest.approx([0, np.pi / 8, 0, -0.625 * np.pi, 0, 0.75 * np.pi, np.pi / 4, 1])
    assert told["images"] == {"front": [256, 256, 3], "wrist": [256, 256, 3]}
    assert (told["expired"], told["obeyed"]) == (0, 1)
    assert told["torque"].startswith("torque is off: joint_1")
    sentences = {"slow": "the driver hangs", "unplugged": "not connected", "refuse": "send_action: overload"}
    for fault, sentence in sentences.items():
        said, is_well_again, num_sent = told[fault]
        assert sentence in said
        assert (is_well_again, num_sent) == (True, 0)
    assert told["waited_s"] < 1  # twenty ticks beside a driver that hangs for ever
    assert (told["left"], told["released"]) == ("left", "torque off")


def test_an_episode_plays_and_the_arm_holds_when_its_program_freezes_or_dies(bench: Bench, tmp_path: Path) -> None:
    bench.program(tmp_path, "--yes")
    program = bench.moving()
    then_ns = time.monotonic_ns()
    program.send_signal(signal.SIGSTOP)
    bench.holds(then_ns)
    program.send_signal(signal.SIGCONT)  # the command in its hand is old now, and its watchdog has fired
    bench.holds(then_ns)
    program = bench.moving()
    then_ns = time.monotonic_ns()
    program.kill()
    bench.holds(then_ns)
    assert {what for _, what in bench.sent() if isinstance(what, str)} <= {"left"}
    played(bench, bench.log(1))


def test_the_strategy_plays_in_a_registry_of_the_public_shape(bench: Bench, tmp_path: Path) -> None:
    script, over = str(ROOT / "tests" / "peers" / "lerobot_strategy.py"), bench.said("gateway").count(" over ")
    bench.theirs(tmp_path, script, "strategy", str(tmp_path), f"ws://{bench.address}")
    process = bench.moving()
    (tmp_path / "end").touch()
    assert process.wait(PATIENCE_S) == 0, bench.said("program")
    assert json.loads(bench.said("program").splitlines()[-1]) == {"is_connected": False}
    assert {what for _, what in bench.sent() if isinstance(what, str)} == {"left"}  # not driven home, and torque stays
    played(bench, bench.log(over + 1))


@pytest.mark.parametrize("sign", [signal.SIGSTOP, signal.SIGKILL], ids=["frozen", "killed"])
def test_our_gateway_may_freeze_or_die(bench: Bench, tmp_path: Path, sign: signal.Signals) -> None:
    """The last tests: the gateway is gone then."""
    over = bench.said("gateway").count(" over ")
    bench.program(tmp_path, "--yes")
    program = bench.moving()
    then_ns = time.monotonic_ns()
    bench.gateway.send_signal(sign)
    bench.holds(then_ns)
    assert program.wait(PATIENCE_S) == 1
    assert {what for _, what in bench.sent() if isinstance(what, str)} <= {"left"}
    if sign == signal.SIGSTOP:
        bench.gateway.send_signal(signal.SIGCONT)
        bench.log(over + 1)
