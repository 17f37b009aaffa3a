"""The tasks as Gymnasium environments: importing this module registers ``ponderpounce/<Task>-v0`` for every task.

    import gymnasium, dual_system.tasks.gymnasium_env
    env = gymnasium.make("ponderpounce/PickHighlight-v0")
    several = gymnasium.make_vec("ponderpounce/PickHighlight-v0", num_envs=4, vectorization_mode="async")

Observations: a dictionary of ``state`` (8,) and one (image_px, image_px, 3) picture per camera, seen before the action.
Actions: (8,), as `Environment.step` takes them: radians, not normalised; wrap it in ``RescaleAction`` for that.
Reward: 1 at success, else 0. The episode is terminated by success or failure and truncated by Gymnasium's own time
limit, the paper's 1300 steps unless ``make(max_episode_steps=...)`` says otherwise.

The info of `reset` has the instruction and the conditioning video, without which a memory task cannot be solved.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import IMAGE_PX, MAX_STEPS, Snapshot, make_environment
from dual_system.tasks.panda import STATE_SLACK
from dual_system.tasks.physics import CONTROL_HZ
from dual_system.tasks.scene import CAMERAS, FRONT
from dual_system.tasks.task import TaskError, task_names

try:
    import gymnasium
    from gymnasium import spaces
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "dual_system.tasks.gymnasium_env needs Gymnasium, which is not here: pip install 'ponderpounce-server[gym]'",
        name=error.name,
    ) from error

NAMESPACE = "ponderpounce"

Seen = dict[str, NDArray[Any]]

_MAX_SEED = 2**31


class TaskEnv(gymnasium.Env[Any, Any]):
    """One task. A seed given to `reset` is the seed of the same scene as in `Environment.reset`.

    Args:
        task: its registered name. Raises TaskError for an unknown one.
        image_px: side of the square pictures.
        demo_hz: how many frames a second of the conditioning video are given; a divisor of 20.
        cameras: False leaves pictures out, and with them the need for a GL context.
        render_mode: None, or "rgb_array": the front camera's picture.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}  # noqa: RUF012 - Gymnasium's own form

    def __init__(
        self,
        task: str,
        *,
        image_px: int = IMAGE_PX,
        demo_hz: int = 1,
        cameras: bool = True,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render mode {render_mode!r}; expected 'rgb_array' or None")
        if render_mode and not cameras:
            raise ValueError("render_mode='rgb_array' needs pictures; leave cameras=False out")
        self.render_mode = render_mode
        self._demo_hz = demo_hz
        self._environment = make_environment(task, image_px=image_px, render=cameras, max_steps=sys.maxsize)
        self._picture: NDArray[np.uint8] | None = None
        robot = self._environment.physics.robot
        picture = spaces.Box(0, 255, (image_px, image_px, 3), np.uint8)
        self._spaces: dict[str, spaces.Space[Any]] = dict.fromkeys(CAMERAS if cameras else (), picture)
        self._spaces["state"] = _box(robot.state_low - STATE_SLACK, robot.state_high + STATE_SLACK)
        self.observation_space = spaces.Dict(self._spaces)
        # Without a gripper the last entry moves nothing, and Gymnasium wants a space that is not flat.
        self.action_space = _box(robot.action_low, np.append(robot.action_high[:7], 1.0))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Starts an episode. Without a seed the next is drawn from the generator of the last one given.

        The only option is ``difficulty``; without it the seed decides. The info holds, besides that of `step`:
        ``instruction``, ``difficulty``, ``seed``, and ``demonstration``, a list of frames for each name of an
        observation (a vector environment joins arrays of one length only), empty where there is no video. Raises
        TaskError for other options.
        """
        super().reset(seed=seed)
        wanted = dict(options or {})
        difficulty = wanted.pop("difficulty", None)
        if wanted:
            raise TaskError(f"unknown reset options {sorted(wanted)}; the only one is 'difficulty'")
        drawn = int(self.np_random.integers(_MAX_SEED)) if seed is None else seed
        snapshot = self._environment.reset(drawn, difficulty)
        info = self._info(snapshot) | {
            "instruction": self._environment.instruction,
            "difficulty": self._environment.difficulty,
            "seed": drawn,
            "demonstration": self._demonstration(),
        }
        return self._seen(snapshot), info

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Applies an action (8,) for 50 ms. Raises as `Environment.step` does."""
        snapshot = self._environment.step(action)
        is_success = snapshot.status is Status.SUCCESS
        is_over = is_success or snapshot.status is Status.FAIL
        return self._seen(snapshot), float(is_success), is_over, False, self._info(snapshot)

    def render(self) -> NDArray[np.uint8] | None:
        """The front camera's picture (image_px, image_px, 3) of the last observation; None without a render mode."""
        if self.render_mode is None or self._picture is None:
            return None
        return self._picture.copy()

    def close(self) -> None:
        """Frees the cameras."""
        self._environment.close()

    def _seen(self, snapshot: Snapshot) -> Seen:
        self._picture = snapshot.frames.get(FRONT)
        return _observation(snapshot)

    def _info(self, snapshot: Snapshot) -> dict[str, Any]:
        """The outcome and the texts; the texts are the answer to the task's question, and not for the policy."""
        return {
            "is_success": snapshot.status is Status.SUCCESS,
            "reason": snapshot.reason,
            "simple_subgoal": snapshot.simple_subgoal,
            "grounded_subgoal": snapshot.grounded_subgoal,
            "subtask_index": snapshot.subtask_index,
        }

    def _demonstration(self) -> dict[str, list[NDArray[Any]]]:
        frames = [_observation(frame) for frame in self._environment.demonstration(self._demo_hz)]
        return {name: [frame[name] for frame in frames] for name in self._spaces}


def environment_id(task: str) -> str:
    """Returns what ``gymnasium.make`` calls a task."""
    return f"{NAMESPACE}/{task}-v0"


def _observation(snapshot: Snapshot) -> Seen:
    return {"state": snapshot.state, **snapshot.frames}


def _box(low: NDArray[np.float64], high: NDArray[np.float64]) -> spaces.Box[Any]:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32))


for _name in task_names():
    gymnasium.register(
        environment_id(_name),
        entry_point=f"{__name__}:{TaskEnv.__name__}",
        max_episode_steps=MAX_STEPS,
        kwargs={"task": _name},
    )
