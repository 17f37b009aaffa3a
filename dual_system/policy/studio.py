"""Still scenes with exact labels: things on the table, the arm somewhere above them, both cameras.

They stand in for the pictures on which a real tower was pretrained. Scenes are of no task: things, places and poses are
drawn freely, and nothing is to be done with them.
"""

# T things

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dual_system.models.windows import LAPTOP_WINDOWS, Box, placed_in
from dual_system.tasks import sight
from dual_system.tasks.containers import EMPTY_Z_M, add_container
from dual_system.tasks.geometry import Array, Footprint, pose, transform
from dual_system.tasks.kinematics import Kinematics, UnreachableError
from dual_system.tasks.panda import HOME_OPENING_M, HOME_QPOS
from dual_system.tasks.pegs import PEG_HALF_WIDTH_M, add_peg
from dual_system.tasks.physics import Physics
from dual_system.tasks.props import PURPLE, TARGET_RADIUS_M, TARGET_THICKNESS_M, add_target
from dual_system.tasks.rendering import Cameras
from dual_system.tasks.scene import (
    BUTTON_HALF_M,
    CAMERAS,
    CUBE_COLORS,
    CUBE_HALF_M,
    DISC_RADIUS_M,
    SceneFullError,
    add_button,
    add_cube,
    add_disc,
    sample_footprint,
    table_scene,
)

IMAGE_PX = 128
WINDOWS: dict[str, Box] = dict(zip(CAMERAS, LAPTOP_WINDOWS, strict=True))

NAMES = ("red cube", "blue cube", "green cube", "button", "container", "target", "white disc", "peg")
"""The kinds of things, in the order of `Thing.kind`."""
_COLORS = tuple(CUBE_COLORS)
_BUTTON, _CONTAINER, _TARGET, _DISC, _PEG = range(3, 8)
_MOST = {0: 3, 1: 3, 2: 3, _BUTTON: 1, _CONTAINER: 4, _TARGET: 1, _DISC: 2, _PEG: 1}
_PEG_HALF_LENGTH_M, _PEG_RGBA = 0.1, (236 / 255, 115 / 255, 87 / 255, 1.0)
_CENTER_M, _REACH_M = (-0.05, 0.0), (0.24, 0.27)  # a little more than any task's
_GAP_M = 0.004
_MIN_SEEN_PX = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Thing:
    """One thing that at least one camera sees."""

    kind: int
    position_m: tuple[float, float, float]
    yaw_rad: float
    seen: dict[str, tuple[float, float]]
    """By camera: row and column of its centre, as fractions of the window. Cameras that do not show it are absent."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Still:
    """One scene and what is in it."""

    views: dict[str, NDArray[np.uint8]]
    things: tuple[Thing, ...]
    tool: Array
    """Transform (4, 4) of the tool in the table's frame."""


