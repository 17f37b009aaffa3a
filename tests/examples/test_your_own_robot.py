"""The example's robot is stopped by its own watchdog, whoever of ours is killed or frozen, and nothing snaps back.

The real gateway and clock service, example 04's policy, a fake arm in a process of its own, and the example itself.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from ponderpounce_client.fake_arm import FakeArm

from clock.check import disagreements
from protocol.mcap_log import read_log
from protocol.messages import Robot
from sim_client.gateway.body import PANDA
from sim_client.launch import free_ports

pytestmark = [pytest.mark.e2e, pytest.mark.realtime, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
CLIENT_PYTHON = os.environ.get("PONDERPOUNCE_CLIENT_PYTHON", sys.executable)
"""An older Python with numpy, msgpack and websockets may run the robot's program."""
EXAMPLE = ROOT / "examples" / "06_your_own_robot.py"
PATIENCE_S = 150.0
NUM_TRIES = 5
"""A busy machine may end an episode in the middle of what a test is about."""
STEP_RAD = 2.61 / 20 + 1e-4
PATHS = (ROOT / "integrations" / "ponderpounce_client", ROOT)
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, PATHS)), "OMP_NUM_THREADS": "1"}


def eventually(what: Callable[[], Any], why: Callable[[], str]) -> Any:
    """Waits for another process."""
    until_s = time.monotonic() + PATIENCE_S
    while not (found := what()):
        assert time.monotonic() < until_s, why()
        time.sleep(0.02)
    return found


def described(panda: Robot) -> str:
    """The file of this robot. Simulated it is too: nobody else may be moved by the policy of example 04."""
    limits = ("command_low", "command_high", "max_step", "max_lead", "state_low", "state_high")
    lines = [f"{name} = {getattr(panda, name).tolist()}" for name in limits]
    cameras, num_proprio = list(panda.cameras), panda.num_proprio
    lines += [f"cameras = {cameras}", f"num_proprio = {num_proprio}", 'name = "arm"', "is_simulated = true"]
    return "\n".join(lines)


