"""Building bodies from boxes, cylinders and ellipsoids: solid shapes that touch, and one drawn mesh a material.

What stands still is drawn with the world's meshes, whichever body its solid shapes belong to.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen import looks
from dual_system.tasks.panda import ROBOT_BIT, STIFF_SOLIMP, STIFF_SOLREF, WORLD_BIT

Vector = Sequence[float] | Array

OBJECT_BIT = 4
_DRAWN, _SOLID = 1, 3  # geom groups; cameras do not see 3
_ANY = WORLD_BIT | ROBOT_BIT | OBJECT_BIT
# Doors and drawers pass through what stands still: their joints' ranges hold them.
_BITS = {"still": (WORLD_BIT, ROBOT_BIT | OBJECT_BIT), "leaf": (0, ROBOT_BIT | OBJECT_BIT), "free": (OBJECT_BIT, _ANY)}

_CORNERS = np.array(
    [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)]
)
_SIDES = (
    (0, 1, 5, 4),
    (1, 2, 6, 5),
    (2, 3, 7, 6),
    (3, 0, 4, 7),
    (4, 5, 6, 7),
    (3, 2, 1, 0),
)  # front first, top, bottom
_SIDE_AXES = ((0, 2), (1, 2), (0, 2), (1, 2), (0, 1), (0, 1))  # in which directions a side's texture runs


class _Mesh:
    """Triangles of one material on one body."""

    def __init__(self) -> None:
        self.points: list[Array] = []
        self.uv: list[Array] = []
        self.faces: list[Array] = []
        self._num = 0

    def add(self, points: Array, faces: Any, uv: Array) -> None:
        self.points.append(points)
        self.uv.append(uv)
        self.faces.append(np.asarray(faces) + self._num)
        self._num += len(points)


class Part:
    """A body under construction. Points are in its own frame."""

    def __init__(self, workshop: Workshop, body: mujoco.MjsBody, motion: str, drawn_on: str, offset_m: Array) -> None:
        self.body = body
        self._workshop, self._motion, self._drawn_on, self._offset_m = workshop, motion, drawn_on, offset_m

    def moving(self, name: str, position_m: Vector) -> Part:
        """Adds a child that moves, and so is drawn on its own."""
        body = self.body.add_body(name=name, pos=position_m)
        return Part(self._workshop, body, "leaf", name, np.zeros(3))

    def hinge(self, name: str, axis: Vector, range_rad: Sequence[float] | None = None, **joint: Any) -> None:
        """Lets the part turn about an axis through its origin, within a range if there is one."""
        self._joint(mujoco.mjtJoint.mjJNT_HINGE, name, axis, range_rad, joint)

    def slide(self, name: str, axis: Vector, range_m: Sequence[float], **joint: Any) -> None:
        """Lets the part slide along an axis within a range."""
        self._joint(mujoco.mjtJoint.mjJNT_SLIDE, name, axis, range_m, joint)

    def box(
        self,
        center_m: Vector,
        half_m: Vector,
        look: str = "",
        *,
        pitch_rad: float = 0.0,
        is_solid: bool = True,
        **solid: Any,
    ) -> None:
        """Adds a box, turned about x by ``pitch_rad``; drawn if it has a look."""
        if look:
            self._draw_box(look, np.asarray(center_m), half_m, _about_x(pitch_rad))
        if is_solid:
            quat = [np.cos(pitch_rad / 2), np.sin(pitch_rad / 2), 0.0, 0.0]
            self._solid(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center_m, size=half_m, quat=quat, **solid)

    def cylinder(
        self,
        center_m: Vector,
        radius_m: float,
        half_m: float,
        look: str = "",
        *,
        axis: str = "z",
        top_radius_m: float | None = None,
        is_solid: bool = True,
        **solid: Any,
    ) -> None:
        """Adds a cylinder along an axis; ``top_radius_m`` tapers what is drawn."""
        R = {"z": np.eye(3), "x": _about_y(np.pi / 2), "y": _about_x(-np.pi / 2)}[axis]
        if look:
            self._draw_frustum(look, np.asarray(center_m), R, radius_m, top_radius_m or radius_m, half_m)
        if is_solid:
            quat = np.empty(4)
            mujoco.mju_mat2Quat(quat, R.ravel())
            size = [radius_m, half_m, 0.0]
            self._solid(type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=center_m, size=size, quat=quat, **solid)

    def ellipsoid(self, center_m: Vector, half_m: Vector, look: str, **solid: Any) -> None:
        """Adds an ellipsoid; a ball if its half axes are equal, which rolls and settles faster."""
        num, rings = 12, 8
        up = np.linspace(0.0, np.pi, rings + 1)
        round_ = np.linspace(0.0, 2 * np.pi, num, endpoint=False)
        points = np.array([[np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)] for a in up for b in round_])
        faces = []
        for ring in range(rings):
            for i in range(num):
                a, b = ring * num + i, ring * num + (i + 1) % num
                if ring < rings - 1:
                    faces.append((a, a + num, b + num))
                if ring > 0:
                    faces.append((a, b + num, b))
        self._draw(look, points * half_m + center_m, faces, points[:, :2])
        kind = mujoco.mjtGeom.mjGEOM_SPHERE if len(set(half_m)) == 1 else mujoco.mjtGeom.mjGEOM_ELLIPSOID
        self._solid(type=kind, pos=center_m, size=list(half_m), **solid)

    def ring(self, center_m: Vector, radius_m: float, half_m: Vector, look: str, *, num: int) -> None:
        """Adds a wall of boxes around a centre; ``half_m`` is across the wall and up, its inner face at the radius."""
        across_m, up_m = half_m
        along_m = (radius_m + 2 * across_m) * np.tan(np.pi / num)
        for angle_rad in 2 * np.pi * np.arange(num) / num:
            R = _about_z(angle_rad)
            center = R @ [radius_m + across_m, 0.0, 0.0] + center_m
            size = [across_m, along_m, up_m]
            self._draw_box(look, center, size, R)
            quat = [np.cos(angle_rad / 2), 0.0, 0.0, np.sin(angle_rad / 2)]
            self._solid(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, size=size, quat=quat)

    def _joint(self, kind: Any, name: str, axis: Any, range_: Sequence[float] | None, settings: dict[str, Any]) -> None:
        if "damping" in settings:
            settings = settings | {"damping": [settings["damping"], 0.0, 0.0]}
        limits = {} if range_ is None else {"range": list(range_)}
        self.body.add_joint(name=name, type=kind, axis=list(axis), limited=range_ is not None, **limits, **settings)

    def _draw_box(self, look: str, center: Array, half_m: Vector, R: Array) -> None:
        corners = (_CORNERS * half_m) @ R.T + center
        for side, axes in zip(_SIDES, _SIDE_AXES, strict=True):
            points = corners[list(side)]
            self._draw(look, points, [(0, 1, 2), (0, 2, 3)], (points + self._offset_m)[:, list(axes)])

    def _draw_frustum(self, look: str, center: Array, R: Array, low_m: float, high_m: float, half_m: float) -> None:
        num = 20 if max(low_m, high_m) > 0.05 else 12
        angles = np.linspace(0.0, 2 * np.pi, num, endpoint=False)
        round_ = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        low, high = (np.column_stack([round_ * r, np.full(num, z)]) for r, z in ((low_m, -half_m), (high_m, half_m)))
        fan = [(0, i, i + 1) for i in range(1, num - 1)]
        wall = [
            f for i in range(num) for f in ((i, (i + 1) % num, num + (i + 1) % num), (i, num + (i + 1) % num, num + i))
        ]
        for points, faces in ((np.vstack([low, high]), wall), (high, fan), (low[::-1], fan)):
            self._draw(look, points @ R.T + center, faces, points[:, :2])

    def _draw(self, look: str, points: Array, faces: Any, uv_m: Array) -> None:
        mesh = self._workshop.mesh(self._drawn_on, looks.material_of(look))
        mesh.add(points + self._offset_m, faces, looks.texture_points(look, uv_m))

    def _solid(self, **geom: Any) -> None:
        contype, conaffinity = _BITS[self._motion]
        settings: dict[str, Any] = {
            "contype": contype,
            "conaffinity": conaffinity,
            "group": _SOLID,
            "solref": STIFF_SOLREF,
            "solimp": STIFF_SOLIMP,
            "friction": [0.8, 0.005, 0.0001],
            "density": 500.0,
        }
        self.body.add_geom(**(settings | geom))


class Workshop:
    """Collects the meshes of a bay while its parts are built; `finish` adds them."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self._spec = spec
        self._meshes: dict[tuple[str, str], _Mesh] = {}

    def still(self, name: str, position_m: Vector) -> Part:
        """Adds a body that stands still."""
        body = self._spec.worldbody.add_body(name=name, pos=position_m)
        return Part(self, body, "still", "world", np.asarray(position_m, dtype=np.float64))

    def free(self, name: str, position_m: Vector, yaw_rad: float) -> Part:
        """Adds a body with a free joint of its name."""
        quat = [np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)]
        body = self._spec.worldbody.add_body(name=name, pos=position_m, quat=quat)
        body.add_freejoint(name=name)
        return Part(self, body, "free", name, np.zeros(3))

    def mesh(self, body: str, material: str) -> _Mesh:
        """Returns the mesh of a material on a body."""
        return self._meshes.setdefault((body, material), _Mesh())

    def finish(self) -> None:
        """Adds every mesh to its body. It weighs nothing and touches nothing."""
        for (body, material), mesh in self._meshes.items():
            name = f"{body}/{material}"
            faces = np.concatenate(mesh.faces).astype(np.int32)
            added = self._spec.add_mesh(
                name=name,
                uservert=np.concatenate(mesh.points).ravel(),
                userface=faces.ravel(),
                usertexcoord=np.concatenate(mesh.uv).ravel(),
                userfacetexcoord=faces.ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )
            self._spec.body(body).add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=added.name,
                material=material,
                group=_DRAWN,
                contype=0,
                conaffinity=0,
                mass=0.0,
            )


def _about_x(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_y(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _about_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
