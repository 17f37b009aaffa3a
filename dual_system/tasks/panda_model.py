"""The arm as a MuJoCo model, from robosuite's asset files.

Only the files are used: the package is located, never imported (importing it compiles numba code, which has been seen
to corrupt rendered frames, and pulls in a dozen packages).
"""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.panda import (
    BASE_POSITION_M,
    FINGER_BODIES,
    FINGER_JOINTS,
    PANDA_WRISTCAM,
    ROBOT_BIT,
    STICK_FROM_HAND_M,
    STIFF_SOLIMP,
    STIFF_SOLREF,
    TCP_SITE,
    WORLD_BIT,
    Array,
    Robot,
)

_GAIN_KP, _GAIN_KD, _FORCE_LIMIT = 1000.0, 100.0, 100.0  # N m / rad and N / m alike, as upstream
# Bare 100 g fingers bounce off a squeezed cube at a physics step of 5 ms; with this inertia they hold it, and they
# still close as their gains tell them to (it adds 5 ms to a time constant of 100 ms).
_FINGER_ARMATURE_KG = 0.5
_HAND_FROM_FLANGE_M = 0.107  # Franka's datasheet; robosuite mounts its hand half a millimetre short
_FINGER_FROM_HAND_M = 0.0584  # likewise; robosuite's fingers start 6 mm short
_STICK_RADIUS_M = 0.008
_HEAVY_FACES = 1000  # lighter meshes stay as they are; among them the fingers, which the wrist camera sees close up
_CELL_M = 0.006  # clustering grid of the visual meshes: looks the same at 256 px, halves the cost of a frame


def panda_spec(robot: Robot = PANDA_WRISTCAM) -> mujoco.MjSpec:
    """Returns a fresh, uncompiled model of the arm with what it carries, base at the origin of the world frame's table.

    Raises FileNotFoundError if robosuite's assets are not installed.
    """
    spec = _source_spec(robot)
    spec.modelname = robot.name
    light_meshes = _light_meshes()
    for name, (vertices, faces) in light_meshes.items():
        spec.add_mesh(
            name=f"light_{name}",
            uservert=vertices.ravel(),
            userface=faces.ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
    for geom in spec.geoms:
        if geom.meshname in light_meshes:
            geom.meshname = f"light_{geom.meshname}"
    for name in light_meshes:
        spec.delete(spec.mesh(name))
    return spec


def _source_spec(robot: Robot) -> mujoco.MjSpec:
    """Robosuite's robot and hand joined, corrected and given our gains, with the full visual meshes."""
    assets = robosuite_assets()
    spec = mujoco.MjSpec.from_file(str(assets / "robots/panda/robot.xml"))
    gripper = mujoco.MjSpec.from_file(str(assets / "grippers/panda_gripper.xml"))
    hand = spec.body("right_hand")
    hand.pos = [0.0, 0.0, _HAND_FROM_FLANGE_M]
    hand.quat = [np.cos(np.pi / 8), 0.0, 0.0, -np.sin(np.pi / 8)]  # robosuite rounds it to three digits
    spec.attach(gripper, prefix="", frame=hand.add_frame())
    for camera in list(spec.cameras):
        spec.delete(camera)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    hand.add_site(name=TCP_SITE, pos=[0.0, 0.0, robot.tcp_from_hand_m], group=4)
    spec.body("base").pos = BASE_POSITION_M
    for body in spec.bodies:
        body.gravcomp = 1.0  # upstream's arm feels no gravity; the real one compensates for it
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = ROBOT_BIT, WORLD_BIT
    if robot.has_gripper:
        _correct_fingers(spec)
    else:
        _replace_fingers_by_stick(spec)
    for actuator in spec.actuators:
        actuator.set_to_position(kp=_GAIN_KP, kv=_GAIN_KD)
        actuator.ctrllimited = False
        actuator.forcelimited = True
        actuator.forcerange = [-_FORCE_LIMIT, _FORCE_LIMIT]
    return spec


def _correct_fingers(spec: mujoco.MjSpec) -> None:
    """Mounts the fingers where Franka's are, as quick and as sticky as upstream's, with their black tips."""
    for body_name in FINGER_BODIES:
        spec.body(body_name).pos = [0.0, 0.0, _FINGER_FROM_HAND_M]
    for name in FINGER_JOINTS:
        # With robosuite's own damping and friction the fingers would close at half of upstream's speed.
        spec.joint(name).damping, spec.joint(name).frictionloss = [0.0] * 3, 0.0
        spec.joint(name).armature = _FINGER_ARMATURE_KG
    for finger in (1, 2):
        for geom in (spec.geom(f"finger{finger}_collision"), spec.geom(f"finger{finger}_pad_collision")):
            geom.friction, geom.condim = [2.0, 0.05, 0.0001], 4
            geom.solref, geom.solimp = STIFF_SOLREF, STIFF_SOLIMP
    for body_name, side in zip(FINGER_BODIES, (1.0, -1.0), strict=True):
        spec.body(body_name).add_geom(
            name=f"{body_name}_tip",  # upstream's hand has black rubber tips and bright fingers
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.0108, 0.005, 0.0095],
            pos=[0.0, side * 0.0048, 0.0447],
            rgba=[0.12, 0.12, 0.12, 1.0],
            contype=0,
            conaffinity=0,
            group=1,
            mass=0.0,
        )
    for finger in (1, 2):
        spec.geom(f"finger{finger}_visual").rgba = [0.8, 0.8, 0.8, 1.0]


