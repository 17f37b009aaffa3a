"""RoboCasa-DC's layout: 24 tasks, 53 numbers of state, 12 of action, three pictures.

RoboCasa365, which LeRobot plays, has another: 16 numbers of state, and the same 12 of action with the base's first. One
in the place of the other moves the robot without any error, so it is refused by name wherever it can be told.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

CONTROL_HZ = 20
NUM_ROWS = 16
"""Rows of a chunk, all of which are played."""
MAX_STEPS = 1000
PX = 128

STATE = (
    ("robot0_joint_pos", 7),
    ("robot0_joint_pos_cos", 7),
    ("robot0_joint_pos_sin", 7),
    ("robot0_joint_vel", 7),
    ("robot0_eef_pos", 3),
    ("robot0_eef_quat", 4),
    ("robot0_gripper_qpos", 2),
    ("robot0_gripper_qvel", 2),
    ("robot0_base_pos", 3),
    ("robot0_base_quat", 4),
    ("robot0_base_to_eef_pos", 3),
    ("robot0_base_to_eef_quat", 4),
)
"""Observables in the order of the state. Quaternions are xyzw, as they come: the training data have them so."""
NUM_STATE = sum(size for _, size in STATE)
NUM_STATE_365 = 16

ACTION = (
    ("arm_position", "xyz"),
    ("arm_rotation", "xyz"),
    ("gripper", ""),
    ("base_velocity", "xyz"),
    ("torso", ""),
    ("mode", ""),
)
ACTION_NAMES = tuple(f"{name}_{axis}" if axis else name for name, axes in ACTION for axis in axes or ("",))
"""Names of a row's numbers, as in examples/robots/panda_omron.toml."""
BODY_PARTS = (("right", 6), ("right_gripper", 1), ("base", 3), ("torso", 1))
"""Parts of robosuite's composite controller in the order of the action; the mode follows."""

CAMERAS = {
    "ego_view": "robot0_agentview_left_image",
    "ego_view_right": "robot0_agentview_right_image",
    "hand_view": "robot0_eye_in_hand_image",
}
"""Our names in the models' order, with the observables."""

CATEGORY_BALANCED = ("CloseDrawer", "TurnOffSinkFaucet", "OpenDoubleDoor", "CoffeeServeMug", "PnPCounterToMicrowave")
PRECISION_SENSITIVE = (
    "TurnOffStove",
    "CoffeePressButton",
    "TurnOffSinkFaucet",
    "PnPCounterToSink",
    "PnPStoveToCounter",
)
"""The tasks that each split holds out. Each needs a model of its own."""
TASKS = (
    "PnPCounterToCab", "PnPCabToCounter", "PnPCounterToSink", "PnPSinkToCounter", "PnPCounterToMicrowave",
    "PnPMicrowaveToCounter", "PnPCounterToStove", "PnPStoveToCounter", "OpenSingleDoor", "CloseSingleDoor",
    "OpenDoubleDoor", "CloseDoubleDoor", "OpenDrawer", "CloseDrawer", "TurnOnSinkFaucet", "TurnOffSinkFaucet",
    "TurnSinkSpout", "TurnOnStove", "TurnOffStove", "TurnOnMicrowave", "TurnOffMicrowave", "CoffeePressButton",
    "CoffeeSetupMug", "CoffeeServeMug",
)  # fmt: skip


class Unfit(ValueError):
    """An environment, or a server, whose numbers are not RoboCasa-DC's."""


def check_task(task: str) -> None:
    """Raises Unfit unless it is one of the 24."""
    if task not in TASKS:
        raise Unfit(
            f"{task} is no task of RoboCasa-DC ({', '.join(TASKS)}). RoboCasa365, which LeRobot plays, has other "
            "names, 16 numbers of state, and actions that begin with the base: this program does not play it."
        )


def state_of(observation: Mapping[str, Any]) -> np.ndarray:
    """The state (53,) float32 of robosuite's observation.

    PandaOmron leaves ``robot0_joint_pos`` out unless it was activated; cosines and sines tell it.

    Raises:
        Unfit: an observable is missing or has another size.
    """
    values = dict(observation)
    if "robot0_joint_pos" not in values and {"robot0_joint_pos_cos", "robot0_joint_pos_sin"} <= values.keys():
        values["robot0_joint_pos"] = np.arctan2(values["robot0_joint_pos_sin"], values["robot0_joint_pos_cos"])
    for name in ("observation.state", "agent_pos", "state"):
        if np.size(values.get(name, ())) == NUM_STATE_365:
            raise Unfit(
                f"{name} has {NUM_STATE_365} numbers: RoboCasa365's state. RoboCasa-DC's has {NUM_STATE}, and its "
                "actions begin with the arm."
            )
    parts = []
    for name, size in STATE:
        if name not in values:
            raise Unfit(f"expected the observable {name}, came {', '.join(sorted(values))}")
        part = np.asarray(values[name], np.float32).reshape(-1)
        if len(part) != size:
            raise Unfit(f"{name}: expected {size} numbers, came {len(part)}")
        parts.append(part)
    return np.concatenate(parts)


def pictures_of(observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Pictures (128, 128, 3) uint8 by our names, the right way up: MuJoCo's are upside down against the data.

    Raises Unfit for a camera that is missing or of another size.
    """
    found = {}
    for name, observable in CAMERAS.items():
        picture = observation.get(observable)
        if not isinstance(picture, np.ndarray) or picture.shape != (PX, PX, 3) or picture.dtype != np.uint8:
            came = f"{picture.shape} of {picture.dtype}" if isinstance(picture, np.ndarray) else "none"
            raise Unfit(f"{observable}: expected ({PX}, {PX}, 3) of uint8, came {came}")
        found[name] = np.ascontiguousarray(picture[::-1])
    return found


def check_action(env: Any) -> None:
    """Raises Unfit unless robosuite's action is laid out as ours; a controller with another order of parts is."""
    controller = getattr(env.robots[0], "composite_controller", None)
    parts = dict(getattr(controller, "_action_split_indexes", {}))
    expected, begin = {}, 0
    for name, size in BODY_PARTS:
        expected[name] = (begin, begin + size)
        begin += size
    if parts != expected or env.action_dim != len(ACTION_NAMES):
        raise Unfit(
            f"expected an action of {len(ACTION_NAMES)} numbers with {expected} and last the mode, came "
            f"{env.action_dim} with {parts}; set body_part_ordering to {[name for name, _ in BODY_PARTS]}"
        )


def check_server(metadata: Mapping[str, Any]) -> None:
    """Raises Unfit unless a gateway's greeting is of this robot, in lockstep, with chunks of 16 rows."""
    robot = metadata.get("robot") or {}
    for what, expected, came in (
        ("mode", "lockstep", metadata.get("mode")),
        ("control_hz", CONTROL_HZ, metadata.get("control_hz")),
        ("rows", NUM_ROWS, metadata.get("rows")),
        ("num_proprio", NUM_STATE, robot.get("num_proprio")),
        ("cameras", list(CAMERAS), list(metadata.get("cameras") or ())),
        ("dimensions", list(ACTION_NAMES), robot.get("dimensions")),
    ):
        if came != expected:
            raise Unfit(
                f"the server's {what}: expected {expected}, came {came}. Start pp-gateway as docs/robocasa_real.md "
                "says, with --robot-file examples/robots/panda_omron.toml"
            )
