"""Import this before mujoco: without a display, MuJoCo must be told to render through EGL when it is first imported."""

import os
import sys

if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:
    os.environ["MUJOCO_GL"] = "egl"  # MUJOCO_GL=osmesa works as well, glfw needs a display
