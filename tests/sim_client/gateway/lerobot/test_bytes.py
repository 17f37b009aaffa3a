"""LeRobot's remote inference byte by byte: an exchange set down by hand from its published wire, no codec of ours at
work, which the gateway answers and the back end of `pounce-serve` plays its part in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest

from pounce_server.remote import lerobot as back_end
from protocol import messages as m
from protocol.peers.lerobot import pack, unpack
from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt
from sim_client.gateway.exchange import Answer, Terms
from sim_client.gateway.lerobot import Deployment, Session

INSTANCE = b"\xd9\x20" + b"0123456789abcdef" * 2
SESSION = b"\xd9\x20" + b"fedcba9876543210" * 2
ARTIFACT = b"\xd9\x47sha256:" + b"0" * 64
INTERVAL = b"\xcb\x3f\xa9\x99\x99\x99\x99\x99\x9a"  # 0.05
JOINTS = b"\xa5names\x93\xa7pan.pos\xa8lift.pos\xabgripper.pos\xa9semantics\xa3arm"
FEATURES = (
    b"\xa8features\x92"
    b"\x86\xa4name\xb1observation.state\xa5shape\x91\x03\xa5dtype\xa7float32\xa4kind\xa6tensor" + JOINTS +
    b"\x86\xa4name\xb8observation.images.front\xa5shape\x93\x01\x01\x03\xa5dtype\xa5uint8\xa4kind\xa3rgb"
    b"\xa5names\x90\xa9semantics\xa3arm"
    b"\xaeaction_feature\x86\xa4name\xa6action\xa5shape\x91\x03\xa5dtype\xa7float32\xa4kind\xa6tensor" + JOINTS
)  # fmt: skip
PLACE = b"\xabinstance_id" + INSTANCE + b"\xaasession_id" + SESSION

DESCRIBE = (
    b"\x87\xa7version\x01\xacmessage_type\xa8describe\xabinstance_id\xa0\xaasession_id\xa0\xaageneration\x00"
    b"\xaarequest_id\xa2a1\xa4body\x80"
)
DESCRIPTOR = (
    b"\x87\xa7version\x01\xacmessage_type\xaadescriptor\xabinstance_id" + INSTANCE + b"\xaasession_id\xa0"
    b"\xaageneration\x00\xaarequest_id\xa2a1\xa4body\x8c"
    b"\xaadeployment\xa3arm\xabinstance_id" + INSTANCE + b"\xb1artifact_identity" + ARTIFACT + b"\xa9semantics\xa3arm"
    b"\xaccapabilities\x8c\xa5modes\x91\xa5chunk\xb0prediction_steps\x02\xafexecution_steps\x02\xafaction_interval"
    + INTERVAL + FEATURES +
    b"\xa8language\xc2\xb2training_max_delay\x00\xabrtc_horizon\x00\xb8current_observation_only\xc3"
    b"\xb5retains_session_state\xc2\xb5action_representation\xa9canonical"
    b"\xb3execution_contracts\x91\xb2chunk_alignment_v2\xa5ready\xc3\xa9available\xc3\xa7failure\xc0"
    b"\xa7session\x87\xa5owner\xc0\xaeclient_present\xc2\xb9absence_grace_remaining_s\xc0\xafcleanup_pending\xc2"
    b"\xaecleanup_reason\xc0\xb1inference_pending\xc2\xb1admission_blocker\xc0"
    b"\xaesession_status\xa4idle"
    b"\xa6limits\x87\xb1action_deadline_s\x05\xb3language_deadline_s\x3c\xaeidle_timeout_s\x0a"
    b"\xafmax_input_chars\xcd\x10\x00\xb0max_output_chars\xcd\x20\x00\xa5codec\x80\xb2inflight_inference\x01"
)  # fmt: skip
OPEN = (
    b"\x87\xa7version\x01\xacmessage_type\xa4open\xabinstance_id" + INSTANCE + b"\xaasession_id\xa0"
    b"\xaageneration\x00\xaarequest_id\xa2a2\xa4body\x89\xb1expected_artifact" + ARTIFACT + FEATURES +
    b"\xa9semantics\xa3arm\xafaction_interval" + INTERVAL + b"\xa4mode\xa5chunk\xa8encoding\xa3raw"
    b"\xaechunk_settings\x81\xabchunk_merge\xa7aligned\xb5required_capabilities\x91\xb2chunk_alignment_v2"
)  # fmt: skip
ACCEPTED = (
    DESCRIPTOR.replace(b"\xaadescriptor", b"\xa8accepted")
    .replace(b"\xaasession_id\xa0", b"\xaasession_id" + SESSION)
    .replace(b"body\x8c", b"body\x8e\xa4mode\xa5chunk\xaechunk_settings\x81\xabchunk_merge\xa7aligned")
)
CONTROL = (
    b"\x87\xa7version\x01\xacmessage_type\xa7control" + PLACE + b"\xaageneration\x01\xaarequest_id\xa2c1"
    b"\xa4body\x81\xa9operation\xa5reset"
)
ACK = (
    b"\x87\xa7version\x01\xacmessage_type\xa3ack" + PLACE + b"\xaageneration\x01\xaarequest_id\xa2c1"
    b"\xa4body\x82\xa9operation\xa5reset\xb2applied_generation\x01"
)
ECHO = (
    b"\xb1artifact_identity" + ARTIFACT + b"\xaeobservation_id\xa2o1"
    b"\xaccapture_time\xcb\x40\x28\x80\x00\x00\x00\x00\x00\xa4task\xa2go\xactask_version\x00"
)  # fmt: skip
TENSOR = b"\x85\xb0__lerobot_type__\xa6tensor\xa5dtype\xa7float32\xaaendianness\xa6little"
OBSERVATION = (
    b"\x87\xa7version\x01\xacmessage_type\xabobservation" + PLACE + b"\xaageneration\x01\xaarequest_id\xa2r1"
    b"\xa4body\x8c\xa8sequence\x01" + ECHO +
    b"\xa8features\x82\xb1observation.state" + TENSOR + b"\xa5shape\x91\x03"
    b"\xa4data\xc4\x0c\x00\x00\xb4\x42\x00\x00\x34\xc2\x00\x00\x48\x42"  # 90, -45, 50
    b"\xb8observation.images.front\x86\xb0__lerobot_type__\xa3rgb\xa8encoding\xa3raw\xa5shape\x93\x01\x01\x03"
    b"\xa5dtype\xa5uint8\xadchannel_order\xa3RGB\xa4data\xc4\x03\x0a\x14\x1e"
    b"\xa5delay\x00\xb2model_continuation\xc0\xb6canonical_continuation\xc0\xa6cursor\x05\xb2observation_cursor\x04"
)  # fmt: skip
ACTION = (
    b"\x87\xa7version\x01\xacmessage_type\xa6action" + PLACE + b"\xaageneration\x01\xaarequest_id\xa2r1"
    b"\xa4body\x8b" + ECHO + b"\xa6cursor\x05\xb2observation_cursor\x04"
    b"\xb1canonical_actions" + TENSOR + b"\xa5shape\x92\x02\x03\xa4data\xc4\x18"
    b"\x00\x00\x34\x43\x00\x00\x00\x00\x00\x00\xc8\x42"  # 180, 0, 100
    b"\x00\x00\xb4\x42\x00\x00\x34\xc2\x00\x00\x00\x00"  # 90, -45, 0
    b"\xadmodel_actions\xc0\xafexecution_steps\x02\xb0server_durations\x81\xa6policy\xcb\x3f\xe0\x00\x00\x00\x00\x00\x00"
)  # fmt: skip
MAPPING = PolicyMapping(
    name="arm", rate_hz=20, play_hz=20, horizon=2, num_proprio=3, num_commands=3,
    prompt=Prompt(key=("task",)),
    cameras=(Camera(camera="front", key=("observation.images.front",), size_px=(1, 1)),),
    state=(
        Numbers(key=("observation.state",), columns=(0, 1), dims=(0, 1), scale=np.pi / 180),
        Numbers(key=("observation.state",), columns=(2,), dims=(2,), scale=0.01),
    ),
    actions=(
        Numbers(key=("action",), columns=(0, 1), dims=(0, 1), scale=np.pi / 180),
        Numbers(key=("action",), columns=(2,), dims=(2,), scale=0.01, kind="gripper"),
    ),
    names={(key,): ("pan.pos", "lift.pos", "gripper.pos") for key in ("observation.state", "action")},
)  # fmt: skip


def plain(packet: bytes) -> dict[str, Any]:
    return dict(msgpack.unpackb(packet))


def text(spelled: bytes) -> str:
    return str(msgpack.unpackb(spelled))


@pytest.fixture
def deployment(terms_with: Callable[..., Terms], monkeypatch: pytest.MonkeyPatch) -> Deployment:
    """The gateway's, with the ids of the bytes."""
    monkeypatch.setattr(Deployment, "_artifact", lambda *_: text(ARTIFACT))
    terms = terms_with(mode=m.Mode.REALTIME, rows=2, mapping=MAPPING)
    return Deployment(terms, instance_id=text(INSTANCE))


