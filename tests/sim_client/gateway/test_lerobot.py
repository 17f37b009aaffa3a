"""LeRobot's remote inference at the gateway, by a client that does what LeRobot's does: admitted, reset, asked for rows
and for subgoals, silent, gone; and whatever else comes is an error with a code."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from clock import schedules
from clock.check import disagreements
from ponder_server.contract import Text
from protocol import messages as m
from protocol.bus import Request
from protocol.mcap_log import read_log
from protocol.peers.lerobot import Code, Envelope, WireError, unpack
from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt
from sim_client.gateway.exchange import Answer, Behind, Terms
from sim_client.gateway.lerobot import ALIGNED, Deployment, Session, capabilities, check_mapping
from sim_client.gateway.lerobot_side import LerobotSide, _Pending
from sim_client.gateway.seats import Seats
from sim_client.launch import free_ports

PX, ROWS = 4, 5
JOINTS = ("pan.pos", "lift.pos", "gripper.pos")
STATE, FRONT, WRIST = "observation.state", "observation.images.front", "observation.images.wrist"
MAPPING = PolicyMapping(
    name="arm",
    rate_hz=20,
    play_hz=20,
    horizon=ROWS,
    num_proprio=3,
    num_commands=3,
    prompt=Prompt(key=("task",)),
    cameras=(
        Camera(camera="front", key=(FRONT,), size_px=(PX, PX)), Camera(camera="wrist", key=(WRIST,), size_px=(PX, PX)),
    ),
    state=(
        Numbers(key=(STATE,), columns=(0, 1), dims=(0, 1), scale=np.pi / 180),
        Numbers(key=(STATE,), columns=(2,), dims=(2,), scale=0.01),
    ),
    actions=(
        Numbers(key=("action",), columns=(0, 1), dims=(0, 1), scale=np.pi / 180),
        Numbers(key=("action",), columns=(2,), dims=(2,), scale=0.01, kind="gripper"),
    ),
    names={(STATE,): JOINTS, ("action",): JOINTS},
)  # fmt: skip
TOLD = ("sha",)
IDS = (f"{number:032x}" for number in itertools.count(1))


def tensor(array: np.ndarray) -> dict[str, Any]:
    return {
        "__lerobot_type__": "tensor", "dtype": array.dtype.name, "shape": list(array.shape), "endianness": "little",
        "data": array.tobytes(),
    }  # fmt: skip


def picture(shade: int) -> dict[str, Any]:
    return {
        "__lerobot_type__": "rgb", "encoding": "raw", "shape": [PX, PX, 3], "dtype": "uint8", "channel_order": "RGB",
        "data": bytes([shade % 256]) * (PX * PX * 3),
    }  # fmt: skip


def enveloped(kind: str, body: Any, **ids: Any) -> bytes:
    header = {"instance_id": "", "session_id": "", "request_id": next(IDS), "generation": 0}
    return bytes(msgpack.packb({"version": 1, "message_type": kind, "body": body, **(header | ids)}))


def observation(artifact: str, sequence: int, **changes: Any) -> dict[str, Any]:
    degrees = np.array([90.0, -45.0, 50.0], np.float32)
    body = {
        "sequence": sequence, "artifact_identity": artifact, "observation_id": f"o{sequence}",
        "capture_time": 12.25 + sequence, "task": "put the cube in the bin", "task_version": 0,
        "features": {STATE: tensor(degrees), FRONT: picture(sequence), WRIST: picture(7)},
        "delay": 0, "model_continuation": None, "canonical_continuation": None,
        "cursor": sequence, "observation_cursor": sequence,
    }  # fmt: skip
    return body | changes


@pytest.fixture(scope="module")
def terms(terms_with: Callable[..., Terms]) -> Terms:
    return terms_with(mode=m.Mode.REALTIME, rows=ROWS, mapping=MAPPING)


@pytest.fixture
def deployment(terms: Terms) -> Deployment:
    return Deployment(terms)


def opening(deployment: Deployment, **changes: Any) -> Envelope:
    ours = capabilities(deployment.terms)
    body = {
        "expected_artifact": deployment.described(Envelope(kind="describe"), "", TOLD).body["artifact_identity"],
        "features": ours["features"], "action_feature": ours["action_feature"], "semantics": "arm",
        "action_interval": 0.05, "mode": "chunk", "encoding": "raw", "chunk_settings": {"chunk_merge": "aligned"},
        "required_capabilities": [ALIGNED],
    }  # fmt: skip
    return unpack(enveloped("open", body | changes, instance_id=deployment.instance_id))


@pytest.fixture
def session(deployment: Deployment) -> Session:
    return deployment.sessions[deployment.admitted(opening(deployment), "", TOLD, 0).session_id]


def asked(session: Session, sequence: int, message: str = "observation", **changes: Any) -> Envelope:
    body = observation(session.artifact, sequence, **changes)
    return unpack(enveloped(message, body, instance_id="i", session_id=session.id))


# -- what is told, and who is admitted


def test_a_robot_s_features_are_told_by_the_names_of_its_joints(deployment: Deployment) -> None:
    told = deployment.described(Envelope(kind="describe", request_id="a1"), "", TOLD)
    ours = told.body["capabilities"]
    assert [(each["name"], each["shape"], each["kind"], each["dtype"]) for each in ours["features"]] == [
        (STATE, [3], "tensor", "float32"), (FRONT, [PX, PX, 3], "rgb", "uint8"), (WRIST, [PX, PX, 3], "rgb", "uint8"),
    ]  # fmt: skip
    assert ours["features"][0]["names"] == ours["action_feature"]["names"] == list(JOINTS)
    assert (ours["execution_steps"], ours["action_interval"], ours["modes"]) == (ROWS, 0.05, ["chunk"])
    assert set(ours) == {  # LeRobot makes a dataclass of it: another field would be refused
        "modes", "prediction_steps", "execution_steps", "action_interval", "features", "action_feature", "language",
        "training_max_delay", "rtc_horizon", "current_observation_only", "retains_session_state",
        "action_representation",
    }  # fmt: skip
    assert (told.request_id, told.instance_id, told.body["ready"]) == ("a1", deployment.instance_id, True)
    assert not deployment.described(Envelope(kind="describe"), "pounce is loading", TOLD).body["ready"]
    other = deployment.described(Envelope(kind="describe"), "", ("other",))
    assert other.body["artifact_identity"] != told.body["artifact_identity"]


def test_what_is_accepted_repeats_what_was_told(deployment: Deployment) -> None:
    told = deployment.described(Envelope(kind="describe"), "", TOLD).body
    accepted = deployment.admitted(opening(deployment), "", TOLD, 0)
    for name in ("capabilities", "artifact_identity", "limits"):
        assert accepted.body[name] == told[name]
    assert (accepted.body["mode"], accepted.body["chunk_settings"]) == ("chunk", {"chunk_merge": "aligned"})
    assert accepted.session_id in deployment.sessions


FEATURE = {"name": STATE, "shape": [3], "dtype": "float32", "kind": "tensor", "names": list(JOINTS), "semantics": "arm"}


@pytest.mark.parametrize(
    ("changes", "code", "said"),
    [
        ({"semantics": "so101"}, Code.INCOMPATIBLE, "expected 'arm', the mapping file's name"),
        ({"mode": "rtc_guided"}, Code.UNSUPPORTED, "expected chunk"),
        ({"encoding": "png"}, Code.UNSUPPORTED, "expected raw or jpeg"),
        ({"action_interval": 1 / 30}, Code.INCOMPATIBLE, "--fps=20"),
        ({"action_interval": "0.05"}, Code.INCOMPATIBLE, "--fps=20"),
        ({"expected_artifact": "sha256:0"}, Code.INCOMPATIBLE, "this is artifact"),
        ({"features": []}, Code.INCOMPATIBLE, f"expected {STATE}, {FRONT}, {WRIST}"),
        ({"features": 5}, Code.INCOMPATIBLE, "features: expected"),
        ({"features": [FEATURE | {"names": ["lift.pos", "pan.pos", "gripper.pos"]}] * 3}, Code.INCOMPATIBLE, STATE),
        ({"action_feature": FEATURE}, Code.INCOMPATIBLE, "feature action"),
        ({"chunk_settings": {"chunk_merge": "aligned", "blend_steps": 2}}, Code.INCOMPATIBLE, "chunk_merge alone"),
        ({"required_capabilities": ["chunk_alignment_v1"]}, Code.UNSUPPORTED, "chunk_alignment_v2"),
        ({"required_capabilities": []}, Code.UNSUPPORTED, "served are"),
    ],
)
def test_another_robot_is_refused_before_anything_moves(
    deployment: Deployment, changes: dict[str, Any], code: Code, said: str
) -> None:
    with pytest.raises(WireError, match=said) as refused:
        deployment.admitted(opening(deployment, **changes), "", TOLD, 0)
    assert refused.value.code == code
    assert not deployment.sessions


def test_as_many_are_admitted_as_there_are_seats(terms: Terms) -> None:
    deployment = Deployment(terms, num_seats=2)
    first = deployment.admitted(opening(deployment), "", TOLD, 0)
    deployment.admitted(opening(deployment), "", TOLD, 0)
    with pytest.raises(WireError, match="all 2 seats are taken") as refused:
        deployment.admitted(opening(deployment), "", TOLD, 4_000_000_000)
    assert refused.value.code == Code.BUSY
    assert refused.value.details == {"admission_blocker": "awaiting_initial_presence", "absence_grace_remaining_s": 6.0}
    del deployment.sessions[first.session_id]
    deployment.admitted(opening(deployment), "", TOLD, 0)


def test_in_lockstep_rows_are_appended_and_text_is_not_served(terms: Terms) -> None:
    deployment = Deployment(replace(terms, mode=m.Mode.LOCKSTEP))
    assert not capabilities(deployment.terms)["language"]
    with pytest.raises(WireError, match="required_capabilities"):
        deployment.admitted(opening(deployment), "", TOLD, 0)
    settings = {"chunk_settings": {"chunk_merge": "append"}, "required_capabilities": []}
    deployment.admitted(opening(deployment, **settings), "", TOLD, 0)


# -- a session


def test_an_observation_is_a_step_in_our_units(session: Session) -> None:
    step = session.observed(asked(session, 1))
    np.testing.assert_allclose(step.state, [np.pi / 2, -np.pi / 4, 0.5], rtol=1e-6)
    assert sorted(step.frames) == ["front", "wrist"]
    assert (step.frames["front"] == 1).all()
    assert (step.instruction, step.begins, step.may_begin) == ("put the cube in the bin", False, True)


def test_rows_go_back_in_theirs_with_what_was_asked(session: Session) -> None:
    question = asked(session, 1)
    session.observed(question)
    rows = np.tile(np.array([[np.pi, 0.0, 1.0]], np.float32), (ROWS, 1))
    behind = Behind(pounce_ns=2_000_000, ponder_ns=3_000_000_000, cognition_age_ns=500_000_000)
    told = session.answered(question, Answer(rows_NA=rows, tick=9, levels=(m.Level.STOPPED,) * ROWS, behind=behind))
    np.testing.assert_allclose(told.body["canonical_actions"], np.tile([180, 0, 100], (ROWS, 1)), atol=1e-4)
    assert told.body["canonical_actions"].dtype == np.float32
    for name in ("artifact_identity", "observation_id", "capture_time", "task", "task_version", "cursor"):
        assert told.body[name] == question.body[name]
    assert told.body["observation_cursor"] == 1
    assert (told.kind, told.request_id, told.body["execution_steps"]) == ("action", question.request_id, ROWS)
    assert told.body["server_durations"] == {"pounce": 0.002, "ponder": 3.0, "cognition_age": 0.5}


def test_another_task_begins_an_episode_and_our_own_subgoal_does_not(session: Session) -> None:
    language = {"kind": "next_subtask", "text": "what next?", "intent_generation": 3}
    session.observed(asked(session, 1))
    question = asked(session, 2, "language_request", **language)
    session.observed(question)
    rows = np.zeros((ROWS, 3), np.float32)
    behind = Behind(subgoal="reach it", subgoal_age_ns=1_500_000_000)
    told = session.answered(question, Answer(rows_NA=rows, tick=1, levels=(), behind=behind))
    assert (told.kind, told.body["answer"], told.body["age_s"]) == ("language_result", "reach it", 1.5)
    assert (told.body["kind"], told.body["intent_generation"]) == ("next_subtask", 3)
    steered = session.observed(asked(session, 3, task="reach it", task_version=1))
    assert (steered.begins, steered.instruction) == (False, "put the cube in the bin")
    other = session.observed(asked(session, 4, task="wipe the table", task_version=2))
    assert (other.begins, other.instruction) == (True, "wipe the table")
    with pytest.raises(WireError, match="no subgoal yet") as refused:
        session.answered(question, Answer(rows_NA=rows, tick=1, levels=()))
    assert refused.value.code == Code.EXECUTION  # which LeRobot tells its user, and goes on


QUESTION = {"text": "?", "intent_generation": 0}


@pytest.mark.parametrize(
    ("changes", "code", "said"),
    [
        ({"generation": 1}, Code.STALE, "generation 1: it is 0"),
        ({"sequence": 0}, Code.STALE, "sequence 0 after 0"),
        ({"sequence": -1}, Code.MALFORMED, "sequence"),
        ({"sequence": True}, Code.MALFORMED, "sequence"),
        ({"artifact_identity": "other"}, Code.INCOMPATIBLE, "artifact_identity"),
        ({"task": " "}, Code.INCOMPATIBLE, "--task"),
        ({"task": "x" * 5000}, Code.MALFORMED, "at most 4096"),
        ({"task_version": "1"}, Code.MALFORMED, "task_version"),
        ({"observation_id": ""}, Code.MALFORMED, "observation_id"),
        ({"capture_time": None}, Code.MALFORMED, "capture_time"),
        ({"cursor": 0, "observation_cursor": 2}, Code.MALFORMED, "before observation_cursor"),
        ({"cursor": None}, Code.MALFORMED, "cursor"),
        ({"features": {}}, Code.INCOMPATIBLE, f"expected {STATE}"),
        ({"features": {STATE: 1, FRONT: 2, WRIST: 3}}, Code.INCOMPATIBLE, STATE),
        (
            {"features": {STATE: tensor(np.zeros(3)), FRONT: picture(1), WRIST: picture(1)}},
            Code.INCOMPATIBLE,
            "float32",
        ),
        ({"message": "language_request", "text": "?"}, Code.MALFORMED, "intent_generation"),
        ({"message": "language_request", "kind": "vqa", **QUESTION}, Code.UNSUPPORTED, "expected next_subtask"),
    ],
)
def test_what_cannot_be_used_gets_a_code(session: Session, changes: dict[str, Any], code: Code, said: str) -> None:
    session.observed(asked(session, 0))
    body = observation(session.artifact, 1) | changes
    generation, message = body.pop("generation", 0), body.pop("message", "observation")
    question = unpack(enveloped(message, body, instance_id="i", session_id=session.id, generation=generation))
    with pytest.raises(WireError, match=said) as refused:
        session.observed(question)
    assert refused.value.code == code


@given(st.lists(st.tuples(st.sampled_from(["reset", "invalidate", "status", "close"]), st.integers(0, 4)), max_size=12))
def test_generations_only_rise_and_what_is_acknowledged_holds(steps: list[tuple[str, int]]) -> None:
    session = Session(terms=None, artifact="a", is_aligned=True)  # type: ignore[arg-type]
    for operation, generation in steps:
        before = session.generation
        question = unpack(
            enveloped("control", {"operation": operation}, instance_id="i", session_id="s", generation=generation)
        )
        is_old = operation != "close" and generation < before
        if is_old or (operation == "status" and generation != before):
            with pytest.raises(WireError, match="generation"):
                session.controlled(question)
            assert session.generation == before
        else:
            _, ack = session.controlled(question)
            assert ack.body["applied_generation"] == session.generation == generation


def test_a_mapping_file_names_every_joint_and_camera() -> None:
    check_mapping(MAPPING, ("front", "wrist"))
    for changes, said in (
        ({"names": {("action",): JOINTS}}, f"has no {STATE}"),
        ({"cameras": MAPPING.cameras[:1]}, "wrist"),
        ({"cameras": (replace(MAPPING.cameras[0], size_px=None), MAPPING.cameras[1])}, "size_px"),
        ({"actions": (replace(MAPPING.actions[0], kind="delta"), MAPPING.actions[1])}, "kind delta"),
        ({"actions": (replace(MAPPING.actions[0], key=("arm",)), MAPPING.actions[1])}, "under one key"),
    ):
        with pytest.raises(ValueError, match=said):
            check_mapping(replace(MAPPING, **changes), ("front", "wrist"))


# -- the whole way: LeRobot's client over zenoh, gateway, clock service, both servers


class Client:
    """Does on the wire what ``RemoteClient`` and its engine do: one question at a time, an error is the end."""

    def __init__(self, port: int) -> None:
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
        packet = enveloped(kind, body, **ids)
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
        body = observation(self.descriptor["artifact_identity"], self.sequence, **(cursors | changes))
        ids = {"instance_id": self.instance_id, "session_id": self.session_id, "generation": self.generation}
        packet = enveloped(message, body, **ids)
        self.publishers["obs" if message == "observation" else "language/request"].put(packet)
        return msgpack.unpackb(packet)

    def answer(self, question: dict[str, Any]) -> dict[str, Any]:
        channel = self.answers if question["message_type"] == "observation" else self.texts
        until_s = time.monotonic() + 10
        while time.monotonic() < until_s:
            sample = channel.try_recv()
            if sample is None:
                time.sleep(0.002)
                continue
            answer = msgpack.unpackb(sample.payload.to_bytes())
            if [answer[name] for name in ("request_id", "generation")] == [
                question["request_id"],
                question["generation"],
            ]:
                return answer
        pytest.fail("no answer within 10 s")

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
def test_a_run_of_lerobot_s_client(gateway: Any, tmp_path: Path) -> None:
    """Admission, reset, aligned chunks, a generation's end, a second client, goodbye; then the log."""
    with gateway() as (bench, port):
        with Client(port) as client:
            assert client.descriptor["ready"]
            client.admit()
            client.control("reset", 1)
            for _ in range(8):
                client.infer()
                client.cursor += 1
            assert set(client.levels) == {"PLAY"}
            client.control("invalidate", 2)
            client.infer()
            with Client(port) as other:
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
def test_a_reset_and_another_task_begin_episodes(gateway: Any, tmp_path: Path) -> None:
    with gateway() as (_, port), Client(port) as client:
        client.admit("append")
        client.infer()
        client.control("reset", 1)
        client.infer()
        client.infer(task="wipe the table", task_version=1)
        client.control("close", 1)
    logs = sorted((read_log(path) for path in tmp_path.rglob("*.mcap")), key=lambda log: log.info.header.epoch)
    assert [log.info.instruction for log in logs] == ["put the cube in the bin"] * 2 + ["wipe the table"]


