"""An openpi policy as POUNCE: asked by the mapping file, and never believed."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pounce_server.contract import Request, Window, example_request
from pounce_server.remote.engine import RemoteEngine
from pounce_server.remote.openpi import OpenpiPeer
from protocol.messages import ObservationWindow
from protocol.peers.mapping import Camera, PolicyMapping, Prompt

FAST_S = 0.3


def engine_of(server: Any, mapping: PolicyMapping, answer_s: float = 5.0, start_s: float = 5.0) -> RemoteEngine:
    return RemoteEngine(OpenpiPeer(server.url, mapping), mapping, server.url, answer_s=answer_s, start_s=start_s)


def request_of(engine: RemoteEngine, **changes: Any) -> Request:
    values: dict[str, Any] = {"proprio": np.array([0.1, 0.2, 0.3], np.float32)}
    return dataclasses.replace(
        example_request(engine.spec, frame_px=8), previous_rows=None, committed_rows=0, **values, **changes
    )


def test_rows_are_the_policys(openpi_server: Any, mapping: PolicyMapping) -> None:
    engine = engine_of(openpi_server, mapping)
    rows = engine.invoke(request_of(engine))
    assert (rows.dtype, rows.shape) == (np.float32, (20, 3))
    np.testing.assert_allclose(rows, np.tile([0.1, 0.2, 0.3], (20, 1)), rtol=1e-6)
    asked = openpi_server.policy.seen[-1]
    assert sorted(asked) == ["image", "prompt", "state", "wrist_image"]
    assert (asked["image"].dtype, asked["image"].shape) == (np.uint8, (8, 8, 3))


def test_the_spec_is_the_mapping_files(openpi_server: Any, mapping: PolicyMapping) -> None:
    spec = engine_of(openpi_server, mapping).spec
    assert (spec.horizon, spec.action_dim, spec.proprio_dim, spec.num_cameras) == (20, 3, 3, 2)
    assert (spec.num_carriers, spec.is_fake, spec.reads_subgoal) == (0, False, False)
    other = dataclasses.replace(mapping, digest="another")
    assert engine_of(openpi_server, other).spec.model_hash != spec.model_hash


def test_a_window_comes_stacked_with_its_masks(openpi_server: Any, mapping: PolicyMapping) -> None:
    window = ObservationWindow(video_ticks=(-1, 0), state_ticks=(-2, -1, 0))
    windowed = dataclasses.replace(mapping, window=window, video_pad=("is_pad",), state_pad=("pads", "state"))
    openpi_server.policy.script = lambda seen: {"actions": np.zeros((20, 3), np.float32)}
    engine = engine_of(openpi_server, windowed)
    past, now = (np.full((8, 8, 3), shade, np.uint8) for shade in (3, 9))
    seen = Window(
        frames=((past, now), (now, past)), states_TP=np.arange(9, dtype=np.float32).reshape(3, 3),
        is_video_padded_T=np.array([True, False]), is_state_padded_T=np.array([True, True, False]),
    )  # fmt: skip
    engine.invoke(request_of(engine, window=seen))
    asked = openpi_server.policy.seen[-1]
    np.testing.assert_array_equal(asked["image"], np.stack([past, now]))
    np.testing.assert_array_equal(asked["wrist_image"], np.stack([now, past]))
    np.testing.assert_array_equal(asked["state"], seen.states_TP)
    assert (list(asked["is_pad"]), list(asked["pads"]["state"])) == ([True, False], [True, True, False])


def test_a_window_of_the_present_alone_is_asked_as_without_one(openpi_server: Any, mapping: PolicyMapping) -> None:
    plain, twin = (
        engine_of(openpi_server, dataclasses.replace(mapping, window=each)) for each in (None, ObservationWindow())
    )
    now = np.full((8, 8, 3), 9, np.uint8)
    present = np.array([0.1, 0.2, 0.3], np.float32)
    seen = Window(
        frames=((now,), (now,)), states_TP=present[None],
        is_video_padded_T=np.zeros(1, np.bool_), is_state_padded_T=np.zeros(1, np.bool_),
    )  # fmt: skip
    rows = plain.invoke(request_of(plain, frames=(now, now)))
    assert (twin.invoke(request_of(twin, frames=(now, now), window=seen)) == rows).all()
    first, second = ({k: np.asarray(v).tobytes() for k, v in each.items()} for each in openpi_server.policy.seen[-2:])
    assert first == second


def test_the_newest_subgoal_is_the_prompt(openpi_server: Any, mapping: PolicyMapping) -> None:
    reads = dataclasses.replace(mapping, prompt=Prompt(key=("prompt",), text="{subgoal}"))
    engine = engine_of(openpi_server, reads)
    engine.invoke(request_of(engine, subgoal="pick up the red cube"))
    engine.invoke(request_of(engine, instruction="tidy up"))
    assert [seen["prompt"] for seen in openpi_server.policy.seen[-2:]] == ["pick up the red cube", "tidy up"]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"actions": np.zeros((50, 14))}, r"\(50, 14\) float64; test expects \(20, 3\)"),
        ({"actions": np.zeros((20, 3)) * np.nan}, "nan in row 0"),
        ({"action": np.zeros((20, 3))}, "answers with action; test expects actions"),
        ({}, "answers with nothing"),
        ("Traceback: KeyError: 'observation/state'", "it says: Traceback: KeyError"),
        ({"type": "error", "message": "Robot policy not available"}, "Robot policy not available"),
        (b"\xc1", "expected openpi's msgpack"),
    ],
)
def test_another_first_answer_is_refused_before_anything_moves(
    openpi_server: Any, mapping: PolicyMapping, answer: Any, said: str
) -> None:
    openpi_server.policy.script = lambda seen: answer
    with pytest.raises(ValueError, match=said):
        engine_of(openpi_server, mapping)


def test_a_later_answer_is_compared_as_well(openpi_server: Any, mapping: PolicyMapping) -> None:
    engine = engine_of(openpi_server, mapping)
    openpi_server.policy.script = lambda seen: {"actions": np.full((20, 3), np.inf)}
    with pytest.raises(ValueError, match="inf in row 0, column 0"):
        engine.invoke(request_of(engine))
    openpi_server.policy.script = None
    assert engine.invoke(request_of(engine)).shape == (20, 3)


def test_a_silent_policy_costs_the_answers_time_and_the_heart_beats_on(
    openpi_server: Any, mapping: PolicyMapping, eventually: Callable[..., None]
) -> None:
    engine = engine_of(openpi_server, mapping, answer_s=FAST_S)
    freed = threading.Event()
    late = {"actions": np.full((20, 3), 9.0)}
    openpi_server.policy.script = lambda seen: freed.wait(20) and late
    beats = []
    with pytest.raises(ValueError, match=r"no answer within 0\.3 s"):
        engine.invoke(request_of(engine), lambda: beats.append(time.monotonic()))
    assert len(beats) > 3
    openpi_server.policy.script = None
    freed.set()
    rows = engine.invoke(request_of(engine))  # of its own question: the late answer went with its connection
    np.testing.assert_allclose(rows[0], [0.1, 0.2, 0.3], rtol=1e-6)


def test_a_policy_that_died_is_told_and_one_that_came_back_is_used(openpi_server: Any, mapping: PolicyMapping) -> None:
    pytest.importorskip("openpi_client")
    engine = engine_of(openpi_server, mapping, answer_s=FAST_S)
    port = openpi_server.port
    for connection in openpi_server.connections:
        connection.close_socket()
    assert engine.invoke(request_of(engine)).shape == (20, 3)  # closed while nobody looked: asked anew
    again = type(openpi_server)(metadata={"model": "another"})
    openpi_server.metadata = again.metadata
    openpi_server.connections[-1].close_socket()
    with pytest.raises(ValueError, match="start pounce-serve again"):
        engine.invoke(request_of(engine))
    assert port == openpi_server.port


def test_without_a_server_the_start_ends_with_a_sentence(mapping: PolicyMapping) -> None:
    url = "ws://127.0.0.1:9"
    with pytest.raises(ValueError, match=r"policy server ws://127\.0\.0\.1:9: .*refused.*--start-s"):
        RemoteEngine(OpenpiPeer(url, mapping), mapping, url, answer_s=1, start_s=0.1)


def test_a_server_without_websockets_is_told(mapping: PolicyMapping) -> None:
    with pytest.raises(ValueError, match="expected ws://HOST:PORT"):
        engine_of(type("Server", (), {"url": "http://127.0.0.1:9"}), mapping, start_s=0.1)


def test_a_stateful_server_gets_a_session_an_episode(
    openpi_server: Any, mapping: PolicyMapping, episode_info: Callable[..., Any], paper: Any
) -> None:
    openpi_server.metadata = {"needs_session_id": True, "action_space": "joint_position"}
    engine = engine_of(openpi_server, mapping)
    sessions = set()
    for _ in range(2):
        engine.begin(episode_info(paper))
        for _ in range(2):
            engine.invoke(request_of(engine))
            sessions.add(openpi_server.policy.seen[-1]["session_id"])
    assert len(sessions) == 2


@pytest.mark.parametrize("packed", ["alone", "within", "by key"])
def test_actions_are_found_however_a_server_packs_them(openpi_server: Any, mapping: PolicyMapping, packed: str) -> None:
    def script(seen: dict[str, Any]) -> Any:
        rows = openpi_server.policy.held(seen)
        return {"alone": rows, "within": {"actions": {"actions": rows}}, "by key": {"actions": rows, "x": 1}}[packed]

    openpi_server.policy.script = script
    engine = engine_of(openpi_server, mapping)
    np.testing.assert_allclose(engine.invoke(request_of(engine))[0], [0.1, 0.2, 0.3], rtol=1e-6)


def test_an_episode_of_another_rate_or_other_cameras_is_refused(
    openpi_server: Any, mapping: PolicyMapping, episode_info: Callable[..., Any], paper: Any
) -> None:
    slow = dataclasses.replace(mapping, rate_hz=15, play_hz=15)
    with pytest.raises(ValueError, match="mapped for 15 rows a second, the episode plays 20: give play_hz = 20"):
        engine_of(openpi_server, slow).begin(episode_info(paper))
    side = dataclasses.replace(mapping, cameras=(*mapping.cameras, Camera(camera="side", key=None)))
    with pytest.raises(ValueError, match="maps the cameras front, wrist, side, the robot has front, wrist"):
        engine_of(openpi_server, side).begin(episode_info(paper))
