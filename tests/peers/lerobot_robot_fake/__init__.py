"""A robot of LeRobot's base class for test_lerobot_strategy.py: seven joints and a gripper, two cameras.

What it is sent goes to a file of its folder; files named ``slow``, ``unplugged`` and ``refuse`` there are its faults.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.robots import Robot, RobotConfig

KEYS = (*(f"joint_{number}.pos" for number in range(1, 8)), "gripper.pos")
HOME = (0.0, 22.5, 0.0, -112.5, 0.0, 135.0, 45.0, 100.0)
PX = 256


@RobotConfig.register_subclass("fake")
@dataclass
class FakeConfig(RobotConfig):
    folder: str = "."
    says_it_holds: bool = True
    max_relative_target: float | None = None
    disable_torque_on_disconnect: bool = True


class Fake(Robot):
    config_class = FakeConfig
    name = "fake"

    def __init__(self, config: FakeConfig) -> None:
        super().__init__(config)
        self.config, self.folder = config, Path(config.folder)
        self.is_open = False
        self.pose = dict(zip(KEYS, HOME, strict=True))
        if config.says_it_holds:
            self.supports_position_hold = True

    @property
    def observation_features(self) -> dict:
        return dict.fromkeys(KEYS, float) | dict.fromkeys(("front", "wrist"), (PX, PX, 3))

    @property
    def action_features(self) -> dict:
        return dict.fromkeys(KEYS, float)

    @property
    def is_connected(self) -> bool:
        return self.is_open and not (self.folder / "unplugged").exists()

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        assert not calibrate, "nobody is there to move it"
        self.is_open = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict:
        while (self.folder / "slow").exists():  # a camera that hangs
            time.sleep(0.01)
        if not self.is_connected:
            raise ConnectionError("no status packet")
        picture = np.full((PX, PX, 3), time.monotonic_ns() % 251, np.uint8)
        return self.pose | {"front": picture, "wrist": picture}

    def send_action(self, action: dict) -> dict:
        if (self.folder / "refuse").exists():
            raise RuntimeError("overload")
        self._tell(action)
        self.pose = dict(action)
        return action

    def disconnect(self) -> None:
        self._tell("torque off" if self.config.disable_torque_on_disconnect else "left")
        self.is_open = False

    def _tell(self, what: object) -> None:
        with (self.folder / "sent.jsonl").open("a") as file:
            file.write(json.dumps([time.monotonic_ns(), what]) + "\n")