@pytest.mark.realtime
def test_the_next_subtask_is_the_newest_that_ponder_wrote(gateway: Any) -> None:
    with gateway() as (_, port), Client(port) as client:
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
def test_a_robot_that_stands_still_is_answered_rows(gateway: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A POUNCE that answers nothing: the ladder goes down to its end, and every answer is rows that hold the arm."""
    with gateway() as (bench, port), Client(port) as client:
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


def test_in_lockstep_the_episode_is_the_client_s_rows(gateway: Any, tmp_path: Path) -> None:
    with gateway(m.Mode.LOCKSTEP) as (_, port), Client(port) as client:
        client.admit("append")
        played = [client.infer() for _ in range(4)]
        client.control("close", 0)
    record = log_of(tmp_path)
    sent = np.stack([action.values for action in record.actions])
    assert len(sent) == ROWS * 3 + 1
    theirs = np.concatenate(played)[: len(sent)] * [np.pi / 180, np.pi / 180, 0.01]
    np.testing.assert_allclose(theirs, sent, atol=1e-5)


def test_whoever_is_gone_without_a_word_loses_the_seat(gateway: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_client.gateway.lerobot.IDLE_S", 0.3)
    with gateway() as (bench, port):
        with Client(port) as client:
            client.admit()
            client.infer()
            assert bench.machine.holder
        until(lambda: not bench.machine.holder)
        with Client(port) as next_one:
            assert next_one.admit()["message_type"] == "accepted"


PIECES = st.none() | st.booleans() | st.integers(-5, 5) | st.floats() | st.text(max_size=3) | st.binary(max_size=3)
ANYTHING = st.recursive(
    PIECES, lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
)
KINDS = ["describe", "open", "control", "observation", "language_request", "ack", "action", "error", "nonsense"]


@given(kind=st.sampled_from(KINDS), body=ANYTHING, version=st.sampled_from([1, 1, 1, 2, "1"]), cut=st.integers(0, 9))
def test_whatever_comes_is_answered_and_ends_nothing(
    silent_side: LerobotSide, kind: str, body: Any, version: Any, cut: int
) -> None:
    """Every message gets one answer of this wire; none takes a seat."""
    ids = {"instance_id": silent_side.deployment.instance_id, "session_id": "s", "request_id": "r", "generation": 0}
    packet = msgpack.packb({"version": version, "message_type": kind, "body": body, **ids})
    for data in (packet, packet[:-cut] if cut else b""):
        answers: list[bytes] = []
        silent_side._handle(Request(data, answers.append))
        (answer,) = answers
        envelope = unpack(answer)
        assert envelope.kind == (
            "descriptor" if data == packet and kind == "describe" and _is_whole(body, version) else "error"
        )
        assert envelope.kind != "error" or envelope.body["code"] in list(Code)
    assert not silent_side.deployment.sessions


def test_an_answer_that_fails_is_an_error_to_its_client_and_ends_nothing(silent_side: LerobotSide) -> None:
    future: Future[Answer | None] = Future()
    future.set_exception(ZeroDivisionError("a defect"))
    answers: list[bytes] = []
    session = Session(silent_side.deployment.terms, "sha", is_aligned=False)
    waiting = Envelope(kind="observation", session_id=session.id, request_id="r")
    silent_side._pending.append(_Pending(waiting, session, future, answers.append))
    silent_side._reply()
    (told,) = map(unpack, answers)
    assert (told.kind, told.request_id, told.body["code"]) == ("error", "r", Code.EXECUTION)
    assert told.body["message"] == "the gateway failed: ZeroDivisionError: a defect"


def _is_whole(body: Any, version: Any) -> bool:
    """Whether LeRobot's codec takes a message with this body."""
    try:
        unpack(enveloped("describe", body))
    except WireError:
        return False
    return version == 1 and type(version) is int


@pytest.fixture(scope="module")
def silent_side(terms: Terms) -> Iterator[LerobotSide]:
    """A side that nobody works for, in front of no seat."""

    class Nobody:
        models = ("sha",)

        def unready(self) -> str:
            return "pounce is loading"

    side = LerobotSide(("127.0.0.1", free_ports(1)[0]), Nobody(), terms, 1)  # type: ignore[arg-type]
    yield side
    side._bus.close()
