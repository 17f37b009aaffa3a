"""LeRobot's side of test_lerobot_strategy.py, under LeRobot's own Python.

lerobot_strategy.py driver FOLDER          what our driver does with a robot of LeRobot's; JSON on stdout
lerobot_strategy.py strategy FOLDER URL    an episode by the strategy, until FOLDER/end is there
"""

from __future__ import annotations

import gc
import json
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from lerobot.motors.motors_bus import Motor, MotorNormMode, SerialMotorsBus
from lerobot.rollout.configs import RolloutStrategyConfig
from lerobot.rollout.robot_wrapper import ThreadSafeRobot
from lerobot.utils.import_utils import make_device_from_device_class
from lerobot_robot_fake import HOME, KEYS, Fake, FakeConfig

NAMES = [key.removesuffix(".pos") for key in KEYS]


class Bus(SerialMotorsBus):
    """Feetech's, without a port."""

    def __init__(self, mode: MotorNormMode) -> None:
        self.motors = {name: Motor(place, "sts3215", mode) for place, name in enumerate(NAMES)}
        self.torque = 1

    is_connected = True

    def sync_read(self, data_name: str, *_: Any, **options: Any) -> dict[str, int]:
        assert (data_name, options) == ("Torque_Enable", {"normalize": False})
        return dict.fromkeys(NAMES, self.torque)


Bus.__abstractmethods__ = frozenset()


def welcome(**changes: Any) -> dict[str, Any]:
    dimensions = [
        {"name": name, "kind": "position", "unit": "1" if name == "gripper" else "rad", "state": place}
        for place, name in enumerate(NAMES)
    ]
    robot = {"dimensions": dimensions, "num_proprio": 8} | changes
    return {"control_hz": 20, "cameras": ["front", "wrist"], "robot": robot}


def refusal(what: Any) -> str:
    try:
        what()
    except ValueError as error:
        return str(error)
    return "taken"


def eventually(what: Any, longest_s: float = 20.0) -> Any:
    until_s = time.monotonic() + longest_s
    while not (found := what()) and time.monotonic() < until_s:
        time.sleep(0.02)
    return found


def fake(folder: Path, **config: Any) -> Fake:
    return Fake(FakeConfig(folder=str(folder), **config))


def refusals(folder: Path) -> dict[str, str]:
    from lerobot_strategy_ponderpounce import Arm
    from lerobot_strategy_ponderpounce.joints import check_driver, joints_of

    def changed(place: int, **changes: Any) -> dict[str, Any]:
        robot = welcome()["robot"]
        robot["dimensions"][place] |= changes
        return robot

    def with_bus(mode: MotorNormMode) -> Fake:
        robot = fake(folder)
        robot.bus = Bus(mode)
        return robot

    robot, silent = fake(folder), fake(folder, says_it_holds=False)
    limits = (5, 5.0, 0.0, -1.0, float("nan"), True, {"gripper": 5})
    return {
        "silent": refusal(lambda: check_driver(silent, False)),
        "said": refusal(lambda: check_driver(silent, True)),
        **{str(each): refusal(lambda each=each: check_driver(fake(folder, max_relative_target=each), True))
           for each in limits},
        "name": refusal(lambda: joints_of(robot, changed(0, name="elbow"))),
        "velocity": refusal(lambda: joints_of(robot, changed(0, kind="velocity"))),
        "place": refusal(lambda: joints_of(robot, changed(0, state=None))),
        "unit": refusal(lambda: joints_of(robot, changed(0, unit="m"))),
        "percent": refusal(lambda: joints_of(with_bus(MotorNormMode.RANGE_M100_100), changed(0))),
        "degrees": refusal(lambda: joints_of(with_bus(MotorNormMode.DEGREES), changed(7, unit="%"))),
        "camera": refusal(lambda: Arm(robot, welcome() | {"cameras": ["top"]}, {}, holds_position=False, say=print)),
    }  # fmt: skip


