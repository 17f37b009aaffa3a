"""The whole of a robot's program: observe, obey, and leave the robot safe.

It is not a safety function: the vendor's emergency stop, limits and safety planes stay on.
"""

from __future__ import annotations

import argparse
import dataclasses
import signal
import sys
import time
from pathlib import Path
from typing import Any, Callable, Protocol

import numpy as np

from ponderpounce_client.client import Client, Command, Lost, Observation, Refused
from ponderpounce_client.watchdog import Watchdog

AT_EXIT = ("hold", "park", "release")
_SAY_TICKS = 20


class Robot(Protocol):
    """What ``drive`` wants of a driver. No call may block for longer than a tick."""

    def observe(self) -> Observation:
        """What is measured now, and what the robot says of itself."""

    def obey(self, values: np.ndarray, expires_ns: int) -> None:
        """Sends a command to the servos. A controller with a watchdog is given ``expires_ns`` as well."""

    def release(self) -> None:
        """Takes the servos' torque off, for --at-exit release."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """How an episode is run.

    ``speed``: share of the robot's step limits, 0.1 to 1. ``is_dry``: the whole loop, and nothing is sent to the robot.
    ``is_confirmed``: nobody is asked before the first row. ``at_exit``: hold, park or release.
    ``max_s``: the longest time; None: until somebody stops it.
    """

    instruction: str
    task: str = ""
    speed: float = 1.0
    is_dry: bool = False
    is_confirmed: bool = False
    at_exit: str = "hold"
    max_s: float | None = None


def drive(
    robot: Robot,
    client: Client,
    settings: Settings,
    watchdog: Watchdog,
    ask: Callable[[str], str] = input,
    say: Callable[[str], None] = print,
) -> str:
    """Runs one episode until a person or the gateway ends it; returns why it ended unasked, or "".

    Before the first row a dry episode is played up to its first row, which a person sees and confirms.
    """
    return _Drive(robot, client, settings, watchdog, say).run(ask)


class _Drive:
    """One episode. ``_sent`` is the newest command that was sent without an interruption since."""

    def __init__(
        self, robot: Robot, client: Client, settings: Settings, watchdog: Watchdog, say: Callable[[str], None]
    ) -> None:
        self._robot, self._client, self._settings = robot, client, settings
        self._watchdog, self._say = watchdog, say
        self._sent: np.ndarray | None = None
        self._trouble: tuple[str, str] | None = None
        self._start: Any = None
        step = np.asarray(client.welcome["robot"]["max_step"], np.float32) * np.float32(settings.speed)
        self._step = np.where(step > 0, step, np.float32(np.inf))

    def run(self, ask: Callable[[str], str]) -> str:
        settings, client = self._settings, self._client
        first = self._robot.observe()
        if first.robot_state != "ok":
            return f"the robot says {first.robot_state} {first.robot_text}: nothing was begun"
        self._start = np.asarray(first.state, np.float32).ravel()
        try:
            if not (settings.is_dry or settings.is_confirmed) and not self._is_confirmed(first, ask):
                return "not confirmed: nothing was sent"
            client.begin(
                self._robot.observe(), settings.instruction,
                task=settings.task, speed=settings.speed, dry_run=settings.is_dry,
            )  # fmt: skip
            self._obey()
            client.end(reason="the robot's program ended it")
        except KeyboardInterrupt:
            self._say("interrupted")
        except (Lost, Refused) as error:
            self._leave(is_orderly=False)
            return str(error)
        self._leave(is_orderly=True)
        return ""

    def _is_confirmed(self, first: Observation, ask: Callable[[str], str]) -> bool:
        """A dry episode up to its first row, which a person sees."""
        settings, client = self._settings, self._client
        client.begin(first, settings.instruction, task=settings.task, speed=settings.speed, dry_run=True)
        command, seen = self._first_row()
        client.end(reason="the first row was shown")
        num = min(len(command.values), len(self._start))
        away = np.abs(command.values[:num] - np.asarray(seen.state, np.float32).ravel()[:num])
        name = client.welcome["robot"]["name"]
        self._say(f"robot {name}  {settings.instruction!r}  speed {settings.speed:g}  at exit {settings.at_exit}")
        self._say(f"measured  {_row(seen.state)}")
        self._say(f"first row {_row(command.values)}")
        self._say(f"farthest from the measured joints: {away.max():.3f} in dimension {int(away.argmax())}")
        try:
            return ask("Send rows to the robot? [y/N] ").strip().lower() in ("y", "yes")
        except EOFError:
            self._say("nobody is there to ask; --yes sends rows unasked")
            return False

    def _first_row(self) -> tuple[Command, Observation]:
        while True:
            seen = self._robot.observe()
            command = self._client.step(seen)
            if command.is_playing:
                return command, seen

    def _obey(self) -> None:
        until_s = time.monotonic() + self._settings.max_s if self._settings.max_s is not None else None
        say_at = 0
        while until_s is None or time.monotonic() < until_s:
            seen = self._seen()
            command = self._client.step(seen)
            if command.tick >= say_at:
                say_at = command.tick + _SAY_TICKS
                self._say(f"tick {command.tick:6d}  {command.level:<10}  {_row(command.values)}")
            if self._trouble is not None:
                self._interrupt(command, seen)
            elif self._sent is not None or command.level not in ("STOPPED", "DECELERATE"):
                self._send(command)

    def _seen(self) -> Observation:
        """What is measured, with the trouble that the schedule does not know of yet."""
        seen = self._robot.observe()
        if seen.robot_state != "ok":
            self._trouble = (seen.robot_state, seen.robot_text)
        elif self._watchdog.has_fired and self._trouble is None:
            self._trouble = ("protective_stop", "the watchdog stopped the robot: no command came in time")
        if self._trouble is None:
            return seen
        return dataclasses.replace(seen, robot_state=self._trouble[0], robot_text=self._trouble[1])

    def _interrupt(self, command: Command, seen: Observation) -> None:
        """Nothing is sent until the schedule has stopped as well, and a person has engaged it again."""
        if self._sent is not None:
            self._say(f"stopped: {seen.robot_state} {seen.robot_text}. Release the robot, then pp-engage.")
        self._sent = None
        self._watchdog.rest()
        if command.level == "STOPPED" and self._robot.observe().robot_state == "ok":
            self._trouble = None

    def _send(self, command: Command) -> None:
        if self._settings.is_dry or self._watchdog.has_fired or time.monotonic_ns() > command.expires_ns:
            return  # a program that stood still has an old command in its hand
        values = command.values
        if self._sent is not None:  # a tick may have been left out: two steps at once are none that the limits allow
            values = self._sent + np.clip(values - self._sent, -self._step, self._step)
        self._watchdog.feed(command.expires_ns)  # first: the driver may hang
        self._robot.obey(values, command.expires_ns)
        self._sent = values

    def _leave(self, is_orderly: bool) -> None:
        """What --at-exit says. A robot that was stopped, or lost its gateway, is not parked."""
        at_exit, is_dry = self._settings.at_exit, self._settings.is_dry
        if at_exit == "park" and is_orderly and not is_dry and self._sent is not None:
            try:
                self._park(self._sent)
            except KeyboardInterrupt:
                self._say("parking was interrupted")
        if is_orderly:
            self._watchdog.rest()
        if at_exit == "release" and not is_dry:
            self._robot.release()

    def _park(self, sent: np.ndarray) -> None:
        """At most a step per tick to the home of the robot's file, or to where the program found the robot."""
        robot = self._client.welcome["robot"]
        home = np.asarray(robot.get("home") or [], np.float32)
        target = sent.copy()
        wanted = home if len(home) == len(sent) else self._start[: len(sent)]
        target[: len(wanted)] = wanted
        target = np.where(np.isfinite(self._step), target, sent)  # a gripper stays as it is
        period_ns = self._client.period_ns
        while np.abs(target - sent).max() > 1e-6:
            seen = self._robot.observe()
            if seen.robot_state != "ok" or self._watchdog.has_fired:
                by = f"{seen.robot_state} {seen.robot_text}" if seen.robot_state != "ok" else "the watchdog stopped it"
                self._say(f"not parked: {by}. It stays where it is")
                return
            sent = (sent + np.clip(target - sent, -self._step, self._step)).astype(np.float32)
            expires_ns = time.monotonic_ns() + 3 * period_ns
            self._watchdog.feed(expires_ns)
            self._robot.obey(sent, expires_ns)
            time.sleep(period_ns / 1e9)


