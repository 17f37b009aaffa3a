"""The whole way: LeRobot's client over zenoh, gateway, clock service, both servers."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from clock import schedules
from clock.check import disagreements
from ponder_server.contract import Text
from protocol import messages as m
from protocol.mcap_log import read_log
from sim_client.gateway.exchange import Terms
from sim_client.gateway.lerobot import ALIGNED
from sim_client.gateway.lerobot_side import LerobotSide
from sim_client.gateway.seats import Seats
from sim_client.launch import free_ports

ROWS = 5


class Client:
    """Does on the wire what ``RemoteClient`` and its engine do: one question at a time, an error is the end."""

    def __init__(self, port: int, wire: Any) -> None:
        self.wire = wire
        config = zenoh.Config()
        for key, value in {
            "mode": "peer", "scouting/multicast/enabled": False, "scouting/gossip/enabled": False,
            "connect/endpoints": [f"tcp/127.0.0.1:{port}"], "transport/shared_memory/enabled": False,
        }.items():  # fmt: skip
            config.insert_json5(key, json.dumps(value))
        self.zenoh = zenoh.open(config)
        self.lost = False
        self.generation = self.sequence = self.cursor = 0
        self.session_id = self.instance_id = ""
        root = "lerobot/inference/v1/deployments/arm"
        self.descriptor = self.query(f"{root}/describe", "describe", {})["body"]
        self.instance_id = self.descriptor["instance_id"]
        self.instance = f"{root}/instances/{self.instance_id}"
        self.token = self.zenoh.liveliness().declare_subscriber(f"{self.instance}/alive", self.presence, history=True)

    def presence(self, sample: zenoh.Sample) -> None:
        self.lost |= sample.kind != zenoh.SampleKind.PUT

    def query(self, key: str, kind: str, body: dict[str, Any]) -> dict[str, Any]:
        ids = {"instance_id": self.instance_id, "session_id": self.session_id, "generation": self.generation}
        packet = self.wire.enveloped(kind, body, **ids)
        (reply,) = self.zenoh.get(key, payload=packet, timeout=10)
        answer = msgpack.unpackb(reply.ok.payload.to_bytes())
        assert answer["request_id"] == msgpack.unpackb(packet)["request_id"]
        assert answer["generation"] == self.generation
        return answer

    def admit(self, merge: str = "aligned") -> dict[str, Any]:
        ours, self.is_aligned = self.descriptor["capabilities"], merge == "aligned"
        body = {
            "expected_artifact": self.descriptor["artifact_identity"], "features": ours["features"],
            "action_feature": ours["action_feature"], "semantics": "arm", "action_interval": 0.05, "mode": "chunk",
            "encoding": "raw",
        }  # fmt: skip
        if merge == "aligned":
            body |= {"chunk_settings": {"chunk_merge": "aligned"}, "required_capabilities": [ALIGNED]}
        answer = self.query(f"{self.instance}/open", "open", body)
        if answer["message_type"] == "error":
            return answer
        assert answer["body"]["capabilities"] == ours
        self.session_id = answer["session_id"]
        key = f"{self.instance}/sessions/{self.session_id}"
        self.key = key
        self.answers = self.zenoh.declare_subscriber(f"{key}/act", zenoh.handlers.FifoChannel(4))
        self.texts = self.zenoh.declare_subscriber(f"{key}/language/result", zenoh.handlers.FifoChannel(4))
        self.alive = self.zenoh.liveliness().declare_token(f"{key}/alive")
        self.control("reset", 0)
        self.publishers = {}
        for name in ("obs", "language/request"):
            publisher = self.zenoh.declare_publisher(
                f"{key}/{name}", congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA
            )
            until(lambda publisher=publisher: publisher.matching_status.matching)
            self.publishers[name] = publisher
        return answer

    def control(self, operation: str, generation: int) -> None:
        self.generation = generation
        answer = self.query(f"{self.key}/control", "control", {"operation": operation})
        assert answer["body"] == {"operation": operation, "applied_generation": generation}, answer

    def tell(self, message: str = "observation", **changes: Any) -> dict[str, Any]:
        self.sequence += 1
        cursors = {"cursor": self.cursor, "observation_cursor": self.cursor}
        body = self.wire.observation(self.descriptor["artifact_identity"], self.sequence, **(cursors | changes))
        ids = {"instance_id": self.instance_id, "session_id": self.session_id, "generation": self.generation}
        packet = self.wire.enveloped(message, body, **ids)
        self.publishers["obs" if message == "observation" else "language/request"].put(packet)
        return msgpack.unpackb(packet)

    def answer(self, question: dict[str, Any]) -> dict[str, Any]:
        channel = self.answers if question["message_type"] == "observation" else self.texts
        answers: list[dict[str, Any]] = []

        def is_answered() -> bool:
            while (sample := channel.try_recv()) is not None:
                answers.append(msgpack.unpackb(sample.payload.to_bytes()))
            return any(is_it(answer) for answer in answers)

        def is_it(answer: dict[str, Any]) -> bool:
            return all(answer[name] == question[name] for name in ("request_id", "generation"))

        until(is_answered)
        return next(filter(is_it, answers))

    def infer(self, **changes: Any) -> np.ndarray:
        """Rows in degrees, (ROWS, 3), validated as LeRobot validates them."""
        question = self.tell(**changes)
        answer = self.answer(question)
        assert answer["message_type"] == "action", answer["body"]
        body, sent = answer["body"], question["body"]
        cursors = ("cursor", "observation_cursor") if self.is_aligned else ()
        for name in ("artifact_identity", "observation_id", "capture_time", "task", "task_version", *cursors):
            assert body[name] == sent[name]
        record = body["canonical_actions"]
        assert (record["shape"], record["dtype"], body["execution_steps"]) == ([ROWS, 3], "float32", ROWS)
        self.levels = body["levels"]
        rows = np.frombuffer(record["data"], np.float32).reshape(ROWS, 3)
        assert np.isfinite(rows).all()
        return rows

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.zenoh.close()


def until(is_so: Callable[[], bool], longest_s: float = 10.0) -> None:
    end_s = time.monotonic() + longest_s
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.005)  # another thread's doing: there is nothing to wait on


@pytest.fixture(scope="module")
def client_of(wire: Any) -> Callable[[int], Client]:
    return lambda port: Client(port, wire)


@pytest.fixture
def gateway(bench_with: Callable[..., Any], terms: Terms, working: Any, tmp_path: Path) -> Callable[..., Any]:
    """A gateway for one client: its rig and its port."""

    @contextmanager
    def run(mode: m.Mode = m.Mode.REALTIME, **changes: Any) -> Iterator[tuple[Any, int]]:
        schedule = schedules.realtime() if mode == m.Mode.REALTIME else schedules.paper()
        if mode == m.Mode.LOCKSTEP:
            schedule = replace(schedule, invoke_period_ticks=ROWS)
        bench = bench_with(replace(schedule, **changes), out=tmp_path, num_rows=ROWS, waits_for_person=True)
        bench.rig.ponder_engine.texts = (Text(kind="subgoal", text="reach it", token_ids=(1,), truncated=False),)
        port = free_ports(1)[0]
        side = LerobotSide(("127.0.0.1", port), Seats([bench.machine]), replace(terms, mode=mode), 1)
        thread = threading.Thread(target=side.serve_forever, daemon=True)
        with working(bench.machine):
            thread.start()
            try:
                until(lambda: not bench.machine.unready())
                yield bench, port
            finally:
                side.shutdown()
                thread.join(10)

    return run


def log_of(out: Path) -> Any:
    (path,) = out.rglob("*.mcap")
    record = read_log(path)
    assert next(disagreements(record), None) is None
    return record


@pytest.mark.realtime
def test_a_run_of_lerobot_s_client(gateway: Any, client_of: Callable[[int], Client], tmp_path: Path) -> None:
    """Admission, reset, aligned chunks, a generation's end, a second client, goodbye; then the log."""
    with gateway() as (bench, port):
        with client_of(port) as client:
            assert client.descriptor["ready"]
            client.admit()
            client.control("reset", 1)
            for _ in range(8):
                client.infer()
                client.cursor += 1
            assert set(client.levels) == {"PLAY"}
            client.control("invalidate", 2)
            client.infer()
            with client_of(port) as other:
                refused = other.admit()
                assert (refused["message_type"], refused["body"]["code"]) == ("error", "busy")
                assert refused["body"]["details"]["admission_blocker"] == "active_session"
            stale = client.answer(client.tell(task_version=-1))
            assert (stale["message_type"], stale["body"]["code"]) == ("error", "malformed")
            client.infer()
            assert not client.lost
            client.control("close", client.generation)
            until(lambda: not bench.machine.holder)
        record = log_of(tmp_path)
        assert record.ticks
        assert record.info.instruction == "put the cube in the bin"