class Bench:
    """The arm, the gateway and the example, each a process. ``arm`` is a person's hand on the robot."""

    def __init__(self, folder: Path) -> None:
        self.out = folder
        self._files: list[Any] = []
        self._processes: list[subprocess.Popen[bytes]] = []
        self.programs: list[subprocess.Popen[bytes]] = []
        self.address, self.port = (f"127.0.0.1:{port}" for port in free_ports(2))
        self.arm = FakeArm(self.address, answer_s=5.0)

    def start(self) -> None:
        self._start("arm", "-m", "ponderpounce_client.fake_arm", self.address)
        eventually(self._answers, lambda: self.said("arm"))
        robot_file = self.out / "robot.toml"
        robot_file.write_text(described(PANDA.example()))
        at_pounce, at_clock = (f"tcp/127.0.0.1:{port}" for port in free_ports(2))
        self._start("pounce", str(ROOT / "examples" / "04_your_own_policy.py"), "--serve", at_pounce)
        self._start("clock", "-m", "clock", "--link.listen", at_clock, "--link.connect", at_pounce, "--allow-starved")
        self.engaging = ["-m", "clock.engage", "--link.connect", at_clock]
        self.gateway = self._start(
            "gateway", "-m", "sim_client.gateway", "--dialect", "ponderpounce", "--ponder", "none",
            "--out", str(self.out), "--robot-file", str(robot_file), "--listen", self.port,
            "--link.connect", at_clock, at_pounce,
        )  # fmt: skip
        eventually(lambda: " ready " in self.said("gateway"), lambda: self.said("gateway"))

    def _start(self, name: str, *arguments: str, **options: Any) -> subprocess.Popen[bytes]:
        file = (self.out / f"{name}.txt").open("wb")
        self._files.append(file)
        environment = ENVIRONMENT | {"ROBOT": self.address, "PYTHONUNBUFFERED": "1"}
        command = [CLIENT_PYTHON if name in ("program", "arm") else sys.executable, *arguments]
        self._processes.append(subprocess.Popen(command, stdout=file, stderr=file, env=environment, **options))
        return self._processes[-1]

    def _answers(self) -> bool:
        try:
            return bool(self.arm.call("read"))
        except OSError:
            return False

    def said(self, name: str) -> str:
        return (self.out / f"{name}.txt").read_text()

    def program(self, *arguments: str, **options: Any) -> subprocess.Popen[bytes]:
        self.arm.call("reset")
        self._arguments, self.found_at = arguments, self.arm.call("read")["state"][:7]
        begin = ["--url", f"ws://{self.port}", "--instruction", "pick the highlighted cube", *arguments]
        self.programs.append(self._start("program", str(EXAMPLE), *begin, **options))
        return self.programs[-1]

    def history(self) -> dict[str, Any]:
        return self.arm.call("history")

    def has_stopped(self) -> bool:
        return bool(self.arm.call("read")["says"] == "protective_stop")

    def moving(self, more: int = 10) -> subprocess.Popen[bytes]:
        """Waits for more movements; returns the program that makes them.

        On a busy machine the watchdog may stop the arm: a person releases it and engages. Or the gateway ends the
        episode, as it has no command for half a second: the program begins another one.
        """
        before = self.history()["num_moves"]

        def has_moved() -> bool:
            if self.programs[-1].poll() is not None:
                assert "no command for" in self.said("program"), self.said("program")
                self.program(*self._arguments)
            elif self.has_stopped():
                self.arm.call("reset")
                self.engage()
            return bool(self.history()["num_moves"] >= before + more)

        eventually(has_moved, lambda: f"no motion: {self.said('program')}")
        return self.programs[-1]

    def stops(self, then_ns: int) -> int:
        """Waits until the watchdog has stopped the arm; returns how often it was moved.

        A dead or frozen process leaves two commands at most, one in the program's hand and one on its way.
        """
        eventually(lambda: self.history()["stopped_ns"] > then_ns, lambda: "the arm was not stopped")
        told = self.history()
        assert sum(at_ns > then_ns for at_ns, _ in told["moves"]) <= 2
        assert told["moves"][-1][0] < told["stopped_ns"]
        return int(told["num_moves"])

    def says_more(self, what: str, times: int = 2) -> None:
        """Waits until the program has gone on for so many further lines, or has ended."""
        before, program = self.said("program").count(what), self.programs[-1]

        def has_said() -> bool:
            return program.poll() is not None or self.said("program").count(what) >= before + times

        eventually(has_said, lambda: self.said("program"))

    def engage(self) -> None:
        """A person's ``pp-engage``; refused as long as nothing is stopped."""
        subprocess.run([sys.executable, *self.engaging], env=ENVIRONMENT, check=False, capture_output=True)

    def close(self) -> None:
        for process in reversed(self._processes):
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
                process.wait(30)
            if process.stdin is not None:
                process.stdin.close()
        for file in self._files:
            file.close()
        self.arm.close()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    made = Bench(tmp_path_factory.mktemp("robot"))
    try:
        made.start()
        yield made
    finally:
        made.close()


@pytest.fixture(autouse=True)
def no_program_stays(bench: Bench) -> Iterator[None]:
    """A test that fails leaves the robot to the next one."""
    yield
    for process in bench.programs:
        process.kill()
        process.wait(10)


def test_a_dry_run_is_the_whole_loop_and_sends_nothing(bench: Bench) -> None:
    program = bench.program("--dry-run", "--at-exit", "release")
    eventually(lambda: "PLAY" in bench.said("program"), lambda: bench.said("program"))
    program.send_signal(signal.SIGINT)
    assert program.wait(PATIENCE_S) == 0, bench.said("program")
    assert bench.history()["num_moves"] == 0
    assert bench.arm.call("read")["says"] == "ok"


def test_nothing_is_sent_before_a_person_confirms_the_first_row(bench: Bench) -> None:
    program = bench.program(stdin=subprocess.PIPE)
    eventually(lambda: "Send rows to the robot?" in bench.said("program"), lambda: bench.said("program"))
    assert bench.history()["num_moves"] == 0
    program.communicate(b"n\n", timeout=PATIENCE_S)
    assert program.returncode == 1
    assert "not confirmed" in bench.said("program")
    assert bench.history()["num_moves"] == 0


