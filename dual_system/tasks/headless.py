"""Import this before mujoco: without a display, MuJoCo must be set to EGL rendering before its first import."""

import os
import sys

if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:
    os.environ["MUJOCO_GL"] = "egl"  # MUJOCO_GL=osmesa works as well, glfw needs a display
