"""Physics: one MuJoCo world that is set, advanced by whole control steps, read by names, saved and restored.

It has poses but no meaning: the tasks define success and failure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks import panda
from dual_system.tasks.geometry import Array, pose
from dual_system.tasks.scene import RGBA

CONTROL_HZ = 20

_GRASP_FORCE_N = 0.5
_GRASP_COS = np.cos(np.deg2rad(85.0))
_PARK_XYZ_M = (10.0, 10.0, 10.0)  # behind the front camera; upstream parks its props here too
_PARK_SPACING_M = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class PhysicsState:
    """Everything that changes in a world: restoring it gives bit-identical steps from there on."""

    integration: Array  # mjSTATE_INTEGRATION; FULLPHYSICS alone forgets the solver's warm start and is not exact
    geom_rgba: NDArray[np.float32]  # (ngeom, 4)

    def at_the_time_of(self, other: PhysicsState) -> PhysicsState:
        """Returns this world with the other's clock."""
        integration = self.integration.copy()
        integration[0] = other.integration[0]  # mjSTATE_TIME comes first
        return PhysicsState(integration=integration, geom_rgba=self.geom_rgba)


class Physics:
    """A compiled scene with the Panda in it.

    Bodies are addressed by the names the scene gave them. After `reset`, `advance`, `load` and `refresh` all derived
    quantities (poses, contact forces) belong to the current state, not, as after a bare mj_step, to the one a substep
    ago.
    """

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self.model = model = spec.compile()
        self.data = mujoco.MjData(model)
        self.substeps = whole_substeps(model.opt.timestep, CONTROL_HZ)
        self.robot = panda.robot_in(model)
        self._arm_qpos = np.array([model.joint(name).qposadr[0] for name in panda.ARM_JOINTS])
        self._arm_qvel = np.array([model.joint(name).dofadr[0] for name in panda.ARM_JOINTS])
        self._finger_qpos = np.array([model.joint(name).qposadr[0] for name in self.robot.finger_joints], dtype=int)
        self._fingers = [model.body(name).id for name in self.robot.finger_bodies]
        self._tcp = model.site(panda.TCP_SITE).id
        # A finger owns the bodies below it (its pad sits on a child body).
        self._owner = {body: body for body in self._fingers}
        for body in range(model.nbody):
            if int(model.body_parentid[body]) in self._owner:
                self._owner[body] = self._owner[int(model.body_parentid[body])]
        self._compiled_rgba = model.geom_rgba.copy()
        self.props = tuple(model.body(b).name for b in range(model.nbody) if _is_prop(model, b))
        self.reset()

    def reset(self) -> None:
        """Puts the arm at home with an open gripper, at rest, parks every prop and takes back every paint."""
        mujoco.mj_resetData(self.model, self.data)
        self.model.geom_rgba[:] = self._compiled_rgba
        self.data.qpos[self._arm_qpos] = panda.HOME_QPOS
        self.data.qpos[self._finger_qpos] = self.robot.open_fingers_m
        self.data.ctrl[:] = self.robot.control_of(np.append(panda.HOME_QPOS, self.robot.rest_command))
        for name in self.props:
            self.park(name)
        self.refresh()

    def pose_arm(self, joints_7: Array, opening_m: float) -> None:
        """Puts the arm elsewhere, at rest: joints in rad, and how far each finger is open. Call `refresh` after it."""
        self.data.qpos[self._arm_qpos] = joints_7
        self.data.qpos[self._finger_qpos] = np.multiply(opening_m, np.sign(self.robot.open_fingers_m))

    def place(self, name: str, pose_7: Array) -> None:
        """Puts a prop at a pose (7,), at rest. Call `refresh` after the last one."""
        self._set_pose(name, pose_7)
        body = self.model.body(name)
        if body.mocapid[0] < 0:
            self.data.xfrc_applied[body.id] = 0.0

    def is_free(self, name: str) -> bool:
        """Whether a body is a prop that the arm can push about."""
        return name in self.props and int(self.model.body(name).mocapid[0]) < 0

    def park(self, name: str) -> None:
        """Puts a prop out of sight of both cameras, where it floats at rest until it is placed again."""
        body = self.model.body(name)
        x_m = _PARK_XYZ_M[0] + self.props.index(name) * _PARK_SPACING_M
        self._set_pose(name, pose(x_m, *_PARK_XYZ_M[1:]))
        if body.mocapid[0] < 0:
            # An upward push equal to its weight; unlike model.body_gravcomp it is part of the saved state.
            self.data.xfrc_applied[body.id, :3] = -self.model.body_subtreemass[body.id] * self.model.opt.gravity

    def paint(self, geom: str, rgba: RGBA) -> None:
        """Colours a geom until the next `reset`."""
        self.model.geom(geom).rgba[:] = rgba

    def hide(self, body: str) -> None:
        """Makes a body invisible until the next `reset`; it is touched as before."""
        self.model.geom_rgba[self.model.geom_bodyid == self.model.body(body).id, 3] = 0.0

    def refresh(self) -> None:
        """Recomputes poses and contacts from the current state. No time passes."""
        mujoco.mj_forward(self.model, self.data)

    def advance(self, action: Array) -> None:
        """Drives the arm towards an action (8,) for one control step: exactly 50 ms."""
        self.data.ctrl[:] = self.robot.control_of(action)
        mujoco.mj_step(self.model, self.data, self.substeps)
        self.refresh()

    def elapsed_steps(self) -> int:
        """Control steps since `reset`. The one that settles the scene counts, so observation k has k + 1 behind it."""
        return round(self.data.time * CONTROL_HZ)

    def arm_qpos(self) -> Array:
        """Joint angles (7,) in rad."""
        return self.data.qpos[self._arm_qpos]  # fancy indexing: a copy

    def arm_qvel(self) -> Array:
        """Joint speeds (7,) in rad/s."""
        return self.data.qvel[self._arm_qvel]

    def state(self) -> Array:
        """The robot's state (8,): seven joints in rad, and one finger's opening in m, 0 without fingers."""
        return np.append(self.arm_qpos(), self.finger_openings_m()[:1] if self.robot.has_gripper else 0.0)

    def finger_openings_m(self) -> Array:
        """Both fingers' distances (2,) from the closed position; (0,) without a gripper."""
        return np.abs(self.data.qpos[self._finger_qpos])

    def gripper_command(self) -> float:
        """The gripper command in [-1, 1] that is in force; 1 is open. Always -1 without a gripper."""
        return self.robot.gripper_command_of(self.data.ctrl)

    def command(self) -> Array:
        """The action (8,) that is in force: seven joint targets in rad and the gripper's command."""
        return np.append(self.data.ctrl[:7], self.gripper_command())

    def tcp_transform(self) -> Array:
        """Tool centre point as a (4, 4) transform: z leaves the palm, the fingers open along y."""
        T = np.eye(4)
        T[:3, :3] = self.data.site_xmat[self._tcp].reshape(3, 3)
        T[:3, 3] = self.data.site_xpos[self._tcp]
        return T

    def pose(self, name: str) -> Array:
        """Pose (7,) of a body in the world."""
        body = self.model.body(name).id
        return np.concatenate([self.data.xpos[body], self.data.xquat[body]])

    def position_m(self, name: str) -> Array:
        """Position (3,) of a body's origin."""
        return self.data.xpos[self.model.body(name).id].copy()

    def travel_m(self, joint: str) -> float:
        """How far a slide joint is from its rest position; negative is down."""
        return float(self.data.qpos[self.model.joint(joint).qposadr[0]])

    def is_grasped(self, name: str) -> bool:
        """True if both fingers press on the body with at least 0.5 N, within 85 degrees of their opening axis.

        Never without a gripper.
        """
        force_of_finger = {finger: np.zeros(3) for finger in self._fingers}
        body = self.model.body(name).id
        wrench = np.empty(6)
        contacts = self.data.contact
        bodies_C2 = self.model.geom_bodyid[contacts.geom]
        for index in np.flatnonzero((bodies_C2 == body).any(axis=1)):
            first, second = map(int, bodies_C2[index])
            finger = self._owner.get(second if first == body else first)
            if finger is None:
                continue
            mujoco.mj_contactForce(self.model, self.data, index, wrench)
            # The contact frame's x axis points from the first geom to the second: flip it to point into the finger.
            into_finger = 1.0 if first == body else -1.0
            force_of_finger[finger] += into_finger * (wrench[:3] @ contacts.frame[index].reshape(3, 3))
        return bool(force_of_finger) and all(self._presses(*item) for item in force_of_finger.items())

    def _presses(self, finger: int, force_n: Array) -> bool:
        outward = self.data.xmat[finger].reshape(3, 3)[:, 1]
        if finger == self._fingers[1]:
            outward = -outward
        magnitude = float(np.linalg.norm(force_n))
        return magnitude >= _GRASP_FORCE_N and float(force_n @ outward) >= magnitude * _GRASP_COS

    def save(self) -> PhysicsState:
        """Returns a copy of everything `load` needs to continue bit-exactly."""
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION)
        integration = np.empty(size)
        mujoco.mj_getState(self.model, self.data, integration, mujoco.mjtState.mjSTATE_INTEGRATION)
        return PhysicsState(integration=integration, geom_rgba=self.model.geom_rgba.copy())

    def load(self, state: PhysicsState) -> None:
        """Restores a saved state of the same scene."""
        self.model.geom_rgba[:] = state.geom_rgba
        mujoco.mj_setState(self.model, self.data, state.integration, mujoco.mjtState.mjSTATE_INTEGRATION)
        self.refresh()  # leaves the solver's warm start as it is; only a step moves that

    def gap(self, a: PhysicsState, b: PhysicsState, *, scripted: bool = True) -> float:
        """Distance of two states: the largest difference of a joint's position, in rad or m.

        Without ``scripted``, objects that only a task's stage moves do not count.
        """
        parts = mujoco.mjtState.mjSTATE_QPOS
        if scripted:
            parts |= mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
        positions = np.empty((2, mujoco.mj_stateSize(self.model, parts)))
        for row, state in zip(positions, (a, b), strict=True):
            mujoco.mj_extractState(self.model, state.integration, mujoco.mjtState.mjSTATE_INTEGRATION, row, parts)
        return float(np.abs(positions[0] - positions[1]).max())

    def painted_apart(self, a: PhysicsState, b: PhysicsState) -> tuple[str, ...]:
        """Returns the bodies that have another colour in one state than in the other."""
        geoms = np.flatnonzero(np.any(a.geom_rgba != b.geom_rgba, axis=1))
        return tuple(self.model.body(body).name for body in np.unique(self.model.geom_bodyid[geoms]))

    def _set_pose(self, name: str, pose_7: Array) -> None:
        body = self.model.body(name)
        mocap = int(body.mocapid[0])
        if mocap >= 0:
            self.data.mocap_pos[mocap] = pose_7[:3]
            self.data.mocap_quat[mocap] = pose_7[3:]
            return
        joint = self.model.joint(name)
        qpos, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
        self.data.qpos[qpos : qpos + 7] = pose_7
        self.data.qvel[dof : dof + 6] = 0.0


def whole_substeps(timestep_s: float, control_hz: int) -> int:
    """Returns how many physics steps make one control step. Raises ValueError unless they fit exactly."""
    substeps = round(1.0 / (control_hz * timestep_s))
    if substeps < 1 or abs(substeps * timestep_s * control_hz - 1.0) > 1e-9:
        raise ValueError(
            f"a physics step of {timestep_s * 1e3:g} ms does not divide the control period of {1e3 / control_hz:g} ms; "
            "use 2, 2.5, 5 or 10 ms"
        )
    return substeps


def _is_prop(model: Any, body: int) -> bool:
    """A prop is a mocap body or one with a free joint; everything else is the arm, the room or part of a prop."""
    if model.body_mocapid[body] >= 0:
        return True
    joint = int(model.body_jntadr[body])
    return joint >= 0 and bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE)