def test_stop_displace_release_engage_and_the_arm_goes_on_from_there(bench: Bench) -> None:
    bench.program("--yes", "--max-s", "3600")
    program = bench.moving()
    bench.arm.call("stop", says="user_stop", text="a person")
    before = bench.history()["num_moves"]
    bench.says_more("  STOPPED  ", 1)
    bench.arm.call("displace", by=0.5)
    bench.arm.call("reset")
    bench.says_more("  STOPPED  ")
    assert bench.history()["num_moves"] == before
    bench.engage()
    program = bench.moving()
    assert max(move for _, move in bench.history()["moves"]) <= STEP_RAD
    program.send_signal(signal.SIGINT)
    assert program.wait(PATIENCE_S) == 0


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_the_watchdog_stops_the_arm_of_a_program_that_died_or_froze(bench: Bench, number: int) -> None:
    bench.program("--yes")
    program = bench.moving()
    then_ns = time.monotonic_ns()
    program.send_signal(number)
    num_moves = bench.stops(then_ns)
    bench.arm.call("reset")
    if number == signal.SIGSTOP:
        program.send_signal(signal.SIGCONT)  # the command in its hand is old now, and its watchdog has fired
        bench.says_more("  STOPPED  ")
    program.kill()
    program.wait(PATIENCE_S)
    eventually(lambda: "the client left" in bench.said("gateway"), lambda: bench.said("gateway"))
    assert bench.history()["num_moves"] == num_moves


def test_a_gateway_that_stands_still_stops_the_arm_and_ends_nothing(bench: Bench) -> None:
    """What a busy machine does. A person releases the arm and engages, and the same program goes on."""
    bench.program("--yes")
    for _ in range(NUM_TRIES):
        program = bench.moving()
        then_ns = time.monotonic_ns()
        bench.gateway.send_signal(signal.SIGSTOP)
        num_moves = bench.stops(then_ns)
        bench.gateway.send_signal(signal.SIGCONT)
        bench.arm.call("reset")
        bench.says_more("  STOPPED  ")
        assert bench.history()["num_moves"] == num_moves
        bench.engage()
        if bench.moving() is program:
            break
    else:
        pytest.fail(bench.said("program"))
    program.send_signal(signal.SIGINT)
    assert program.wait(PATIENCE_S) == 0, bench.said("program")


def test_parking_goes_back_in_steps(bench: Bench) -> None:
    """An arm that its watchdog stopped is not parked."""
    for _ in range(NUM_TRIES):
        bench.program("--yes", "--at-exit", "park", "--speed", "0.5")
        program = bench.moving(30)
        program.send_signal(signal.SIGINT)
        program.wait(PATIENCE_S)
        told = bench.history()
        if program.returncode == 0 and not bench.has_stopped():
            break
        assert told["moves"][-1][0] < told["stopped_ns"]
    else:
        pytest.fail(bench.said("program"))
    assert bench.arm.call("read")["state"][:7] == pytest.approx(bench.found_at, abs=1e-3)
    assert max(move for _, move in told["moves"][-20:]) <= STEP_RAD / 2 + 1e-4


def test_every_log_agrees_with_the_schedule(bench: Bench) -> None:
    eventually(lambda: bench.said("gateway").count(" over ") >= 7, lambda: bench.said("gateway"))
    paths = sorted(bench.out.rglob("*.mcap"))
    assert len(paths) >= 7
    assert [(path, found) for path in paths if (found := next(disagreements(read_log(path)), None)) is not None] == []


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_the_watchdog_stops_the_arm_when_our_gateway_dies_or_freezes(bench: Bench, number: int) -> None:
    """The last tests: the gateway is gone then."""
    bench.program("--yes", "--at-exit", "park")
    program, over = bench.moving(), bench.said("gateway").count(" over ")
    then_ns = time.monotonic_ns()
    bench.gateway.send_signal(number)
    num_moves = bench.stops(then_ns)
    assert program.wait(PATIENCE_S) == 1
    assert re.search("no answer within|left", bench.said("program"))
    assert bench.has_stopped()  # and it was not parked
    assert bench.history()["num_moves"] == num_moves
    if number == signal.SIGSTOP:
        bench.gateway.send_signal(signal.SIGCONT)
        eventually(lambda: bench.said("gateway").count(" over ") > over, lambda: bench.said("gateway"))
