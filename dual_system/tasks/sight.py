"""Visibility of objects in a camera's pixels by ray casting, so that grounded texts need no renderer.

The same rays that a renderer would trace through pixel centres are cast at the object's surroundings only. Texts are
therefore identical with rendering on or off, and do not depend on a graphics driver.
"""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.geometry import Array
from dual_system.tasks.physics import Physics

_SEEN_GROUPS = np.array([0, 1, 1, 1, 0, 0], dtype=np.uint8)  # what `rendering` draws: no collision shapes, no sites
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_NO_BODY = -1


def intrinsic(physics: Physics, camera: str, image_px: int) -> Array:
    """Returns the camera matrix K (3, 3) of a square image: pixel = K (R p + t), (0, 0) the top left corner."""
    focal_px = image_px / 2 / np.tan(np.deg2rad(physics.model.camera(camera).fovy[0]) / 2)
    return np.array([[focal_px, 0.0, image_px / 2], [0.0, focal_px, image_px / 2], [0.0, 0.0, 1.0]])


def extrinsic(physics: Physics, camera: str) -> Array:
    """Returns world-to-camera [R | t] (3, 4) in OpenCV axes (x right, y down, z forward), as the camera stands now."""
    index = physics.model.camera(camera).id
    R = np.diag([1.0, -1.0, -1.0]) @ physics.data.cam_xmat[index].reshape(3, 3).T  # MuJoCo's cameras look along -z
    return np.column_stack([R, -R @ physics.data.cam_xpos[index]])


def project(K: Array, Rt: Array, points_m: Array) -> Array:
    """Returns the image points (n, 2) as x, y in pixels of world points (n, 3) in front of the camera."""
    rays = (K @ (Rt[:, :3] @ points_m.T + Rt[:, 3:])).T
    return rays[:, :2] / rays[:, 2:]


def visible_pixels(physics: Physics, camera: str, body: str, image_px: int) -> NDArray[np.int64]:
    """Returns the pixels (n, 2), as row and column, that show the body itself (not its child bodies)."""
    K, Rt = intrinsic(physics, camera, image_px), extrinsic(physics, camera)
    corners_px = project(K, Rt, _corners(physics, body))
    low = np.clip(np.floor(corners_px.min(axis=0)).astype(int) - 1, 0, image_px)
    high = np.clip(np.ceil(corners_px.max(axis=0)).astype(int) + 1, 0, image_px)
    rows, columns = np.meshgrid(np.arange(low[1], high[1]), np.arange(low[0], high[0]), indexing="ij")
    pixels = np.stack([rows.ravel(), columns.ravel()], axis=1)
    centers = np.column_stack([pixels[:, 1] + 0.5, pixels[:, 0] + 0.5, np.ones(len(pixels))])
    rays = centers @ np.linalg.inv(K).T @ Rt[:, :3]
    shown = physics.model.body(body).id
    return pixels[[_first_body(physics, camera, ray) == shown for ray in rays]]


def mean_pixel(pixels: NDArray[np.int64]) -> tuple[int, int] | None:
    """Returns the mean (row, column) of pixels (n, 2), rounded down as upstream does; None if there is none."""
    if len(pixels) == 0:
        return None
    row, column = pixels.mean(axis=0)
    return int(row), int(column)


def _first_body(physics: Physics, camera: str, ray: Array) -> int:
    """Id of the body that a ray (3,) from a camera meets first; -1 if it meets none.

    One ray at a time: mj_multiRay (3.9.0) has been seen to overlook the hand in front of a cube, where mj_ray and the
    renderer agree. A cube's few hundred rays take about two milliseconds, once per subtask.
    """
    hit = np.empty(1, dtype=np.int32)
    eye = physics.data.cam_xpos[physics.model.camera(camera).id]
    blocks_too = True  # static geoms: the table and the arm's base
    mujoco.mj_ray(physics.model, physics.data, eye, ray, _SEEN_GROUPS, blocks_too, _NO_BODY, hit, None)
    return -1 if hit[0] < 0 else int(physics.model.geom_bodyid[hit[0]])


def _corners(physics: Physics, body: str) -> Array:
    """Corners (8 n, 3) of the bounding boxes of a body's n geoms, in the world."""
    model, data = physics.model, physics.data
    entry = model.body(body)
    boxes = []
    for geom in range(entry.geomadr[0], entry.geomadr[0] + entry.geomnum[0]):
        center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        local = center + _CORNERS * half
        boxes.append(local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return np.concatenate(boxes)