def driven(folder: Path) -> dict[str, Any]:
    """What a driver does with commands and faults; the robot is thrown away in the end."""
    from lerobot_strategy_ponderpounce import Arm

    robot, told = fake(folder), {}
    robot.bus = Bus(MotorNormMode.DEGREES)
    robot.bus.motors = {}
    arm = Arm(robot, welcome(), {}, holds_position=False, say=print)
    seen, far_ns = arm.observe(), time.monotonic_ns() + 3_600_000_000_000
    told["state"] = seen.state.tolist()
    told["images"] = {name: list(image.shape) for name, image in seen.images.items()}

    def sent() -> int:
        return len(rows(folder))

    def becomes(state: str) -> Any:
        return eventually(lambda: (found := arm.observe()).robot_state == state and found)

    arm.obey(seen.state + 0.1, 0)
    for _ in range(2):  # the driver's thread sends before it reads: the second reading is after the command's turn
        now_ns = time.monotonic_ns()
        assert eventually(lambda now_ns=now_ns: arm.observe().state_ns > now_ns)
    told["expired"] = sent()
    arm.obey(seen.state + 0.1, far_ns)
    told["obeyed"] = eventually(sent)
    robot.bus.torque = 0
    told["torque"] = becomes("torque_off").robot_text
    robot.bus.torque = 1
    becomes("ok")
    for fault in ("slow", "unplugged", "refuse"):
        (folder / fault).touch()
        arm.obey(seen.state, far_ns)
        found, before = becomes("fault"), sent()
        (folder / fault).unlink()
        told[fault] = [found.robot_text, bool(becomes("ok")), sent() - before]
    (folder / "slow").touch()
    began_s = time.monotonic()
    for _ in range(20):
        arm.obey(seen.state, far_ns)
        arm.observe()
    told["waited_s"] = time.monotonic() - began_s
    (folder / "slow").unlink()
    arm.close()
    return told


def rows(folder: Path) -> list[Any]:
    file = folder / "sent.jsonl"
    return [json.loads(line)[1] for line in file.read_text().splitlines()] if file.exists() else []


def driver(folder: Path) -> dict[str, Any]:
    from lerobot_strategy_ponderpounce import HAS_REGISTRY, Arm

    told = {"has_registry": HAS_REGISTRY, "refused": refusals(folder)} | driven(folder)
    gc.collect()
    told["left"] = rows(folder)[-1]
    Arm(fake(folder), welcome(), {}, holds_position=False, say=print).release()
    told["released"] = rows(folder)[-1]
    return told


def strategy(folder: Path, url: str) -> dict[str, Any]:
    RolloutStrategyConfig.extra_dataset_features = lambda self: {}  # what the registry that takes others is known by
    from lerobot_strategy_ponderpounce import PonderpounceStrategyConfig

    config = RolloutStrategyConfig.get_choice_class("ponderpounce")(url=url, yes=True)
    assert isinstance(config, PonderpounceStrategyConfig)
    made = make_device_from_device_class(config)
    robot = Fake(FakeConfig(folder=str(folder)))
    robot.connect(calibrate=False)
    ctx = SimpleNamespace(
        hardware=SimpleNamespace(
            robot_wrapper=ThreadSafeRobot(robot), teleop=None, initial_position=dict(zip(KEYS, HOME, strict=True))
        ),
        runtime=SimpleNamespace(cfg=SimpleNamespace(task="wave", duration=0), shutdown_event=threading.Event()),
    )

    def end() -> None:
        eventually((folder / "end").exists, 600.0)
        ctx.runtime.shutdown_event.set()

    threading.Thread(target=end, daemon=True).start()
    try:
        made.setup(ctx)
        made.run(ctx)
    finally:
        made.teardown(ctx)
    return {"is_connected": robot.is_connected}


if __name__ == "__main__":
    if sys.argv[1] == "driver":
        found = driver(Path(sys.argv[2]))
    else:
        found = strategy(Path(sys.argv[2]), sys.argv[3])
    sys.stdout.write(json.dumps(found) + "\n")