def _replace_fingers_by_stick(spec: mujoco.MjSpec) -> None:
    """Takes the fingers off and puts a grey cylinder in their place, its tip the tool point."""
    for name in FINGER_JOINTS:
        spec.delete(spec.actuator(f"gripper_{name}"))
    for name in FINGER_BODIES:
        spec.delete(spec.body(name))
    begin_m, tip_m = STICK_FROM_HAND_M
    spec.body("right_hand").add_geom(
        name="stick",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[_STICK_RADIUS_M, (tip_m - begin_m) / 2, 0.0],
        pos=[0.0, 0.0, (begin_m + tip_m) / 2],
        rgba=[1.0, 1.0, 1.0, 1.0],  # its sides get ambient light only, so that it looks grey, as upstream
        contype=ROBOT_BIT,
        conaffinity=WORLD_BIT,
        group=1,
    )


def robosuite_assets() -> Path:
    """Returns the folder of robosuite's asset files. Raises FileNotFoundError if they are not installed."""
    found = importlib.util.find_spec("robosuite")
    if found is None or not found.submodule_search_locations:
        raise FileNotFoundError(
            "the robots' meshes and the textures come with robosuite, which is not installed. "
            "Install its files with: pip install --no-deps robosuite==1.5.2"
        )
    return Path(found.submodule_search_locations[0]) / "models" / "assets"


@functools.cache
def _light_meshes() -> dict[str, tuple[Array, NDArray[np.int32]]]:
    """Clustered visual meshes by name: vertices (n, 3) in metres, faces (m, 3). Takes a second, once."""
    spec = _source_spec(PANDA_WRISTCAM)  # the stick robot's are among its
    names = {geom.meshname for geom in spec.geoms if geom.meshname and geom.group == 1}
    model = spec.compile()
    meshes = {}
    for name in sorted(names):
        mesh = model.mesh(name)
        if mesh.facenum[0] < _HEAVY_FACES:
            continue
        first, last = mesh.vertadr[0], mesh.vertadr[0] + mesh.vertnum[0]
        rotation = np.empty(9)
        # The compiler moves every mesh to its own inertial frame; undo that, or the links come apart.
        mujoco.mju_quat2Mat(rotation, model.mesh_quat[mesh.id])
        vertices = model.mesh_vert[first:last].astype(np.float64) @ rotation.reshape(3, 3).T + model.mesh_pos[mesh.id]
        faces = model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
        meshes[name] = cluster(vertices, faces, cell_m=_CELL_M)
    return meshes


def cluster(vertices: Array, faces: NDArray[np.int32], *, cell_m: float) -> tuple[Array, NDArray[np.int32]]:
    """Merges all vertices that share a grid cell into their mean, and drops the faces that collapse.

    Args: vertices (n, 3) in metres; faces (m, 3) indices into them. Returns the smaller pair, in a fixed order.
    Vertex clustering after Rossignac and Borrel, "Multi-resolution 3D approximations", 1993.
    """
    cells = np.round(vertices / cell_m).astype(np.int64)
    _, cell_of_vertex, count = np.unique(_numbered(cells), return_inverse=True, return_counts=True)
    merged = np.zeros((len(count), 3))
    np.add.at(merged, cell_of_vertex, vertices)
    merged /= count[:, None]
    corners = cell_of_vertex[faces]
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(_numbered(np.sort(corners, axis=1)), return_index=True)
    return merged, corners[first].astype(np.int32)


def _numbered(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each row (n, 3), in the rows' order: NumPy sorts numbers many times faster than rows."""
    from_zero = rows - rows.min(axis=0, initial=0)
    return np.ravel_multi_index(tuple(from_zero.T), tuple(from_zero.max(axis=0, initial=0) + 1)).astype(np.int64)