def test_the_gateway_tells_and_admits(deployment: Deployment) -> None:
    told, golden = plain(pack(deployment.described(unpack(DESCRIBE), "", ()))), plain(DESCRIPTOR)
    ours, theirs = told.pop("body"), golden.pop("body")
    assert told == golden
    assert ours.keys() - {"software"} == theirs.keys()
    told_limits, theirs_limits = ours["limits"], theirs["limits"]
    assert told_limits | {"codec": {}} == theirs_limits
    for name in ("deployment", "instance_id", "artifact_identity", "execution_contracts", "ready", "available",
                 "failure", "session", "session_status", "semantics"):  # fmt: skip
        assert ours[name] == theirs[name], name
    assert ours["capabilities"] | {"language": False, "retains_session_state": False} == theirs["capabilities"]
    accepted = plain(pack(deployment.admitted(unpack(OPEN), "", (), 0)))
    (session,) = deployment.sessions
    header = {name: accepted[name] for name in ("version", "message_type", "instance_id", "generation", "request_id")}
    golden = plain(ACCEPTED)
    assert header == {name: golden[name] for name in header} | {"request_id": "a2"}
    assert accepted["session_id"] == session
    assert accepted["body"].keys() == golden["body"].keys() | {"software"}
    for name in ("mode", "chunk_settings"):
        assert accepted["body"][name] == golden["body"][name]
    assert accepted["body"]["capabilities"] == ours["capabilities"]


