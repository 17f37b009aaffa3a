"""A session of LeRobot's remote inference: who is admitted, what is asked and answered, and which generation holds;
whatever else comes is an error with a code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import messages as m
from protocol.peers.lerobot import Code, Envelope, WireError, unpack
from sim_client.gateway.exchange import Answer, Behind, Terms
from sim_client.gateway.lerobot import ALIGNED, Deployment, Session, capabilities, check_mapping

PX, ROWS = 4, 5
JOINTS = ["pan.pos", "lift.pos", "gripper.pos"]
STATE, FRONT, WRIST = "observation.state", "observation.images.front", "observation.images.wrist"
TOLD = ("sha",)


@pytest.fixture
def deployment(terms: Terms) -> Deployment:
    return Deployment(terms)


@pytest.fixture(scope="module")
def opening(wire: Any) -> Callable[..., Envelope]:
    """What a client of this mapping opens a session with, or with these changes of it."""

    def make(deployment: Deployment, **changes: Any) -> Envelope:
        ours = capabilities(deployment.terms)
        body = {
            "expected_artifact": deployment.described(Envelope(kind="describe"), "", TOLD).body["artifact_identity"],
            "features": ours["features"], "action_feature": ours["action_feature"], "semantics": "arm",
            "action_interval": 0.05, "mode": "chunk", "encoding": "raw", "chunk_settings": {"chunk_merge": "aligned"},
            "required_capabilities": [ALIGNED],
        }  # fmt: skip
        return unpack(wire.enveloped("open", body | changes, instance_id=deployment.instance_id))

    return make


@pytest.fixture
def session(deployment: Deployment, opening: Callable[..., Envelope]) -> Session:
    return deployment.sessions[deployment.admitted(opening(deployment), "", TOLD, 0).session_id]


@pytest.fixture
def asked(session: Session, wire: Any) -> Callable[..., Envelope]:
    """A question of the session's client, with this sequence and these changes."""

    def make(sequence: int, message: str = "observation", **changes: Any) -> Envelope:
        body = wire.observation(session.artifact, sequence, **changes)
        return unpack(wire.enveloped(message, body, instance_id="i", session_id=session.id))

    return make


# -- what is told, and who is admitted


def test_a_robot_s_features_are_told_by_the_names_of_its_joints(deployment: Deployment) -> None:
    told = deployment.described(Envelope(kind="describe", request_id="a1"), "", TOLD)
    ours = told.body["capabilities"]
    assert [(each["name"], each["shape"], each["kind"], each["dtype"]) for each in ours["features"]] == [
        (STATE, [3], "tensor", "float32"), (FRONT, [PX, PX, 3], "rgb", "uint8"), (WRIST, [PX, PX, 3], "rgb", "uint8"),
    ]  # fmt: skip
    assert ours["features"][0]["names"] == ours["action_feature"]["names"] == JOINTS
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


def test_what_is_accepted_repeats_what_was_told(deployment: Deployment, opening: Callable[..., Envelope]) -> None:
    told = deployment.described(Envelope(kind="describe"), "", TOLD).body
    accepted = deployment.admitted(opening(deployment), "", TOLD, 0)
    for name in ("capabilities", "artifact_identity", "limits"):
        assert accepted.body[name] == told[name]
    assert (accepted.body["mode"], accepted.body["chunk_settings"]) == ("chunk", {"chunk_merge": "aligned"})
    assert accepted.session_id in deployment.sessions


FEATURE = {"name": STATE, "shape": [3], "dtype": "float32", "kind": "tensor", "names": JOINTS, "semantics": "arm"}


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
    deployment: Deployment, changes: dict[str, Any], code: Code, said: str, opening: Callable[..., Envelope]
) -> None:
    with pytest.raises(WireError, match=said) as refused:
        deployment.admitted(opening(deployment, **changes), "", TOLD, 0)
    assert refused.value.code == code
    assert not deployment.sessions


def test_as_many_are_admitted_as_there_are_seats(terms: Terms, opening: Callable[..., Envelope]) -> None:
    deployment = Deployment(terms, num_seats=2)
    first = deployment.admitted(opening(deployment), "", TOLD, 0)
    deployment.admitted(opening(deployment), "", TOLD, 0)
    with pytest.raises(WireError, match="all 2 seats are taken") as refused:
        deployment.admitted(opening(deployment), "", TOLD, 4_000_000_000)
    assert refused.value.code == Code.BUSY
    assert refused.value.details == {"admission_blocker": "awaiting_initial_presence", "absence_grace_remaining_s": 6.0}
    del deployment.sessions[first.session_id]
    deployment.admitted(opening(deployment), "", TOLD, 0)


def test_in_lockstep_rows_are_appended_and_text_is_not_served(terms: Terms, opening: Callable[..., Envelope]) -> None:
    deployment = Deployment(replace(terms, mode=m.Mode.LOCKSTEP))
    assert not capabilities(deployment.terms)["language"]
    with pytest.raises(WireError, match="required_capabilities"):
        deployment.admitted(opening(deployment), "", TOLD, 0)
    settings = {"chunk_settings": {"chunk_merge": "append"}, "required_capabilities": []}
    deployment.admitted(opening(deployment, **settings), "", TOLD, 0)


