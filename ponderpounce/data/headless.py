"""Import this before anything that imports mujoco: a computer without a display renders through EGL."""

import os
import sys

if sys.platform == "linux":
    os.environ.setdefault("MUJOCO_GL", "egl")  # MUJOCO_GL=osmesa works as well
