"""vla-eval's own connection and runners, as published, against the gateway: sync, live, and when it is refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import anyio
import numpy as np
import pytest

from clock import schedules
from protocol import messages as m
from sim_client.gateway import vla_eval as dialect
from sim_client.gateway.websocket import WebsocketSide

pytest.importorskip("vla_eval", reason="pip install vla-eval==0.8.0")

from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.connection import Connection
from vla_eval.runners.base import ModelActError
from vla_eval.runners.live_runner import LiveEpisodeRunner
from vla_eval.runners.sync_runner import SyncEpisodeRunner

NUM_STEPS = 25
MAX_BYTES = 1 << 20


class Numbers(StepBenchmark):  # type: ignore[misc]
    """Three joints that go where they are commanded, two pictures of one shade, and a video of 41 frames."""

    def __init__(self, picture_of: Callable[[int], np.ndarray]) -> None:
        super().__init__()
        self._picture_of = picture_of
        self.played: list[np.ndarray] = []

    def get_tasks(self) -> list[Any]:
        return [{"name": "Numbers"}]

    def reset(self, task: Any) -> Any:
        self.played = []
        return np.zeros(3, np.float32)

    def step(self, action: Any) -> Any:
        self.played.append(np.asarray(action["actions"]))
        return StepResult(obs=self.played[-1], reward=0.0, done=len(self.played) >= NUM_STEPS, info={})

    def make_obs(self, raw_obs: Any, task: Any) -> Any:
        picture = self._picture_of(len(self.played))
        seen = {"images": {"a": picture, "b": picture}, "states": raw_obs, "task_description": "count"}
        return seen if self.played else seen | {"video_history": [picture] * 41}

    def get_step_result(self, step_result: Any) -> Any:
        return {"success": True}

    def get_hold_action(self, last_action: Any) -> Any:
        return last_action or {"actions": np.zeros(3, np.float32)}


@pytest.fixture
def gateway(
    bench_with: Callable[..., Any], terms_with: Callable[..., Any], working: Callable[..., Any],
    listening: Callable[..., Any],
) -> Iterator[Callable[..., Any]]:  # fmt: skip
    """Opens a gateway with a schedule; returns its bench and its address."""
    open_blocks: list[Any] = []

    def start(schedule: m.Schedule) -> tuple[Any, str]:
        bench = bench_with(schedule)
        terms = terms_with(cameras=dialect.CAMERAS, state_key="states", mode=schedule.mode)
        blocks = [
            working(bench.machine),
            listening(WebsocketSide(bench.machine, terms, dialect.VlaEvalDialect, MAX_BYTES)),
        ]
        open_blocks.extend(blocks)
        _, port = (block.__enter__() for block in blocks)
        return bench, f"ws://127.0.0.1:{port}"

    yield start
    for block in reversed(open_blocks):
        block.__exit__(None, None, None)


def run_with(runner: Any, benchmark: Numbers, url: str, **changes: Any) -> Any:
    async def run() -> Any:
        async with Connection(url, timeout=20.0) as connection:
            return await runner.run_episode(benchmark, {"name": "Numbers"}, connection, **changes)

    return anyio.run(run)


def test_the_sync_runner_plays_what_the_clock_commands(gateway: Callable[..., Any], picture_of: Any) -> None:
    bench, url = gateway(schedules.paper())
    demos: list[int] = []
    open_engine = bench.rig.ponder_engine.open
    bench.rig.ponder_engine.open = lambda session, opening, progress: (
        demos.append(len(opening.demo_frames)),
        open_engine(session, opening, progress),
    )[1]
    episodes = []
    for _ in range(2):  # a connection each, one after the other
        benchmark = Numbers(picture_of)
        result = run_with(SyncEpisodeRunner(), benchmark, url)
        assert (result["steps"], result["metrics"]) == (NUM_STEPS, {"success": True})
        assert benchmark.played[0].shape == (3,)
        episodes.append(np.stack(benchmark.played))
    assert demos == [3, 3]
    assert not np.array_equal(*episodes)  # each with noise of its own


def test_the_live_runner_is_answered_while_it_goes_on(gateway: Callable[..., Any], picture_of: Any) -> None:
    _, url = gateway(schedules.realtime())
    benchmark = Numbers(picture_of)
    result = run_with(LiveEpisodeRunner(hz=100.0, wait_first_action=True), benchmark, url)
    assert result["steps"] == NUM_STEPS
    assert result["rt_metrics"]["update_count"] > 0
    assert len({row.tobytes() for row in benchmark.played}) > 1


def test_a_runner_of_the_other_mode_is_told_how_to_start_us(gateway: Callable[..., Any], picture_of: Any) -> None:
    _, url = gateway(schedules.realtime())
    with pytest.raises(ModelActError, match="start pp-gateway with --mode lockstep"):
        run_with(SyncEpisodeRunner(), Numbers(picture_of), url)