def test_the_gateway_answers_a_control_message_and_an_observation(deployment: Deployment) -> None:
    session = Session(deployment.terms, text(ARTIFACT), True, id=text(SESSION))
    assert plain(pack(session.controlled(unpack(CONTROL))[1])) == plain(ACK)
    question = unpack(OBSERVATION)
    step = session.observed(question)
    np.testing.assert_allclose(step.state, [np.pi / 2, -np.pi / 4, 0.5], rtol=1e-6)
    assert step.frames["front"].tolist() == [[[10, 20, 30]]]
    rows = np.array([[np.pi, 0, 1], [np.pi / 2, -np.pi / 4, 0]], np.float32)
    told = plain(pack(session.answered(question, Answer(rows_NA=rows, tick=5, levels=(m.Level.PLAY,) * 2))))
    golden = plain(ACTION)
    ours, theirs = told.pop("body"), golden.pop("body")
    assert told == golden
    assert {type(seconds) for seconds in ours.pop("server_durations").values()} == {float}
    theirs.pop("server_durations")
    assert {name: ours[name] for name in theirs} == theirs  # and three of ours that LeRobot leaves alone
    assert ours.keys() - theirs.keys() == {"tick", "levels", "gate_score"}


class Server:
    """A bus with a LeRobot server behind it that knows these bytes only."""

    def __init__(self, *_: Any) -> None:
        self.asked: dict[str, dict[str, Any]] = {}
        self._answers: list[Any] = []

    def ask(self, key: str, packet: bytes, timeout_ns: int) -> Future[bytes]:
        done: Future[bytes] = Future()
        done.set_result(self._replied(key, packet))
        return done

    def publish(self, key: str, packet: bytes, **_: Any) -> None:
        self._answers.append(SimpleNamespace(payload=self._replied(key, packet)))

    def _replied(self, key: str, packet: bytes) -> bytes:
        asked = plain(packet)
        kind, request = asked["message_type"], asked["request_id"].encode()
        self.asked[f"{kind} {asked['generation']}"] = asked | {"key": key}
        golden = {"describe": DESCRIPTOR, "open": ACCEPTED, "control": ACK, "observation": ACTION}[kind]
        for word in (b"\xa2a1", b"\xa2c1", b"\xa2r1"):
            golden = golden.replace(b"\xaarequest_id" + word, b"\xaarequest_id\xd9\x20" + request)
        number = bytes([asked["generation"]])
        return golden.replace(b"generation\x01", b"generation" + number)

    def subscribe(self, key: str, keep: int) -> Any:
        def drain() -> list[Any]:
            found, self._answers = self._answers, []
            return found

        return SimpleNamespace(drain=drain)

    def declare_alive(self, key: str) -> None:
        self.alive = key

    def wait(self, longest_ns: int) -> None: ...

    def close(self) -> None: ...


