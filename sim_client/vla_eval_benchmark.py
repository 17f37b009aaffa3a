"""Our tasks as a benchmark of ``vla-eval``: what its model servers can be scored on, unchanged.

In its configuration: ``benchmark: "sim_client.vla_eval_benchmark:TableBenchmark"``. Observations have the keys of that
harness's own RoboMME benchmark, so a server made for it needs no change. vla-eval 0.8 is needed to import this module,
and nothing else here imports it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec

from sim_client import action_spaces
from sim_client.action_spaces import ActionSpace

if TYPE_CHECKING:
    from dual_system.tasks.environment import Environment, Snapshot

# MuJoCo chooses its renderer when it is first imported, and vla-eval says which one only after it has imported this
# module: nothing above this line may import it.


class TableBenchmark(StepBenchmark):  # type: ignore[misc]  # untyped where vla-eval is not installed
    """Simulated memory tasks in the manner of RoboMME, on MuJoCo, at 20 Hz.

    Episode i of a task has seed ``seed + i``. A conditioning video, where the task has one, comes with the first
    observation, at 20 Hz.

    Args:
        tasks: names of tasks; None is all that there are.
        action_space: what the model server's actions mean, see ``sim_client.action_spaces``.
        difficulty: easy, medium or hard; None is by seed, as the benchmark does.
        max_steps: of an episode; the paper's limit is 1300.
        send_subgoal: also send the text of the current subtask, which no policy can know from itself.
    """

    render_backends = frozenset({"gpu", "cpu"})
    _ALL_RECORD_FIELDS = frozenset({"simple_subgoal_online", "grounded_subgoal_online", "status", "state", "action"})

    def __init__(
        self,
        tasks: list[str] | None = None,
        action_space: ActionSpace = "joint_angle",
        difficulty: str | None = None,
        seed: int = 0,
        max_steps: int = 1300,
        send_wrist_image: bool = True,
        send_state: bool = True,
        send_video_history: bool = True,
        send_subgoal: bool = False,
        subgoal_mode: Literal["grounded", "simple"] = "grounded",
    ) -> None:
        super().__init__()
        from dual_system.tasks.task import make_task, task_names

        self._names = tuple(tasks) if tasks is not None else task_names()
        for name in self._names:
            make_task(name)  # a mistyped name before the first episode
        self._reader = action_spaces.reader(action_space)
        self._action_space, self._difficulty, self._seed, self._max_steps = action_space, difficulty, seed, max_steps
        self._sends = {"wrist": send_wrist_image, "state": send_state, "subgoal": send_subgoal}
        self._sends_video = send_video_history
        self._subgoal_mode = subgoal_mode
        self._environment: Environment | None = None
        self._name = ""
        self._shows_video = False

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """EGL on a GPU, OSMesa without one; a choice made in MUJOCO_GL stays."""
        backend = os.environ.setdefault("MUJOCO_GL", "egl" if mode == "gpu" else "osmesa")
        return {"MUJOCO_GL": backend}

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": name, "env_id": name} for name in self._names]

    def reset(self, task: dict[str, Any]) -> Snapshot:
        from dual_system.tasks.environment import make_environment
        from dual_system.tasks.seeds import require_open

        if self._environment is None or task["name"] != self._name:  # a scene takes a second to build
            self.cleanup()
            self._name = task["name"]
            self._environment = make_environment(self._name, max_steps=self._max_steps)
        seed = self._seed + int(task.get("episode_idx", 0))
        require_open(seed, "give a benchmark's seed below 500000")
        snapshot = self._environment.reset(seed, self._difficulty)
        self._shows_video = self._sends_video
        self._recorder.record_video(snapshot.frames["front"])
        return snapshot

    def step(self, action: dict[str, Any]) -> StepResult:
        environment = self._opened()
        before = self._last_result.obs
        command = self._reader(action_spaces.row_of(action), before.state, environment.physics.model)
        snapshot = environment.step(command)
        self._recorder.record_video(snapshot.frames["front"])
        self._recorder.record_step(
            simple_subgoal_online=snapshot.simple_subgoal,
            grounded_subgoal_online=snapshot.grounded_subgoal,
            status=snapshot.status.value,
            state=snapshot.state.tolist(),
            action=command.tolist(),
        )
        done = snapshot.status.value != "ongoing"
        return StepResult(obs=snapshot, reward=float(snapshot.status.value == "success"), done=done, info={})

    def make_obs(self, raw_obs: Snapshot, task: dict[str, Any]) -> dict[str, Any]:
        environment = self._opened()
        observation: dict[str, Any] = {
            "images": {"agentview": raw_obs.frames["front"]},
            "task_description": environment.instruction,
        }
        if self._sends["wrist"]:
            observation["images"]["wrist"] = raw_obs.frames["wrist"]
        if self._sends["state"]:
            observation["states"] = raw_obs.state
        if self._sends["subgoal"]:
            is_simple = self._subgoal_mode == "simple"
            observation["subgoal"] = raw_obs.simple_subgoal if is_simple else raw_obs.grounded_subgoal
        if self._shows_video:
            observation |= self._video(environment.demonstration())
        return observation

    def _video(self, frames: Iterable[Snapshot]) -> dict[str, Any]:
        """The conditioning video, once per episode; nothing for a task without one."""
        self._shows_video = False
        shown = [frame.frames for frame in frames]
        if not shown:
            return {}
        video: dict[str, Any] = {"video_history": [views["front"] for views in shown], "episode_restart": True}
        if self._sends["wrist"]:
            video["wrist_video_history"] = [views["wrist"] for views in shown]
        return video

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        snapshot: Snapshot = step_result.obs
        return {"success": snapshot.status.value == "success", "status": snapshot.status.value}

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """A live runner's command when the model has no new one: the last targets, or the arm's pose."""
        from dual_system.tasks.panda import HOME_QPOS

        snapshot: Snapshot | None = self._last_result.obs
        joints: NDArray[Any] = HOME_QPOS if snapshot is None else snapshot.state[:7]
        return action_spaces.hold(self._action_space, last_action, joints)

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": self._max_steps, "action_space": self._action_space}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"action": RAW}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        specs = {"agentview": IMAGE_RGB, "language": LANGUAGE, "wrist": IMAGE_RGB, "state": RAW, "subgoal": LANGUAGE}
        return {name: spec for name, spec in specs.items() if self._sends.get(name, True)}

    def render(self) -> NDArray[np.uint8] | None:
        snapshot: Snapshot | None = self._last_result.obs
        return None if snapshot is None else snapshot.frames["front"]

    def cleanup(self) -> None:
        if self._environment is not None:
            self._environment.close()
            self._environment = None

    def _opened(self) -> Environment:
        assert self._environment is not None, "step before start_episode"
        return self._environment
