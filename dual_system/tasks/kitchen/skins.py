"""Light shapes for robots: what robosuite's meshes look like from a metre away, in a hundredth of their faces.

A software renderer pays 17 us for a shape and 0.04 us for a face, so every body gets at most two shapes, one of its
light parts and one of its dark ones. Collision meshes become hulls of at most 40 points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.geometry import Array
from dual_system.tasks.panda_model import cluster

SEEN_GROUP, FELT_GROUP = 1, 0
"""Geom groups of what is drawn and of what collides, as in robosuite's files."""

_DARK = 0.35  # mean of the colour below which a part counts as dark
_BLACKEST = 0.12  # a black part still shows its edges
_MAX_HULL_POINTS = 40
_FEWEST_FACES = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Skin:
    """One shape of a body, in the body's frame."""

    name: str
    body: str
    vertices: Array  # (n, 3) m
    faces: NDArray[np.int32]  # (m, 3)
    rgba: tuple[float, ...]
    collides: bool


def skins(spec: mujoco.MjSpec, cell_m: float) -> tuple[Skin, ...]:
    """Returns light shapes of a robot with robosuite's meshes; all its bodies with meshes must have names.

    Args:
        spec: Is compiled, and changed only in how many points a hull may have.
        cell_m: Size of the details that are lost.
    """
    for mesh in spec.meshes:
        mesh.maxhullvert = _MAX_HULL_POINTS
    model = spec.compile()
    found = []
    for body in range(model.nbody):
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_dataid[g] >= 0]
        seen = [g for g in geoms if model.geom_group[g] == SEEN_GROUP]
        name = model.body(body).name
        for shade in ("light", "dark"):
            parts = [g for g in seen if (shade == "dark") == _is_dark(model, g)]
            if parts:
                found.append(_merged(model, f"{name}_{shade}", name, parts, cell_m))
        found += [_hull(model, f"{name}_hull_{g}", name, g) for g in geoms if model.geom_group[g] == FELT_GROUP]
    return tuple(found)


def dress(spec: mujoco.MjSpec, shapes: Sequence[Skin]) -> None:
    """Replaces all meshes of a robot by light shapes. Properties of contacts are left at their defaults."""
    for geom in list(spec.geoms):
        if geom.meshname:
            spec.delete(geom)
        elif geom.material:
            geom.rgba, geom.material = spec.material(geom.material).rgba, ""
    for kind in (spec.meshes, spec.materials, spec.textures):
        for asset in list(kind):
            spec.delete(asset)
    for shape in shapes:
        spec.add_mesh(
            name=shape.name,
            uservert=shape.vertices.ravel(),
            userface=shape.faces.ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        spec.body(shape.body).add_geom(
            name=shape.name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=shape.name,
            rgba=shape.rgba,
            group=FELT_GROUP if shape.collides else SEEN_GROUP,
            contype=int(shape.collides),
            conaffinity=int(shape.collides),
            mass=0.0,
        )


def _merged(model: Any, name: str, body: str, geoms: Sequence[int], cell_m: float) -> Skin:
    vertices, faces, num_vertices = [], [], 0
    for geom in geoms:
        mesh = model.mesh(int(model.geom_dataid[geom]))
        vertices.append(_in_body(model, geom))
        faces.append(model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]] + num_vertices)
        num_vertices += len(vertices[-1])
    largest = geoms[int(np.argmax([len(each) for each in faces]))]
    rgba = (*(max(_BLACKEST, float(c)) for c in _rgba(model, largest)[:3]), 1.0)
    corners_full = np.concatenate(faces).astype(np.int32)
    light, corners = cluster(np.concatenate(vertices), corners_full, cell_m=cell_m)
    while len(corners) < _FEWEST_FACES:  # a part no larger than a cell
        cell_m /= 2
        light, corners = cluster(np.concatenate(vertices), corners_full, cell_m=cell_m)
    return Skin(name=name, body=body, vertices=light, faces=corners, rgba=rgba, collides=False)


def _hull(model: Any, name: str, body: str, geom: int) -> Skin:
    """The hull that MuJoCo has made of a mesh: its graph is two numbers, then 2 V + (V + 3 F) ids, then 3 F corners."""
    mesh = model.mesh(int(model.geom_dataid[geom]))
    graph = model.mesh_graph[mesh.graphadr[0] :]
    num_points, num_faces = int(graph[0]), int(graph[1])
    first = 2 + 3 * num_points + 3 * num_faces
    corners = graph[first : first + 3 * num_faces].reshape(-1, 3)
    used, faces = np.unique(corners, return_inverse=True)
    vertices = _in_body(model, geom)[used]
    return Skin(
        name=name,
        body=body,
        vertices=vertices,
        faces=faces.reshape(-1, 3).astype(np.int32),
        rgba=(0.5, 0.5, 0.5, 1.0),
        collides=True,
    )


def _in_body(model: Any, geom: int) -> Array:
    """Vertices (n, 3) of a geom's mesh in its body's frame; the compiler has moved the mesh to its own frame."""
    mesh = model.mesh(int(model.geom_dataid[geom]))
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]].astype(np.float64)
    return vertices @ rotation.reshape(3, 3).T + model.geom_pos[geom]


def _rgba(model: Any, geom: int) -> NDArray[np.float32]:
    material = int(model.geom_matid[geom])
    return model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]


def _is_dark(model: Any, geom: int) -> bool:
    return float(_rgba(model, geom)[:3].mean()) < _DARK
