"""A model server of the published vla-eval 0.8 as POUNCE: its own server code, with a policy of ours."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from pounce_server.contract import example_request
from pounce_server.remote.engine import RemoteEngine
from pounce_server.remote.vla_eval import VlaEvalPeer
from protocol.messages import ObservationWindow
from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt

anyio = pytest.importorskip("anyio", reason="pip install vla-eval==0.8.0")
predict = pytest.importorskip("vla_eval.model_servers.predict", reason="pip install vla-eval==0.8.0")


def model_of(chunk_size: int | None, script: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """A policy whose row k is the state plus k hundredths."""

    class Model(predict.PredictModelServer):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(chunk_size=chunk_size)
            self.seen: list[dict[str, Any]] = []

        def get_action_spec(self) -> dict[str, Any]:
            return {}

        def get_observation_spec(self) -> dict[str, Any]:
            return {}

        def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
            self.seen.append(obs)
            if script is not None:
                return script(obs)
            return {"actions": np.asarray(obs["states"])[None] + 0.01 * np.arange(20)[:, None]}

    return Model()


@pytest.fixture
def serving() -> Callable[[Any], Any]:
    @contextmanager
    def serve(model: Any) -> Iterator[str]:
        from vla_eval.model_servers.serve import serve_async

        bound: list[int] = []
        is_bound, ends = threading.Event(), []

        async def run() -> None:
            async with anyio.create_task_group() as group:
                bound.append(await group.start(serve_async, model, "127.0.0.1", 0))
                ends.append((anyio.lowlevel.current_token(), group.cancel_scope.cancel))
                is_bound.set()

        thread = threading.Thread(target=anyio.run, args=(run,), daemon=True)
        thread.start()
        assert is_bound.wait(20)
        try:
            yield f"ws://127.0.0.1:{bound[0]}"
        finally:
            token, cancel = ends[0]
            anyio.from_thread.run_sync(cancel, token=token)
            thread.join(10)

    return serve


@pytest.fixture(scope="module")
def named(mapping: PolicyMapping) -> PolicyMapping:
    """The same robot with the harness's names."""
    return dataclasses.replace(
        mapping,
        prompt=Prompt(key=("task_description",), text="{subgoal}"),
        cameras=(
            Camera(camera="front", key=("images", "agentview")), Camera(camera="wrist", key=("images", "wrist")),
        ),
        state=(Numbers(key=("states",), columns=(0, 1, 2), dims=(0, 1, 2)),),
    )  # fmt: skip


def engine_of(url: str, mapping: PolicyMapping) -> RemoteEngine:
    return RemoteEngine(VlaEvalPeer(url, mapping), mapping, url, answer_s=5, start_s=10)


@pytest.mark.parametrize("chunk_size", [20, None], ids=["a row at a time", "whole chunks"])
def test_rows_are_the_policys(serving: Any, named: PolicyMapping, chunk_size: int | None) -> None:
    model = model_of(chunk_size)
    with serving(model) as url:
        engine = engine_of(url, named)
        request = dataclasses.replace(
            example_request(engine.spec, frame_px=8), previous_rows=None, committed_rows=0, subgoal="go on",
            proprio=np.array([0.1, 0.2, 0.3], np.float32),
        )  # fmt: skip
        for _ in range(2):
            rows = engine.invoke(request)
            np.testing.assert_allclose(rows[:, 1], 0.2 + 0.01 * np.arange(20), atol=1e-6)
    assert len(model.seen) == 3  # the first answer, and one inference for each invocation
    assert (model.seen[-1]["task_description"], sorted(model.seen[-1]["images"])) == ("go on", ["agentview", "wrist"])


def test_an_episode_begins_with_an_empty_buffer(
    serving: Any, named: PolicyMapping, episode_info: Callable[..., Any], paper: Any
) -> None:
    model = model_of(7)  # 20 rows leave one of the third chunk in its buffer
    with serving(model) as url:
        engine = engine_of(url, named)
        engine.begin(episode_info(paper))
        engine.invoke(example_request(engine.spec, frame_px=8))
    assert len(model.seen) == 6


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"actions": np.zeros((20, 7))}, r"\(20, 7\) float32; test expects \(20, 3\)"),
        ({"actions": np.zeros((16, 3))}, r"\(16, 3\)"),
        ({"actions": np.full((20, 3), np.nan)}, "nan in row 0"),
        ({"pose": 1}, "expected actions, came none"),
    ],
)
def test_another_first_answer_is_refused(serving: Any, named: PolicyMapping, answer: Any, said: str) -> None:
    with serving(model_of(None, lambda obs: answer)) as url, pytest.raises(ValueError, match=said):
        engine_of(url, named)


def test_what_the_server_says_of_an_error_is_told(serving: Any, named: PolicyMapping) -> None:
    def fail(obs: dict[str, Any]) -> Any:
        raise KeyError("wrist_image")

    with (
        serving(model_of(None, fail)) as url,
        pytest.raises(ValueError, match=r"it says: observation_failed: KeyError"),
    ):
        engine_of(url, named)


def test_another_protocol_is_refused(openpi_server: Any, named: PolicyMapping) -> None:
    with pytest.raises(ValueError, match=r"expected a message with type and payload, as vla-eval 0\.8 sends them"):
        engine_of(openpi_server.url, named)


def test_a_window_is_refused(named: PolicyMapping) -> None:
    with pytest.raises(ValueError, match=r"keep their own history.*leave \[window\] out"):
        VlaEvalPeer("ws://127.0.0.1:9", dataclasses.replace(named, window=ObservationWindow(state_ticks=(-1, 0))))
