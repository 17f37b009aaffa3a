"""The tasks as Gymnasium environments: its own checker is content, and nothing that a task needs is lost on the way."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dual_system.tasks import gymnasium_env, panda
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment
from dual_system.tasks.gymnasium_env import TaskEnv, environment_id
from dual_system.tasks.task import TaskError, task_names

EnvironmentOf = Callable[[str], Environment]
SEED = 7
HOME = np.append(panda.HOME_QPOS, 1.0).astype(np.float32)


@pytest.fixture(scope="module")
def blind() -> Iterator[gymnasium.Env]:
    env = gymnasium.make(environment_id("PickHighlight"), cameras=False)
    yield env
    env.close()


@pytest.mark.sim
def test_what_was_closed_opens_its_cameras_again_at_reset() -> None:
    env = gymnasium.make(environment_id("PickHighlight"), image_px=64).unwrapped
    env.close()
    env.close()
    observation, _ = env.reset(seed=SEED)
    env.close()
    assert env.observation_space.contains(observation)


SEVERAL = """
import sys, warnings
import gymnasium, numpy as np
import dual_system.tasks.gymnasium_env

warnings.simplefilter("ignore")
has_drawn, context = sys.argv[1] == "drawn", sys.argv[2]
name = "dual_system.tasks.gymnasium_env:ponderpounce/PatternLock-v0"
if __name__ == "__main__":
    if has_drawn:
        gymnasium.make(name, image_px=16).reset(seed=1)
    each = gymnasium.make_vec(name, 2, "async", vector_kwargs={"context": context}, image_px=16)
    seen, info = each.reset(seed=[0, 1])
    lengths = [len(frames) for frames in info["demonstration"]["front"]]
    seen, *_ = each.step(each.action_space.sample())
    print(seen["front"].shape, len(set(lengths)), int(np.ptp(seen["front"])) > 0)
    each.close()
"""


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "context", "said"),
    [
        ("new", "fork", "(2, 16, 16, 3) 2 True"),
        ("drawn", "fork", ""),
        pytest.param("drawn", "spawn", "(2, 16, 16, 3) 2 True", marks=pytest.mark.acceptance),
    ],
)
def test_several_in_processes_of_their_own_draw_whatever_is_set(
    tmp_path: Path, before: str, context: str, said: str
) -> None:
    (tmp_path / "several.py").write_text(SEVERAL)
    command = [sys.executable, str(tmp_path / "several.py"), before, context]
    unset = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    ran = subprocess.run(command, env=unset, capture_output=True, text=True, timeout=120, check=False)
    assert ran.stdout.strip() == said
    assert said or 'context="spawn"' in ran.stderr


def test_every_task_is_registered() -> None:
    ours = {id_ for id_ in gymnasium.registry if id_.startswith("ponderpounce/")}
    assert ours == {environment_id(name) for name in task_names()}
    assert environment_id("PickHighlight") == "ponderpounce/PickHighlight-v0"


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")  # ours is in radians
def test_the_checker_is_content() -> None:
    env = gymnasium.make(environment_id("PickHighlight"), image_px=32, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.parametrize("name", ["PickXtimes", "VideoUnmask", "PatternLock"])
def test_the_checker_is_content_without_cameras(name: str) -> None:
    env = gymnasium.make(environment_id(name), cameras=False)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_it_walks_the_same_trajectory_as_our_own_interface(environment: EnvironmentOf, blind: gymnasium.Env) -> None:
    ours = environment("PickHighlight")
    observed, info = blind.reset(seed=SEED, options={"difficulty": "easy"})
    snapshot = ours.reset(SEED, "easy")
    assert info["instruction"] == ours.instruction
    assert (info["seed"], info["difficulty"]) == (SEED, "easy")
    rewards = []
    for action in ours.oracle():
        snapshot = ours.step(action)
        observed, reward, terminated, truncated, info = blind.step(action)
        np.testing.assert_array_equal(observed["state"], snapshot.state)
        assert info["grounded_subgoal"] == snapshot.grounded_subgoal
        assert (terminated, truncated) == (snapshot.status is not Status.ONGOING, False)
        rewards.append(reward)
        if terminated:
            break
    assert info["is_success"]
    assert rewards == [0.0] * (len(rewards) - 1) + [1.0]


def test_without_a_seed_another_scene_is_drawn_and_can_be_drawn_again(blind: gymnasium.Env) -> None:
    seeds = []
    for given in (SEED, None, None, SEED, None):
        _, info = blind.reset(seed=given)
        seeds.append(info["seed"])
    assert len(set(seeds[:3])) == 3
    assert seeds[3:] == seeds[:2]


def test_the_conditioning_video_is_given(environment: EnvironmentOf) -> None:
    ours = environment("VideoUnmask")
    ours.reset(SEED)
    states = [frame.state for frame in ours.demonstration(2)]
    env = TaskEnv("VideoUnmask", cameras=False, demo_hz=2)
    _, info = env.reset(seed=SEED)
    np.testing.assert_array_equal(info["demonstration"]["state"], states)


def test_no_video_is_an_empty_one(blind: gymnasium.Env) -> None:
    _, info = blind.reset(seed=SEED)
    assert info["demonstration"] == {"state": []}


@pytest.mark.sim
def test_the_pictures_are_those_of_the_cameras() -> None:
    env = TaskEnv("VideoUnmask", image_px=32, render_mode="rgb_array")
    observed, info = env.reset(seed=SEED)
    assert set(observed) == {"state", "front", "wrist"}
    assert np.shape(info["demonstration"]["front"]) == (4, 32, 32, 3)
    picture = env.render()
    assert picture is not None
    np.testing.assert_array_equal(picture, observed["front"])
    env.close()


def test_the_time_limit_is_gymnasium_s() -> None:
    env = gymnasium.make(environment_id("PickHighlight"), cameras=False, max_episode_steps=3)
    env.reset(seed=SEED)
    assert [env.step(HOME)[2:4] for _ in range(3)] == [(False, False), (False, False), (False, True)]
    assert gymnasium.spec(environment_id("PickHighlight")).max_episode_steps == 1300
    env.close()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"render_mode": "human"}, "unknown render mode 'human'"),
        ({"render_mode": "rgb_array", "cameras": False}, "needs pictures"),
    ],
)
def test_what_cannot_be_rendered_is_refused(arguments: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        TaskEnv("PickHighlight", **arguments)


def test_an_unknown_option_is_refused(blind: gymnasium.Env) -> None:
    with pytest.raises(TaskError, match=r"unknown reset options \['level'\]; the only one is 'difficulty'"):
        blind.reset(seed=SEED, options={"level": "hard"})


def test_without_gymnasium_the_way_out_is_named() -> None:
    script = f"import sys; sys.modules['gymnasium'] = None; import {gymnasium_env.__name__}"
    completed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "pip install 'ponderpounce-server[gym]'" in completed.stderr
