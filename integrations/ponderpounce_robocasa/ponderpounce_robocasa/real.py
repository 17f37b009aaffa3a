"""Builds the environment of the authors' fork of RoboCasa. Not run here: nothing of it can be installed from PyPI.

Whoever builds it otherwise writes a function with these arguments and names it with --environment.
"""

from __future__ import annotations

from typing import Any

from ponderpounce_robocasa import layout


def make(task: str, seed: int) -> Any:
    """RoboCasa's environment of a task with PandaOmron, OSC_POSE, and the three cameras at 128 px.

    Raises ImportError without the fork, Unfit for RoboCasa365.
    """
    import robocasa
    from robocasa.utils.eval_utils import create_eval_env

    version = str(getattr(robocasa, "__version__", "0"))
    if not version.startswith("0."):
        raise layout.Unfit(f"robocasa {version} is RoboCasa365; RoboCasa-DC is the fork of 0.2")
    env = create_eval_env(
        env_name=task,
        robots="PandaOmron",
        controllers="OSC_POSE",
        camera_names=[name[: -len("_image")] for name in layout.CAMERAS.values()],
        camera_widths=layout.PX,
        camera_heights=layout.PX,
        seed=seed,
    )
    env.modify_observable("robot0_joint_pos", "active", True)
    return env
