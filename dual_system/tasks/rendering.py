"""Pictures of a world: all its cameras through one renderer."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks import headless
from dual_system.tasks.scene import CAMERAS
from protocol.errors import CommandError

_UNSEEN_GROUPS = (0, 3, 4, 5)  # 0 holds the arm's collision shapes
_SETTINGS = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID")


class RenderingError(CommandError):
    """There is no GL context as the environment's variables want it, or none in this process."""


class Drawn(Protocol):
    """A world that can be drawn."""

    @property
    def model(self) -> Any:
        """Its compiled model."""

    @property
    def data(self) -> Any:
        """Its state."""


class Cameras:
    """Renders one world at one size. Needs a GL context (MUJOCO_GL=egl without a display); close it after use.

    Raises RenderingError if there is none.

    Reflections, shadows and the sky are off: together with antialiasing (off in the scene) they are most of the
    cost of a software-rendered frame.
    """

    _drawing_process = 0
    """The process that drew first. Its forks inherit a GL library in use, where a new context waits for ever."""

    def __init__(self, physics: Drawn, image_px: int, names: Sequence[str] = CAMERAS) -> None:
        Cameras._drawing_process = Cameras._drawing_process or os.getpid()
        if Cameras._drawing_process != os.getpid():
            raise RenderingError(
                f"no pictures here: process {Cameras._drawing_process} has rendered and was then forked. Start "
                'processes with "spawn" (AsyncVectorEnv: context="spawn"), or before the first reset'
            )
        self._physics = physics
        self._names = tuple(names)
        self._renderer = _renderer(physics.model, image_px)
        self._options = mujoco.MjvOption()
        for group in _UNSEEN_GROUPS:
            self._options.geomgroup[group] = 0
        self._options.sitegroup[:] = 0
        for flag in (
            mujoco.mjtRndFlag.mjRND_SHADOW,
            mujoco.mjtRndFlag.mjRND_REFLECTION,
            mujoco.mjtRndFlag.mjRND_SKYBOX,
        ):
            self._renderer.scene.flags[flag] = 0

    def frames(self) -> dict[str, NDArray[np.uint8]]:
        """Returns a new (image_px, image_px, 3) RGB picture per camera name."""
        return {camera: self._render(camera) for camera in self._names}

    def segmentation(self, camera: str) -> NDArray[np.int32]:
        """Returns the id of the geom seen in each pixel (image_px, image_px), -1 where there is none."""
        self._renderer.enable_segmentation_rendering()
        picture = self._render(camera)
        self._renderer.disable_segmentation_rendering()
        return np.where(picture[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, picture[..., 0], -1)

    def close(self) -> None:
        """Frees the GL context. May be called twice."""
        self._renderer.close()

    def _render(self, camera: str) -> NDArray[np.uint8]:
        self._renderer.update_scene(self._physics.data, camera=camera, scene_option=self._options)
        return self._renderer.render().copy()


def _renderer(model: mujoco.MjModel, image_px: int) -> mujoco.Renderer:
    try:
        return mujoco.Renderer(model, height=image_px, width=image_px, max_geom=1000)
    except Exception as error:  # every backend fails in its own way
        why, frames = headless.GL_PROBLEM or f"{error}", error.__traceback__
    hook, sys.unraisablehook = sys.unraisablehook, lambda unraisable: None
    traceback.clear_frames(frames)  # a half-made GL context complains once more when it is freed
    sys.unraisablehook = hook
    found = " ".join(f"{name}={os.environ[name]}" for name in _SETTINGS if name in os.environ)
    raise RenderingError(
        f"no pictures with {found}: {why}. Unset these variables, or try MUJOCO_GL=egl or osmesa; pp-doctor says what "
        "this computer has"
    )