def _row(values: Any) -> str:
    return " ".join(f"{value:+.3f}" for value in np.asarray(values, np.float64).ravel())


def main(
    new_robot: Callable[[dict[str, Any], dict[str, Any]], Robot],
    stop: Callable[..., Any],
    stop_arguments: tuple[Any, ...] = (),
    argv: list[str] | None = None,
    description: str = "",
) -> int:
    """The command line of a robot's program; returns its exit code.

    Args:
        new_robot: connects to the robot, and is given the cameras of ``--camera`` by name and the gateway's
            ``Client.welcome``, whose ``robot`` it may compare with its own. ValueError ends the program.
        stop: stops it, called in the watchdog's process with ``stop_arguments``.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--url", default="ws://127.0.0.1:8000", help="address of pp-gateway --dialect ponderpounce")
    parser.add_argument("--api-key-file", type=Path, help="file with the word that the gateway wants")
    parser.add_argument("--instruction", required=True, help="what the robot is to do")
    parser.add_argument("--task", default="", help="name of the task in logs")
    parser.add_argument("--speed", type=float, default=1.0, help="share of the robot's step limits, 0.1 to 1")
    parser.add_argument("--dry-run", action="store_true", help="the whole loop, but send the robot nothing")
    parser.add_argument("--yes", action="store_true", help="do not ask before the first row")
    parser.add_argument("--at-exit", choices=AT_EXIT, help="how to leave the robot; else as its file says")
    parser.add_argument("--max-s", type=float, help="longest time in seconds")
    parser.add_argument(
        "--camera", action="append", default=[], metavar="NAME=SOURCE",
        help="device number, file or rtsp:// address of a camera; repeat it for each",
    )  # fmt: skip
    parser.add_argument("--camera-px", type=int, default=256, help="side of the squares that pictures are resized to")
    said = parser.parse_args(argv)
    if not 0.1 <= said.speed <= 1:
        parser.error(f"--speed {said.speed:g}: expected 0.1 to 1")
    try:
        key = said.api_key_file.read_text(encoding="utf-8").strip() if said.api_key_file else ""
    except OSError as error:
        parser.error(str(error))
    for number in (signal.SIGINT, signal.SIGTERM):  # SIGINT too: a script's background jobs begin with it ignored
        signal.signal(number, _interrupted)
    watchdog = Watchdog(stop, *stop_arguments)
    try:
        with Client(said.url, key) as client:
            at_exit = said.at_exit or client.welcome["robot"].get("at_exit")
            settings = Settings(
                said.instruction, said.task, said.speed, said.dry_run, said.yes,
                at_exit if at_exit in AT_EXIT else "hold", said.max_s,
            )  # fmt: skip
            cameras = _cameras(said.camera, said.camera_px)
            why = drive(new_robot(cameras, client.welcome), client, settings, watchdog)
    except (Lost, Refused, OSError, ValueError, ImportError) as error:
        why = str(error)
    finally:
        watchdog.close()
    if why:
        sys.stderr.write(f"{why}\n")
    return 1 if why else 0


def _cameras(pairs: list[str], side_px: int) -> dict[str, Any]:
    """Raises OSError or ValueError."""
    found = {}
    for pair in pairs:
        from ponderpounce_client.cameras import Camera  # OpenCV is needed here alone

        name, _, source = pair.partition("=")
        if not name or not source:
            raise ValueError(f"--camera {pair}: expected NAME=SOURCE, e.g. front=0")
        found[name] = Camera(int(source) if source.isdecimal() else source, (side_px, side_px))
    return found


def _interrupted(number: int, frame: Any) -> None:
    raise KeyboardInterrupt