@pytest.mark.realtime
def test_a_reset_and_another_task_begin_episodes(
    gateway: Any, client_of: Callable[[int], Client], tmp_path: Path
) -> None:
    with gateway() as (_, port), client_of(port) as client:
        client.admit("append")
        client.infer()
        client.control("reset", 1)
        client.infer()
        client.infer(task="wipe the table", task_version=1)
        client.control("close", 1)
    logs = sorted((read_log(path) for path in tmp_path.rglob("*.mcap")), key=lambda log: log.info.header.epoch)
    assert [log.info.instruction for log in logs] == ["put the cube in the bin"] * 2 + ["wipe the table"]


@pytest.mark.realtime
def test_the_next_subtask_is_the_newest_that_ponder_wrote(gateway: Any, client_of: Callable[[int], Client]) -> None:
    with gateway() as (_, port), client_of(port) as client:
        client.admit()
        client.infer()
        language = {"kind": "next_subtask", "text": "what next?", "intent_generation": 1}
        told: dict[str, Any] = {}

        def is_told() -> bool:
            told.update(client.answer(client.tell("language_request", **language)))
            return told["message_type"] == "language_result"

        until(is_told)
        assert (told["body"]["answer"], told["body"]["intent_generation"]) == ("reach it", 1)
        assert told["body"]["age_s"] >= 0
        refused = client.answer(client.tell("language_request", **language | {"kind": "vqa"}))
        assert refused["body"]["code"] == "unsupported"
        client.infer(task="reach it", task_version=1)
        assert client.levels


