"""Import this before mujoco, where a choice of GL that this computer does not have is no error.

Much works without pictures; `Cameras` raises the error.
"""

import importlib
import os

GL_PROBLEM = ""
"""Why mujoco is here without a renderer; "" if it has one."""

# Mesa's software renderer then draws in the calling thread: a picture of 128 px costs its threads more than it gives.
os.environ.setdefault("LP_NUM_THREADS", "0")

try:
    mujoco = importlib.import_module("mujoco")
    if not hasattr(mujoco, "Renderer"):  # it hides why
        importlib.import_module(f"mujoco.{os.environ.get('MUJOCO_GL', 'glfw')}")
except Exception as error:  # a name that mujoco does not know, or a library that is not installed
    GL_PROBLEM = f"{error}"
    chosen = os.environ.get("MUJOCO_GL", "")
    os.environ["MUJOCO_GL"] = "disable"
    importlib.import_module("mujoco")
    os.environ["MUJOCO_GL"] = chosen
