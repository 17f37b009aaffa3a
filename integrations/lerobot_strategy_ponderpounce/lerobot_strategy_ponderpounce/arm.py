"""A LeRobot robot as ``ponderpounce_client.drive`` wants one.

One thread alone calls its driver: a tick never waits for a bus or a camera, and a slow driver makes old readings.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from lerobot.motors.motors_bus import SerialMotorsBus
from lerobot.robots import Robot
from ponderpounce_client import Observation

from lerobot_strategy_ponderpounce.joints import check_driver, joints_of, parts_of

STALL_NS = 500_000_000
"""A driver that gave no reading for so long is a fault."""
_FIRST_S = 15.0
_TORQUE_NS = 1_000_000_000
_CLIPPED = 1e-3


class Arm:
    """Satisfies ``ponderpounce_client.Robot``.

    Args:
        robot: is connected unless it is already, and never calibrated. It leaves torque on when it disconnects.
        welcome: the gateway's.
        cameras: ``ponderpounce_client`` cameras by name, in the place of the robot's own.
        holds_position: as ``check_driver``.

    Raises:
        ValueError: the robot is not the one of the gateway's robot file, or cannot be driven safely.
        OSError: it cannot be reached, or gives no reading.
    """

    def __init__(
        self,
        robot: Robot,
        welcome: Mapping[str, Any],
        cameras: Mapping[str, Any],
        *,
        holds_position: bool,
        say: Callable[[str], None],
    ) -> None:
        check_driver(robot, holds_position)
        self._robot, self._say = robot, say
        self._joints = joints_of(robot, welcome["robot"])
        self._cameras, self._pictures = _cameras(robot, welcome["cameras"], cameras, say)
        self._lock, self._wake, self._is_closed = threading.Lock(), threading.Event(), False
        self._seen: Observation | None = None
        self._fault = self._trouble = ""
        self._command: tuple[np.ndarray, int] | None = None
        self._torque_ns, self._torque_off, self._has_clipped = 0, "", False
        self._has_read = threading.Event()
        self._pause_s = 0.5 / welcome["control_hz"]
        self._keep_torque(True)  # before all: LeRobot disconnects a robot that is thrown away
        if not robot.is_connected:
            robot.connect(calibrate=False)
        if not robot.is_calibrated:
            raise ValueError(f"{robot.name} {robot.id}: expected a calibrated robot; run lerobot-calibrate")
        self._thread = threading.Thread(target=self._run, name="driver", daemon=True)
        self._thread.start()
        if not self._has_read.wait(_FIRST_S):
            self.close()
            raise OSError(f"{robot.name}: no reading within {_FIRST_S:g} s; {self._trouble or 'the driver hangs'}")

    def observe(self) -> Observation:
        """The newest reading; its instants are of the beginning of the read, or the camera's own."""
        with self._lock:
            seen, fault, self._fault = self._seen, self._fault, ""
            if fault:
                self._command = None
        assert seen is not None
        since_ns = time.monotonic_ns() - seen.state_ns
        if not fault and since_ns > STALL_NS:
            fault = f"no reading for {since_ns / 1e9:.1f} s; {self._trouble or 'the driver hangs'}"
        images, captured_ns = dict(seen.images), dict(seen.captured_ns)
        for name, camera in self._cameras.items():
            images[name], captured_ns[name] = camera.read()
        state = "fault" if fault else "torque_off" if self._torque_off else "ok"
        return Observation(seen.state, images, seen.state_ns, captured_ns, state, fault or self._torque_off)

    def obey(self, values: np.ndarray, expires_ns: int) -> None:
        """Hands the command to the driver's thread; one that is older, or expires before its turn, is not sent."""
        with self._lock:
            self._command = (values, expires_ns)
        self._wake.set()

    def release(self) -> None:
        """Torque off, as LeRobot disconnects the robot."""
        self.close()
        self._keep_torque(False)
        self._robot.disconnect()

    def close(self) -> None:
        """The driver is called no more; its servos hold the last target."""
        self._is_closed = True
        self._wake.set()
        self._thread.join(2)

    def _run(self) -> None:
        while not self._is_closed:
            self._wake.wait(self._pause_s)
            self._wake.clear()
            self._send()
            self._read()

    def _send(self) -> None:
        with self._lock:
            command, self._command = self._command, None
        if command is None or self._fault or self._is_closed or time.monotonic_ns() > command[1]:
            return
        pairs = zip(self._joints, command[0].tolist(), strict=True)
        wanted = {joint.key: value * joint.factor for joint, value in pairs}
        try:
            applied = self._robot.send_action(dict(wanted))
        except Exception as error:  # a driver may raise anything; nothing is sent until a person engages
            self._fault = f"send_action: {error or type(error).__name__}"
            return
        clipped = [key for key, value in wanted.items() if abs(applied.get(key, value) - value) > _CLIPPED]
        if clipped and not self._has_clipped:
            self._has_clipped = True
            self._say(f"the driver clips commands: {', '.join(clipped)}; the schedule does not know of it")

    def _read(self) -> None:
        robot, begun_ns = self._robot, time.monotonic_ns()
        captured_ns = {name: _captured_ns(robot, name, begun_ns) for name in self._pictures}
        try:
            told = robot.get_observation()
            state = np.zeros(len(self._joints))
            for joint in self._joints:
                state[joint.place] = told[joint.key] / joint.factor
            if begun_ns - self._torque_ns > _TORQUE_NS:
                self._torque_ns, self._torque_off = begun_ns, _without_torque(robot)
            images = {name: np.ascontiguousarray(told[name]) for name in self._pictures}
        except Exception as error:  # a lost packet is no fault; STALL_NS of them are
            self._trouble = f"get_observation: {error or type(error).__name__}"
            if not robot.is_connected:
                self._fault = f"not connected; {self._trouble}"
            return
        with self._lock:
            self._seen, self._trouble = Observation(state, images, begun_ns, captured_ns), ""
        self._has_read.set()

    def _keep_torque(self, is_kept: bool) -> None:
        for part in parts_of(self._robot):
            config = getattr(part, "config", None)
            if hasattr(config, "disable_torque_on_disconnect"):
                config.disable_torque_on_disconnect = not is_kept