def refuse(*_: Any) -> Any:
    raise ValueError("a test's refusal")


@pytest.mark.realtime
def test_a_robot_that_stands_still_is_answered_rows(
    gateway: Any, client_of: Callable[[int], Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A POUNCE that answers nothing: the ladder goes down to its end, and every answer is rows that hold the arm."""
    with gateway() as (bench, port), client_of(port) as client:
        client.admit()
        client.infer()
        monkeypatch.setattr(bench.rig.pounce_engine, "invoke", refuse)
        seen = set()
        client.infer()

        def is_stopped() -> bool:
            rows = client.infer()
            seen.update(client.levels)
            return client.levels == ["STOPPED"] * ROWS and (rows == rows[0]).all()

        until(is_stopped)
        assert "HOLD" in seen
        before = client.infer()
        for _ in range(5):
            assert (client.infer() == before).all()
        client.control("close", 0)


def test_in_lockstep_the_episode_is_the_client_s_rows(
    gateway: Any, client_of: Callable[[int], Client], tmp_path: Path
) -> None:
    with gateway(m.Mode.LOCKSTEP) as (_, port), client_of(port) as client:
        client.admit("append")
        played = [client.infer() for _ in range(4)]
        client.control("close", 0)
    record = log_of(tmp_path)
    sent = np.stack([action.values for action in record.actions])
    assert len(sent) == ROWS * 3 + 1
    theirs = np.concatenate(played)[: len(sent)] * [np.pi / 180, np.pi / 180, 0.01]
    np.testing.assert_allclose(theirs, sent, atol=1e-5)


def test_whoever_is_gone_without_a_word_loses_the_seat(
    gateway: Any, client_of: Callable[[int], Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sim_client.gateway.lerobot.IDLE_S", 0.3)
    with gateway() as (bench, port):
        with client_of(port) as client:
            client.admit()
            client.infer()
            assert bench.machine.holder
        until(lambda: not bench.machine.holder)
        with client_of(port) as next_one:
            assert next_one.admit()["message_type"] == "accepted"
