"""Your own robot: connect, observe, obey. A fake arm stands in; put your driver's calls in the place of FakeArm's.

python -m ponderpounce_client.fake_arm 127.0.0.1:9100                 # a process of its own, like a robot's controller
pp-gateway --dialect ponderpounce --local --ponder-checkpoint checkpoints/small/ponder \
  --pounce-checkpoint checkpoints/small/pounce                        # on the robot's computer
python examples/06_your_own_robot.py --instruction "pick the highlighted cubes" --dry-run

This is not a safety function: the vendor's emergency stop, limits and safety planes stay on.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time

import numpy as np
from ponderpounce_client import Observation, main
from ponderpounce_client.fake_arm import FakeArm

ADDRESS = os.environ.get("ROBOT", "127.0.0.1:9100")


class MyRobot:
    """Everything that is about this robot. No call blocks for longer than a tick."""

    def __init__(self, cameras, welcome):
        self._arm, self._cameras = FakeArm(ADDRESS), cameras
        self._state = self._arm.call("read")["state"]
        if welcome["robot"]["num_proprio"] != len(self._state):
            raise ValueError(f"expected a gateway for {len(self._state)} measured numbers, came {welcome['robot']}")

    def observe(self):
        """Joints, pictures, when each was taken, and what the robot says of itself."""
        says, text, state_ns = "fault", "the controller does not answer", time.monotonic_ns()
        with contextlib.suppress(OSError):  # then the last joints, which are not to be trusted
            told = self._arm.call("read")
            self._state, says, text = told["state"], told["says"], told["text"]
        grey = np.full((256, 256, 3), 128, np.uint8)
        pictures = {name: camera.read() for name, camera in self._cameras.items()}
        pictures = {"front": (grey, state_ns), "wrist": (grey, state_ns), **pictures}
        return Observation(
            state=self._state,
            state_ns=state_ns,
            images={name: image for name, (image, _) in pictures.items()},
            captured_ns={name: at_ns for name, (_, at_ns) in pictures.items()},
            robot_state=says,
            robot_text=text,
        )

    def obey(self, values, expires_ns):
        """A command for the servos; what is lost on the way, the next one makes up for."""
        with contextlib.suppress(OSError):
            self._arm.call("move", values=values.tolist())

    def release(self):
        self._arm.call("release")


def stop():
    """Called in the watchdog's process, which has a connection of its own. It is called again until it succeeds."""
    FakeArm(ADDRESS).call("stop", text="the watchdog stopped it")


if __name__ == "__main__":
    sys.exit(main(MyRobot, stop, description=__doc__))
