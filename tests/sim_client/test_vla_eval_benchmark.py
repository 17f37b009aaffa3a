"""Our tasks as vla-eval sees them, driven as its runners do; one model server of its own is scored on them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_system.tasks.seeds import SeedError
from dual_system.tasks.task import TaskError, task_names

pytest.importorskip("vla_eval", reason="pip install vla-eval==0.8.0")

from sim_client.vla_eval_benchmark import TableBenchmark

pytestmark = [
    pytest.mark.sim,
    pytest.mark.filterwarnings("ignore::DeprecationWarning:anyio.*"),
]
HAS_VIDEO, HAS_NONE = "VideoUnmask", "PickHighlight"


@pytest.fixture
def benchmark_of() -> Any:
    made: list[TableBenchmark] = []

    def make(**params: Any) -> TableBenchmark:
        made.append(TableBenchmark(**params))
        return made[-1]

    yield make
    for benchmark in made:
        benchmark.cleanup()


def first_observation(benchmark: TableBenchmark, name: str, episode: int = 0) -> dict[str, Any]:
    async def start() -> dict[str, Any]:
        await benchmark.start_episode({"name": name, "env_id": name, "episode_idx": episode})
        return await benchmark.get_observation()

    return asyncio.run(start())


def test_all_tasks_are_offered_and_a_mistyped_one_is_refused() -> None:
    assert [task["name"] for task in TableBenchmark().get_tasks()] == list(task_names())
    with pytest.raises(TaskError, match="Did you mean"):
        TableBenchmark(tasks=["PickHighlights"])


def test_the_video_comes_once_and_only_where_there_is_one(benchmark_of: Callable[..., TableBenchmark]) -> None:
    benchmark = benchmark_of()
    seen = first_observation(benchmark, HAS_VIDEO)
    assert len(seen["video_history"]) == len(seen["wrist_video_history"]) > 20
    assert seen["video_history"][0].shape == seen["images"]["agentview"].shape == (256, 256, 3)
    assert (seen["states"].shape, seen["task_description"] != "") == ((8,), True)
    assert "video_history" not in asyncio.run(benchmark.get_observation())
    assert "video_history" not in first_observation(benchmark_of(send_video_history=False), HAS_VIDEO)
    assert "video_history" not in first_observation(benchmark, HAS_NONE)


def test_an_episode_number_is_a_scene(benchmark_of: Callable[..., TableBenchmark]) -> None:
    benchmark = benchmark_of(send_video_history=False)
    shown = [first_observation(benchmark, HAS_NONE, episode)["images"]["agentview"] for episode in (0, 1, 0)]
    assert np.array_equal(shown[0], shown[2])
    assert not np.array_equal(shown[0], shown[1])


def test_what_was_not_asked_for_is_not_sent(benchmark_of: Callable[..., TableBenchmark]) -> None:
    bare = benchmark_of(send_wrist_image=False, send_state=False)
    assert set(first_observation(bare, HAS_NONE)) == {"images", "task_description"}
    assert set(bare.get_observation_spec()) == {"agentview", "language"}
    told = first_observation(benchmark_of(send_subgoal=True, subgoal_mode="simple"), HAS_NONE)
    assert told["subgoal"] == "press the button"


def test_before_any_action_the_arm_is_held_where_it_is(benchmark_of: Callable[..., TableBenchmark]) -> None:
    benchmark = benchmark_of()
    assert benchmark.get_hold_action(None)["actions"].shape == (8,)  # asked before the first episode as well
    seen = first_observation(benchmark, HAS_NONE)
    assert benchmark.get_hold_action(None)["actions"][:7] == pytest.approx(seen["states"][:7])


def test_vla_eval_scores_a_model_server_of_its_own(tmp_path: Path) -> None:
    """The published baseline server answers zeros, here of 8 numbers; two tasks, a few steps each."""
    import anyio
    from vla_eval.model_servers.behavior1k_baseline import Behavior1KBaselineModelServer
    from vla_eval.model_servers.serve import serve_async
    from vla_eval.orchestrator import Orchestrator

    tasks = [HAS_NONE, HAS_VIDEO]

    async def score() -> list[dict[str, Any]]:
        async with anyio.create_task_group() as group:
            port = await group.start(serve_async, Behavior1KBaselineModelServer(8), "127.0.0.1", 0)
            entry = {
                "benchmark": "sim_client.vla_eval_benchmark:TableBenchmark",
                "params": {"tasks": tasks, "max_steps": 6, "seed": 0},
            }
            config = {
                "server": {"url": f"ws://127.0.0.1:{port}"},
                "output_dir": str(tmp_path),
                "benchmarks": [entry],
            }
            results = await Orchestrator(config, no_save=True).run()
            group.cancel_scope.cancel()
        return results

    (result,) = anyio.run(score)
    assert [(task["task"], len(task["episodes"])) for task in result["tasks"]] == [(name, 1) for name in tasks]
    for task in result["tasks"]:
        (episode,) = task["episodes"]
        assert (episode["steps"], episode["metrics"]["status"]) == (6, "timeout")


def test_a_test_scene_is_refused(benchmark_of: Callable[..., TableBenchmark]) -> None:
    with pytest.raises(SeedError, match="seed 800001 is of the test split"):
        benchmark_of(seed=800_000).reset({"name": HAS_NONE, "episode_idx": 1})
