"""RoboMME on the ManiSkill that PyPI has, in place of its authors' fork, which is not published there.

The benchmark needs two things of the fork. Both robots have a hand camera of 256 px (the published Panda's has 128 px,
its Panda with a stick has none), and the stick's motion planner can be made (the published one passes its base class
one argument too many). ``complete`` puts both in place; the configuration of vla-eval names the class.
"""

from __future__ import annotations

from typing import Any

from vla_eval.benchmarks.robomme.benchmark import RoboMMEBenchmark


class RoboMME(RoboMMEBenchmark):
    """vla-eval's own benchmark: nothing is changed but the robots, once the renderer has been chosen."""

    def reset(self, task: Any) -> Any:
        complete()
        return super().reset(task)


def complete() -> None:
    """Completes ManiSkill's robots. Imports the simulator, which binds its renderer."""
    import numpy as np
    import sapien
    from mani_skill.agents.robots.panda.panda_stick import PandaStick
    from mani_skill.agents.robots.panda.panda_wristcam import PandaWristCam
    from mani_skill.examples.motionplanning.base_motionplanner.motionplanner import BaseMotionPlanningSolver
    from mani_skill.examples.motionplanning.panda.motionplanner_stick import PandaStickMotionPlanningSolver
    from mani_skill.sensors.camera import CameraConfig

    def hand_camera(robot: Any) -> list[CameraConfig]:
        half = np.sqrt(0.5)
        return [
            CameraConfig(
                uid="hand_camera",
                pose=sapien.Pose(p=[0.0464982, -0.0200011, 0.0360011], q=[0.0, half, 0.0, half]),
                width=256,
                height=256,
                fov=np.pi / 2,
                near=0.01,
                far=100,
                mount=robot.robot.links_map["panda_hand"],
            )
        ]

    def make_planner(
        self: Any, env: Any, debug: bool = False, vis: bool = True, base_pose: Any = None,
        visualize_target_grasp_pose: bool = True, print_env_info: bool = True,
        joint_vel_limits: float = 0.9, joint_acc_limits: float = 0.9,
    ) -> None:  # fmt: skip
        limits = joint_vel_limits, joint_acc_limits
        BaseMotionPlanningSolver.__init__(self, env, debug, vis, base_pose, print_env_info, *limits)

    for robot in (PandaWristCam, PandaStick):
        robot._sensor_configs = property(hand_camera)
    PandaStickMotionPlanningSolver.__init__ = make_planner
