"""Import this before mujoco, which chooses how to render when it is first imported: EGL unless MUJOCO_GL says another.

A choice that this computer does not have is no error here, because much works without pictures; `Cameras` raises it.
"""

import importlib
import os
import sys

if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):  # empty counts as unset
    os.environ["MUJOCO_GL"] = "egl"  # MUJOCO_GL=osmesa works as well, glfw needs a display

GL_PROBLEM = ""
"""Why mujoco is here without a renderer; "" if it has one."""

try:
    mujoco = importlib.import_module("mujoco")
    if not hasattr(mujoco, "Renderer"):  # it hides why
        importlib.import_module(f"mujoco.{os.environ.get('MUJOCO_GL', 'glfw')}")
except Exception as error:  # a name that mujoco does not know, or a library that is not installed
    GL_PROBLEM = f"{error}"
    chosen = os.environ["MUJOCO_GL"]
    os.environ["MUJOCO_GL"] = "disable"
    importlib.import_module("mujoco")
    os.environ["MUJOCO_GL"] = chosen
