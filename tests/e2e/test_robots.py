"""Three robots in real time through the gateway, by their own program: whatever process is killed or frozen, each ends
as its file says, and the log says the same."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import ponderpounce_client as client
import pytest

from clock.check import disagreements
from clock.dimensions import dimensions_of
from clock.obeyed import Obeyed
from protocol import messages as m
from protocol.mcap_log import read_log
from protocol.sockets import endpoint
from sim_client.robot_file import RobotFile, read_robot

pytestmark = [pytest.mark.e2e, pytest.mark.realtime, pytest.mark.peers]

FOLDER = Path(__file__).parents[2] / "examples/robots"
NAMES = ("six_axes", "two_arms", "arm_on_base")
PATIENCE_S = 120.0
PLAYED, AFTER_S = 20, 3.0

POLICY = """
import sys
from pathlib import Path
import numpy as np
from clock.dimensions import dimensions_of
from pounce_server.contract import EngineSpec, no_progress
from pounce_server.serve import PounceServer
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.options import LinkOptions
from protocol.process import StopFlag, host_clock_id, run
from protocol.zenoh_bus import open_bus
from sim_client.robot_file import read_robot

robot = read_robot(Path(sys.argv[1])).robot
dims = dimensions_of(robot)

class Policy:
    spec = EngineSpec(
        horizon=16, control_hz=robot.control_hz, action_dim=robot.action_dim, proprio_dim=robot.num_proprio,
        num_carriers=0, cognition_size=0, image_px=32, num_steps=1, num_cameras=len(robot.cameras),
        model_hash="rows", is_random=False, has_fresh_prefix=False, dtype="float32",
    )

    def invoke(self, request, progress=no_progress):
        row = np.zeros(robot.action_dim, np.float32)
        row[dims.measured] = request.proprio[dims.state_index]
        row[dims.deltas] = 0.001
        row[dims.velocities] = robot.command_high[dims.velocities]
        progress()
        return np.tile(row, (16, 1))

    def warm_up(self):
        return [1_000_000] * 20

stop, bus = StopFlag(), open_bus(LinkOptions(listen=(sys.argv[2],)))
link = Link(bus, robot="r0", proc="pounce")
server = PounceServer(link, Policy(), Heartbeat(link, "test", host_clock_id()), "test")
server.warm_up()
server.ready()
run(bus, server.step, stop)
bus.close()
"""


@dataclass
class Cell:
    """One robot and its three processes; ``drive`` is the robot's own program."""

    file: RobotFile
    processes: dict[str, subprocess.Popen[bytes]]
    url: str
    out: Path
    commands: list[client.Command] = field(default_factory=list)

    def drive(self, until_s: float = PATIENCE_S, num_played: int | None = None) -> str:
        """Steps for a time, or until rows were played; the robot is where it was commanded. Returns why it ended."""
        robot, end_s = self.robot, time.monotonic() + until_s
        dims, played = dimensions_of(robot), 0
        while time.monotonic() < end_s and (num_played is None or played < num_played):
            if self.commands:
                self.state[dims.state_index] = self.commands[-1].values[dims.measured]
            try:
                command = self.client.step(self.seen())
            except (client.Lost, client.Refused) as error:
                return str(error)
            self.commands.append(command)
            played += command.is_playing
        return ""

    def begin(self) -> None:
        low, high = self.file.robot.state_low, self.file.robot.state_high
        self.state = ((low + high) / 2).astype(np.float32)
        self.robot = self.file.describe(self.state, (32, 32))
        self.rng = np.random.default_rng(0)
        end_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                self.client = client.Client(self.url)
                break
            except client.Lost:
                assert time.monotonic() < end_s, "the gateway does not listen"
                time.sleep(0.2)
        self.client.begin(self.seen(), "go on")

    def seen(self) -> client.Observation:
        pictures = {name: self.rng.integers(0, 256, (32, 32, 3), np.uint8) for name in self.file.robot.cameras}
        return client.Observation(self.state.copy(), pictures)


@pytest.fixture
def cell(name: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    sockets = tmp_path_factory.mktemp("s")
    at_clock, at_pounce = (endpoint(proc, sockets) for proc in ("clock", "pounce"))
    file = FOLDER / f"{name}.toml"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    commands = {
        "pounce": ["-c", POLICY, str(file), at_pounce],
        "clock": ["-m", "clock", "--link.listen", at_clock, "--link.connect", at_pounce],
        "gateway": [
            "-m", "sim_client.gateway", "--dialect", "ponderpounce", "--ponder", "none", "--robot-file", str(file),
            "--listen", f"127.0.0.1:{port}", "--out", str(tmp_path), "--link.connect", at_clock, at_pounce,
        ],
    }  # fmt: skip
    processes = {proc: subprocess.Popen([sys.executable, *arguments]) for proc, arguments in commands.items()}
    try:
        yield Cell(read_robot(file), processes, f"ws://127.0.0.1:{port}", tmp_path)
    finally:
        for process in processes.values():
            process.kill()
            process.wait()


@pytest.mark.parametrize("sign", [signal.SIGSTOP, signal.SIGKILL], ids=["frozen", "killed"])
@pytest.mark.parametrize("proc", ["pounce", "clock", "gateway"])
@pytest.mark.parametrize("name", NAMES)
def test_whatever_process_goes_the_robot_ends_as_its_file_says(cell: Cell, proc: str, sign: signal.Signals) -> None:
    cell.begin()
    assert cell.drive(num_played=PLAYED) == ""
    before = len(cell.commands)
    os.kill(cell.processes[proc].pid, sign)
    why = cell.drive(until_s=AFTER_S)
    obeyed, dims = Obeyed(cell.robot, cell.robot.control_hz), dimensions_of(cell.robot)
    row_tick, last = -1, cell.robot.initial_command
    for each in cell.commands:
        action = m.Action(tick=each.tick, deadline_ns=0, level=m.Level[each.level], values=each.values)
        assert obeyed.why_not(action, None) == ""
        obeyed.obey(action)
        row_tick = each.tick if each.is_playing else row_tick
        if not each.is_playing:
            np.testing.assert_array_equal(each.values[dims.is_gripper_A], last[dims.is_gripper_A])
        if each.tick - row_tick >= cell.robot.stop_ticks:
            assert not each.values[dims.velocities].any()
        last = each.values
    assert not obeyed.idle(cell.robot.stop_ticks)[dims.velocities].any(), "the robot's side, once no command comes"
    if proc == "pounce":
        assert why == ""
        assert {each.level for each in cell.commands[before:]} >= {"HOLD", "STOPPED"}
        cell.client.end()
    else:
        assert why, "the program is told, or hears nothing: its watchdog acts"
    for process in cell.processes.values():
        process.send_signal(signal.SIGCONT)
    if proc == "gateway":
        return
    log = _finished(cell.out)
    assert list(disagreements(read_log(log))) == []


def _finished(out: Path) -> Path:
    end_s = time.monotonic() + 20
    found: Any = []
    while not found and time.monotonic() < end_s:
        time.sleep(0.1)
        found = list(out.rglob("*.mcap"))
    (log,) = found
    return Path(log)