def _cameras(
    robot: Robot, wanted: list[str], given: Mapping[str, Any], say: Callable[[str], None]
) -> tuple[dict[str, Any], list[str]]:
    """Cameras of ours, and names of the robot's own. Raises ValueError if one is missing, or is not RGB."""
    theirs = {key for key, feature in robot.observation_features.items() if isinstance(feature, tuple)}
    if set(wanted) - theirs - given.keys():
        came = ", ".join(sorted(theirs | given.keys())) or "none"
        raise ValueError(f"{robot.name}: expected cameras {', '.join(wanted)}, came {came}; see --camera")
    if unseen := sorted((theirs | given.keys()) - set(wanted)):
        say(f"cameras that the gateway does not ask for: {', '.join(unseen)}")
    own = [name for name in wanted if name not in given]
    for name in own:
        mode = getattr(getattr(robot, "cameras", {}).get(name), "color_mode", None)
        if mode is not None and str(getattr(mode, "value", mode)) != "rgb":
            raise ValueError(f"{robot.name}: camera {name}: expected color_mode rgb, came {mode}")
    return {name: given[name] for name in wanted if name in given}, own


def _captured_ns(robot: Robot, name: str, begun_ns: int) -> int:
    """When the picture that a read gives was taken, at the earliest; drivers say it on perf_counter."""
    taken_s = getattr(getattr(robot, "cameras", {}).get(name), "latest_timestamp", None)
    return begun_ns if taken_s is None else begun_ns - int((time.perf_counter() - taken_s) * 1e9)


def _without_torque(robot: Robot) -> str:
    """The motors whose torque is off, as far as the bus can be asked."""
    buses = [each.bus for each in parts_of(robot) if isinstance(getattr(each, "bus", None), SerialMotorsBus)]
    told = [bus.sync_read("Torque_Enable", normalize=False) for bus in buses if bus.is_connected]
    off = [str(motor) for each in told for motor, value in each.items() if not value]
    return f"torque is off: {', '.join(off)}" if off else ""