class Studio:
    """Arranges and photographs scenes; each follows from its seed. Needs a GL context; close it after use."""

    def __init__(self, image_px: int = IMAGE_PX) -> None:
        spec = table_scene()
        for kind, count in _MOST.items():
            for index in range(count):
                name = f"{kind}_{index}"
                if kind < len(_COLORS):
                    add_cube(spec, name)
                elif kind == _BUTTON:
                    add_button(spec, name)
                elif kind == _CONTAINER:
                    add_container(spec, name)
                elif kind == _TARGET:
                    add_target(spec, name, PURPLE)
                elif kind == _DISC:
                    add_disc(spec, name)
                else:
                    add_peg(spec, name, _PEG_HALF_LENGTH_M, _PEG_RGBA)
        self.physics = Physics(spec)
        self._kinematics = Kinematics(self.physics.model)
        self._upright = self._kinematics.tcp(HOME_QPOS)
        self._cameras = Cameras(self.physics, image_px)
        self._px = image_px

    def close(self) -> None:
        self._cameras.close()

    def still(self, seed: int) -> Still:
        """The scene of a seed."""
        rng = np.random.default_rng((seed, 78))
        for _ in range(100):
            try:
                return self._drawn(rng)
            except (SceneFullError, UnreachableError):
                continue
        raise SceneFullError(f"seed {seed}: a hundred draws did not fit on the table")

    def _drawn(self, rng: np.random.Generator) -> Still:
        self.physics.reset()
        placed = self._arrange(rng)
        self._pose_arm(rng, placed)
        views = self._cameras.frames()
        sights = {camera: self._cameras.segmentation(camera) for camera in WINDOWS}
        things = tuple(self._labelled(name, sights) for name in placed)
        tool = self.physics.tcp_transform()
        return Still(views=views, things=tuple(thing for thing in things if thing.seen), tool=tool)

    def _arrange(self, rng: np.random.Generator) -> list[str]:
        """Puts a random selection on the table, apart from each other; discs lie under cubes as often as not."""
        physics = self.physics
        for kind, color in enumerate(_COLORS):
            for index in range(_MOST[kind]):
                physics.paint(f"{kind}_{index}", CUBE_COLORS[color])
        names = [f"{kind}_{index}" for kind, most in _MOST.items() for index in range(int(rng.integers(most + 1)))]
        rng.shuffle(names)
        taken: list[Footprint] = []
        cubes: list[Footprint] = []
        for name in names:
            kind = int(name[0])
            half_m = {_BUTTON: BUTTON_HALF_M, _CONTAINER: (0.03, 0.03), _TARGET: (TARGET_RADIUS_M,) * 2}.get(
                kind, (CUBE_HALF_M,) * 2
            )
            if kind == _PEG:
                half_m = (_PEG_HALF_LENGTH_M, PEG_HALF_WIDTH_M)
            is_under = kind == _DISC and cubes and rng.random() < 0.5
            spot = cubes[int(rng.integers(len(cubes)))] if is_under else None
            if spot is None:
                spot = sample_footprint(
                    rng,
                    center_m=_CENTER_M,
                    reach_m=_REACH_M,
                    half_m=(DISC_RADIUS_M,) * 2 if kind == _DISC else half_m,
                    yaw_range_rad=(0.0, np.pi / 2) if kind != _PEG else (np.pi / 4, 3 * np.pi / 4),
                    obstacles=[] if kind in (_DISC, _TARGET) else taken,
                    gap_m=_GAP_M,
                )
            height_m = {
                _BUTTON: 0.0,
                _CONTAINER: EMPTY_Z_M,
                _TARGET: TARGET_THICKNESS_M,
                _DISC: 0.001,
                _PEG: PEG_HALF_WIDTH_M,
            }.get(kind, CUBE_HALF_M)
            physics.place(name, pose(*spot.center_m, height_m, spot.yaw_rad))
            if kind not in (_DISC, _TARGET):
                taken.append(spot)
            if kind < len(_COLORS):
                cubes.append(spot)
        physics.refresh()
        return names

    def _pose_arm(self, rng: np.random.Generator, placed: list[str]) -> None:
        """Puts the tool near one of the things more often than not, now and then with a cube in its grip."""
        physics = self.physics
        is_near = bool(placed) and rng.random() < 0.6
        if is_near:
            target = transform(physics.pose(placed[int(rng.integers(len(placed)))]))
            yaw_rad = float(np.arctan2(target[1, 0], target[0, 0])) + rng.normal(0, 0.3)
            z_m = float(rng.uniform(0.015, 0.25))
            spread_m = 0.01 + 0.15 * z_m
            xyz_m = np.array([*(target[:2, 3] + rng.normal(0, spread_m, 2)), z_m])
        else:
            yaw_rad = float(rng.uniform(-np.pi / 4, np.pi / 4))
            xyz_m = rng.uniform((-0.32, -0.3, 0.03), (0.12, 0.3, 0.35))
        quarter = np.pi / 4
        T = transform(pose(0.0, 0.0, 0.0, (yaw_rad + quarter) % (2 * quarter) - quarter)) @ self._upright
        T[:3, 3] = xyz_m
        joints = self._kinematics.solve(T, HOME_QPOS)
        held = [name for name in placed if int(name[0]) < len(_COLORS)]
        is_held = bool(held) and not is_near and rng.random() < 0.3
        opening_m = CUBE_HALF_M if is_held else HOME_OPENING_M * float(rng.choice([0.0, 0.5, 1.0], p=[0.3, 0.1, 0.6]))
        physics.pose_arm(joints, opening_m)
        if is_held:
            tool = self._kinematics.tcp(joints)
            yaw_rad = float(np.arctan2(tool[1, 1], tool[0, 1]))
            x_m, y_m, z_m = tool[:3, 3] + rng.normal(0, 0.004, 3)
            physics.place(held[0], pose(x_m, y_m, z_m, yaw_rad))
        physics.refresh()

    def _labelled(self, name: str, sights: dict[str, NDArray[np.int32]]) -> Thing:
        physics, kind = self.physics, int(name[0])
        body = physics.model.body(name).id
        own = np.flatnonzero(physics.model.body_rootid[physics.model.geom_bodyid] == body)
        position_m = physics.position_m(name)
        seen = {}
        for camera, geoms in sights.items():
            if np.isin(geoms, own).sum() < _MIN_SEEN_PX:
                continue
            K, Rt = sight.intrinsic(physics, camera, self._px), sight.extrinsic(physics, camera)
            if (Rt[:, :3] @ position_m + Rt[:, 3])[2] < 0.02:
                continue
            ((x, y),) = sight.project(K, Rt, position_m[None]) / self._px
            row, column = placed_in(WINDOWS[camera], (y, x))
            if 0 <= row < 1 and 0 <= column < 1:
                seen[camera] = (float(row), float(column))
        T = transform(physics.pose(name))
        axis = max(T[:3, :3].T, key=lambda side: -abs(side[2]))
        return Thing(
            kind=kind, position_m=tuple(position_m.tolist()), yaw_rad=float(np.arctan2(axis[1], axis[0])), seen=seen
        )
