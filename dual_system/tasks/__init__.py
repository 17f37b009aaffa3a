"""Memory tasks in MuJoCo. Importing this package chooses EGL on Linux, unless MUJOCO_GL says another renderer.

mujoco reads the choice when it is first imported, and its own default there needs a display.
"""

import os
import sys

if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):  # empty counts as unset
    os.environ["MUJOCO_GL"] = "egl"  # MUJOCO_GL=osmesa works as well, glfw needs a display