def test_the_back_end_asks_as_it_is_written_and_reads_the_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server()
    monkeypatch.setattr(back_end, "ZenohBus", lambda _: server)
    peer, patience = back_end.LerobotPeer("tcp/127.0.0.1:7450#arm", MAPPING), SimpleNamespace(look_s=lambda: 0.1)
    peer.begin(patience)  # type: ignore[arg-type]
    values: Mapping[Any, Any] = {
        ("task",): "go", ("observation.state",): np.array([90, -45, 50], np.float32),
        ("observation.images.front",): np.array([[[10, 20, 30]]], np.uint8),
    }  # fmt: skip
    rows = peer.infer(values, patience)[back_end.ACTION]  # type: ignore[arg-type]
    assert rows.dtype == np.float32
    assert rows.tolist() == [[180, 0, 100], [90, -45, 0]]
    at = f"lerobot/inference/v1/deployments/arm/instances/{text(INSTANCE)}"
    of_session = f"{at}/sessions/{text(SESSION)}"
    assert server.alive == f"{of_session}/alive"
    append = {"chunk_settings", "required_capabilities"}  # our clock places the rows: no cursors on the wire
    expected = {
        "describe 0": (DESCRIBE, "lerobot/inference/v1/deployments/arm/describe"), "open 0": (OPEN, f"{at}/open"),
        "control 1": (CONTROL, f"{of_session}/control"), "observation 1": (OBSERVATION, f"{of_session}/obs"),
    }  # fmt: skip
    for name, (packet, key) in expected.items():
        golden, came = plain(packet), server.asked[name]
        assert came.pop("key") == key
        assert came.pop("request_id") != golden.pop("request_id")
        for each in append | {"observation_cursor", "cursor", "capture_time", "observation_id", "task_version"}:
            golden["body"].pop(each, None)
        for each in ("cursor", "capture_time", "observation_id", "task_version"):
            came["body"].pop(each, None)
        assert came == golden, name


@pytest.mark.parametrize("packet", [DESCRIBE, DESCRIPTOR, OPEN, ACCEPTED, CONTROL, ACK, OBSERVATION, ACTION])
def test_what_is_read_and_written_again_is_the_same(packet: bytes) -> None:
    """And one byte more, one less, or another version is refused."""
    again = plain(pack(unpack(packet)))
    assert again == plain(packet)
    with pytest.raises(ValueError, match=r"."):
        unpack(packet[:-1])
    with pytest.raises(ValueError, match=r"."):
        unpack(packet + b"\x00")
    with pytest.raises(ValueError, match="expected 1"):
        unpack(packet.replace(b"version\x01", b"version\x02"))
