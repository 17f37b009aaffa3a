"""The kitchen's PandaOmron as the protocol describes a robot. examples/robots/panda_omron.toml is the same one."""

from __future__ import annotations

import numpy as np

from dual_system.tasks.kitchen.control import CONTROL_HZ
from dual_system.tasks.kitchen.environment import IMAGE_PX
from dual_system.tasks.kitchen.layout import ACTION_NAMES, NUM_ACTION, NUM_STATE, STATE, STATE_PARTS
from dual_system.tasks.kitchen.omron import VIEWS
from protocol.messages import AtStop, Dimension, DimensionKind, Robot

_HELD_AT = -1.0  # gripper open, mode of the arm
_SWITCHES = ("gripper", "mode")
_UNITS = {
    "arm_position": "0.05 m a tick",
    "arm_rotation": "0.5 rad a tick",
    "gripper": "above 0 closes",
    "base_velocity": "m/s, 1.5 rad/s",
    "torso": "0.05 m a tick",
    "mode": "above 0 the base moves",
}
# A wrist turns to 3.75 rad, and a little further under load.
_LARGEST = {"joint_pos": 4.0, "cos": 1.001, "sin": 1.001, "quat": 1.001, "gripper_qpos": 0.1, "gripper_qvel": 5.0}
_LARGEST_ELSE = 50.0  # m, m/s and rad/s: only what is no number of this robot is refused
_STOP_TICKS = 2


def panda_omron() -> Robot:
    """Returns the robot at reset. Its commands are rates: a stop ends them, and the gripper keeps what it holds."""
    is_switch = np.isin(ACTION_NAMES, _SWITCHES)
    ones = np.ones(NUM_ACTION, np.float32)
    largest = np.empty(NUM_STATE, np.float32)
    for name, _ in STATE_PARTS:
        largest[STATE[name]] = next((most for end, most in _LARGEST.items() if name.endswith(end)), _LARGEST_ELSE)
    return Robot(
        name="panda_omron",
        command_low=-ones,
        command_high=ones,
        max_step=0 * ones,  # the controller itself limits how fast anything moves
        initial_command=np.where(is_switch, _HELD_AT, 0.0).astype(np.float32),
        cameras=VIEWS,
        image_height=IMAGE_PX,
        image_width=IMAGE_PX,
        num_proprio=NUM_STATE,
        is_simulated=True,
        state_low=-largest,
        state_high=largest,
        dimensions=tuple(_dimension(name) for name in ACTION_NAMES),
        control_hz=CONTROL_HZ,
        stop_ticks=_STOP_TICKS,
    )


def _dimension(name: str) -> Dimension:
    unit = next(unit for part, unit in _UNITS.items() if name.startswith(part))
    is_switch = name in _SWITCHES
    return Dimension(
        name=name,
        kind=DimensionKind.GRIPPER if is_switch else DimensionKind.VELOCITY,
        unit=unit,
        at_stop=AtStop.KEEP if is_switch else AtStop.ZERO,
    )