# -- a session


def test_an_observation_is_a_step_in_our_units(session: Session, asked: Callable[..., Envelope]) -> None:
    step = session.observed(asked(1))
    np.testing.assert_allclose(step.state, [np.pi / 2, -np.pi / 4, 0.5], rtol=1e-6)
    assert sorted(step.frames) == ["front", "wrist"]
    assert (step.frames["front"] == 1).all()
    assert (step.instruction, step.begins, step.may_begin) == ("put the cube in the bin", False, True)


def test_rows_go_back_in_theirs_with_what_was_asked(session: Session, asked: Callable[..., Envelope]) -> None:
    question = asked(1)
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


def test_another_task_begins_an_episode_and_our_own_subgoal_does_not(
    session: Session, asked: Callable[..., Envelope]
) -> None:
    language = {"kind": "next_subtask", "text": "what next?", "intent_generation": 3}
    session.observed(asked(1))
    question = asked(2, "language_request", **language)
    session.observed(question)
    rows = np.zeros((ROWS, 3), np.float32)
    behind = Behind(subgoal="reach it", subgoal_age_ns=1_500_000_000)
    told = session.answered(question, Answer(rows_NA=rows, tick=1, levels=(), behind=behind))
    assert (told.kind, told.body["answer"], told.body["age_s"]) == ("language_result", "reach it", 1.5)
    assert (told.body["kind"], told.body["intent_generation"]) == ("next_subtask", 3)
    steered = session.observed(asked(3, task="reach it", task_version=1))
    assert (steered.begins, steered.instruction) == (False, "put the cube in the bin")
    other = session.observed(asked(4, task="wipe the table", task_version=2))
    assert (other.begins, other.instruction) == (True, "wipe the table")
    with pytest.raises(WireError, match="no subgoal yet") as refused:
        session.answered(question, Answer(rows_NA=rows, tick=1, levels=()))
    assert refused.value.code == Code.EXECUTION  # which LeRobot tells its user, and goes on


def test_a_state_of_other_numbers_is_refused(session: Session, asked: Callable[..., Envelope], wire: Any) -> None:
    features = {STATE: wire.tensor(np.zeros(3)), FRONT: wire.picture(1), WRIST: wire.picture(1)}
    with pytest.raises(WireError, match="float32") as refused:
        session.observed(asked(1, features=features))
    assert refused.value.code == Code.INCOMPATIBLE


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
        ({"message": "language_request", "text": "?"}, Code.MALFORMED, "intent_generation"),
        ({"message": "language_request", "kind": "vqa", **QUESTION}, Code.UNSUPPORTED, "expected next_subtask"),
    ],
)
def test_what_cannot_be_used_gets_a_code(
    session: Session, changes: dict[str, Any], code: Code, said: str, asked: Callable[..., Envelope], wire: Any
) -> None:
    session.observed(asked(0))
    body = wire.observation(session.artifact, 1) | changes
    generation, message = body.pop("generation", 0), body.pop("message", "observation")
    question = unpack(wire.enveloped(message, body, instance_id="i", session_id=session.id, generation=generation))
    with pytest.raises(WireError, match=said) as refused:
        session.observed(question)
    assert refused.value.code == code


@given(st.lists(st.tuples(st.sampled_from(["reset", "invalidate", "status", "close"]), st.integers(0, 4)), max_size=12))
def test_generations_only_rise_and_what_is_acknowledged_holds(wire: Any, steps: list[tuple[str, int]]) -> None:
    session = Session(terms=None, artifact="a", is_aligned=True)  # type: ignore[arg-type]
    for operation, generation in steps:
        before = session.generation
        question = unpack(
            wire.enveloped("control", {"operation": operation}, instance_id="i", session_id="s", generation=generation)
        )
        is_old = operation != "close" and generation < before
        if is_old or (operation == "status" and generation != before):
            with pytest.raises(WireError, match="generation"):
                session.controlled(question)
            assert session.generation == before
        else:
            _, ack = session.controlled(question)
            assert ack.body["applied_generation"] == session.generation == generation


def test_a_mapping_file_names_every_joint_and_camera(wire: Any) -> None:
    check_mapping(wire.mapping, ("front", "wrist"))
    for changes, said in (
        ({"names": {("action",): tuple(JOINTS)}}, f"has no {STATE}"),
        ({"cameras": wire.mapping.cameras[:1]}, "wrist"),
        ({"cameras": (replace(wire.mapping.cameras[0], size_px=None), wire.mapping.cameras[1])}, "size_px"),
        ({"actions": (replace(wire.mapping.actions[0], kind="delta"), wire.mapping.actions[1])}, "kind delta"),
        ({"actions": (replace(wire.mapping.actions[0], key=("arm",)), wire.mapping.actions[1])}, "under one key"),
    ):
        with pytest.raises(ValueError, match=said):
            check_mapping(replace(wire.mapping, **changes), ("front", "wrist"))
