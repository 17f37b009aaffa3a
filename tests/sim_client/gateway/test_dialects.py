"""All dialects say the same things: what their clients send is understood, and what they cannot mean is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import messages as m
from sim_client.gateway import challenge, mme_vla, openpi, reading, vla_eval
from sim_client.gateway.arrays import pack, unpack
from sim_client.gateway.exchange import Answer, Behind, ClientRequest, Finish, Refused, Step, Terms

PictureOf = Callable[[int], np.ndarray]
TermsWith = Callable[..., Terms]
FLOATS = st.floats(-3, 3, width=32)


@pytest.fixture
def speak_openpi(terms_with: TermsWith) -> openpi.OpenpiDialect:
    return openpi.OpenpiDialect(terms_with(cameras=openpi.CAMERAS, state_key=openpi.STATE_KEY))


@pytest.fixture
def speak_challenge(terms_with: TermsWith) -> challenge.ChallengeDialect:
    return challenge.ChallengeDialect(terms_with(cameras=challenge.CAMERAS, rows=2))


@pytest.fixture
def speak_mme_vla(terms_with: TermsWith) -> mme_vla.MmeVlaDialect:
    return mme_vla.MmeVlaDialect(terms_with(cameras=openpi.CAMERAS, state_key=openpi.STATE_KEY, rows=2))


@pytest.fixture
def speak_vla_eval(terms_with: TermsWith) -> vla_eval.VlaEvalDialect:
    return vla_eval.VlaEvalDialect(terms_with(cameras=vla_eval.CAMERAS, state_key="states"))


def understood(asked: ClientRequest) -> Step:
    assert isinstance(asked.request, Step)
    return asked.request


@given(rows=st.lists(st.lists(FLOATS, min_size=3, max_size=3), min_size=1, max_size=20), tick=st.integers(0, 10**6))
def test_an_answer_reaches_every_client_bit_for_bit(rows: list[list[float]], tick: int) -> None:
    values = np.array(rows, np.float32)
    behind = Behind(
        subgoal="press the button", subgoal_age_ns=1_500_000_000, cognition_age_ns=250_000_000, gate_score=0.125
    )
    answer = Answer(rows_NA=values, tick=tick, levels=(m.Level.PLAY,) * len(rows), behind=behind)
    beside = {"tick": tick, "subgoal": "press the button", "subgoal_age_s": 1.5, "cognition_age_s": 0.25}
    beside |= {"gate_score": 0.125}
    terms: Any = None
    for dialect in (openpi.OpenpiDialect(terms), challenge.ChallengeDialect(terms), mme_vla.MmeVlaDialect(terms)):
        told = unpack(dialect.answer(ClientRequest(None), answer))
        assert (told["actions"].tobytes(), told["actions"].shape) == (values.tobytes(), values.shape)
        assert told.items() >= (beside | {"levels": ["PLAY"] * len(rows)}).items()
    told = unpack(vla_eval.VlaEvalDialect(terms).answer(ClientRequest(None, seq=7), answer))
    assert (told["type"], told["seq"]) == ("action", 7)
    assert told["payload"]["actions"].tobytes() == values[0].tobytes()
    assert told["payload"].items() >= (beside | {"level": "PLAY"}).items()


# -- openpi


def openpi_packet(picture_of: PictureOf, **changes: Any) -> bytes:
    message = {
        "observation/image": picture_of(1),
        "observation/wrist_image": picture_of(2),
        "observation/state": np.array([1.0, 2.0, 3.0]),
        "prompt": "pick",
    }
    message |= changes
    return pack({key: value for key, value in message.items() if value is not None}, "openpi")


def test_openpi_an_observation_is_understood(speak_openpi: openpi.OpenpiDialect, picture_of: PictureOf) -> None:
    step = understood(speak_openpi.read(openpi_packet(picture_of)))
    assert (step.instruction, step.state.tolist()) == ("pick", [1.0, 2.0, 3.0])
    assert [int(step.frames[name][0, 0, 0]) for name in ("front", "wrist")] == [1, 2]


def test_openpi_another_prompt_or_a_reset_begins_an_episode(
    speak_openpi: openpi.OpenpiDialect, picture_of: PictureOf
) -> None:
    prompts = ["pick", "pick", "place", "place"]
    steps = [understood(speak_openpi.read(openpi_packet(picture_of, prompt=prompt))) for prompt in prompts]
    assert [step.begins for step in steps] == [False, False, True, False]
    assert all(step.may_begin for step in steps)
    asked = speak_openpi.read(pack({"reset": True}, "openpi"))
    assert isinstance(asked.request, Finish)
    assert unpack(asked.reply) == {"reset_finished": True}  # type: ignore[arg-type]


def test_openpi_metadata_greets_the_client(speak_openpi: openpi.OpenpiDialect) -> None:
    told = unpack(speak_openpi.greeting())
    assert told["cameras"] == openpi.CAMERAS
    assert (told["rows"], told["control_hz"], told["mode"]) == (1, 20, "lockstep")


def test_openpi_keys_may_name_entries_of_maps_within(terms_with: TermsWith, picture_of: PictureOf) -> None:
    terms = terms_with(cameras={"front": "images/cam_high"}, state_key="state")
    message = {"images": {"cam_high": picture_of(5)}, "state": [0, 0, 0], "prompt": "fold"}
    step = understood(openpi.OpenpiDialect(terms).read(pack(message, "openpi")))
    assert int(step.frames["front"][0, 0, 0]) == 5


@pytest.mark.parametrize("rate", [{}, {"demonstration_hz": 5}])
def test_openpi_an_observation_may_bring_a_demonstration(
    speak_openpi: openpi.OpenpiDialect, picture_of: PictureOf, rate: dict[str, int]
) -> None:
    video = [picture_of(shade) for shade in (7, 8, 9)]
    step = understood(speak_openpi.read(openpi_packet(picture_of, demonstration=video, **rate)))
    assert step.demo_hz == rate.get("demonstration_hz", 0)
    assert [[int(frames[name][0, 0, 0]) for name in ("front", "wrist")] for frames in step.demo] == [
        [7] * 2,
        [8] * 2,
        [9] * 2,
    ]
    assert not len(understood(speak_openpi.read(openpi_packet(picture_of))).demo)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"prompt": None}, "expected 'prompt'"),
        ({"prompt": ""}, "expected a sentence"),
        ({"prompt": 3}, "expected a sentence"),
        ({"observation/image": None}, "expected 'observation/image' .the front camera"),
        ({"observation/image": np.zeros((4, 4))}, "expected a picture"),
        ({"observation/image": np.zeros((3, 4, 4), np.uint8)}, "expected a picture"),
        ({"observation/image": np.zeros((4, 4, 3), np.float32)}, "expected a picture"),
        ({"observation/state": [1.0, 2.0]}, "expected 3 numbers, came 2"),
        ({"observation/state": np.zeros(9)}, "expected 3 numbers, came 9.*--robot-file"),
        ({"observation/state": [1.0, 2.0, float("nan")]}, "expected finite numbers"),
        ({"observation/state": "joints"}, "expected 3 numbers"),
        ({"observation/state": [1.0, 2.0, 1e300]}, "expected finite numbers"),
        ({"demonstration": 3}, "demonstration: expected a list"),
        ({"demonstration_hz": 0.5}, "demonstration_hz: expected frames per second, 1 to 120"),
        ({"demonstration_hz": -1}, "demonstration_hz: expected frames per second"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")
def test_openpi_what_cannot_be_used_is_told(
    speak_openpi: openpi.OpenpiDialect, picture_of: PictureOf, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(Refused, match=sentence):
        speak_openpi.read(openpi_packet(picture_of, **changes))
    assert speak_openpi.refuse("a sentence") == "a sentence"  # text is openpi's form of an error


@pytest.mark.parametrize("packet", [b"", b"\xff", pack([1], "openpi"), pack("text", "openpi"), "text"])
def test_what_is_no_message_is_told_by_everybody(
    speak_openpi: openpi.OpenpiDialect,
    speak_challenge: challenge.ChallengeDialect,
    speak_vla_eval: vla_eval.VlaEvalDialect,
    packet: Any,
) -> None:
    for dialect in (speak_openpi, speak_challenge, speak_vla_eval):
        with pytest.raises(Refused, match=r"expected|not a msgpack"):
            dialect.read(packet)


# -- the challenge


def challenge_packet(picture_of: PictureOf, shades: list[int], *, first: bool, **changes: Any) -> bytes:
    message: dict[str, Any] = {
        "task_goal": ["pick", "take"],
        "is_first_step": first,
        "front_rgb_list": [picture_of(shade) for shade in shades],
        "wrist_rgb_list": [picture_of(shade + 1) for shade in shades],
        "joint_state_list": [np.array([shade, 0.0]) for shade in shades],
        "gripper_state_list": [np.array([0.04, -0.04]) for _ in shades],
    }
    return pack(message | changes, "openpi")


def test_challenge_the_first_call_holds_the_video_and_what_is_seen_now(
    speak_challenge: challenge.ChallengeDialect, picture_of: PictureOf
) -> None:
    step = understood(speak_challenge.read(challenge_packet(picture_of, [10, 11, 12], first=True)))
    assert (step.begins, step.instruction) == (True, "pick")
    assert [int(frames["wrist"][0, 0, 0]) for frames in step.demo] == [11, 12]
    assert int(step.frames["front"][0, 0, 0]) == 12
    assert step.state.tolist() == pytest.approx([12.0, 0.0, 0.04])


def test_challenge_later_calls_hold_one_observation_for_each_row_played(
    speak_challenge: challenge.ChallengeDialect, picture_of: PictureOf
) -> None:
    step = understood(speak_challenge.read(challenge_packet(picture_of, [21, 22], first=False)))
    assert not step.begins
    assert [(int(seen.frames["front"][0, 0, 0]), seen.state[0]) for seen in step.since] == [(21, 21.0)]
    assert (int(step.frames["front"][0, 0, 0]), step.state[0]) == (22, 22.0)
    with pytest.raises(Refused, match=r"expected 2 observations.*came 1.*--rows 1"):
        speak_challenge.read(challenge_packet(picture_of, [21], first=False))


def test_challenge_a_stick_has_no_finger(speak_challenge: challenge.ChallengeDialect, picture_of: PictureOf) -> None:
    packet = challenge_packet(picture_of, [1], first=True, gripper_state_list=[np.zeros(0)])
    assert understood(speak_challenge.read(packet)).state.tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"front_rgb_list": []}, "equally long"),
        ({"front_rgb_list": [], "wrist_rgb_list": []}, "at least what is seen now"),
        ({"front_rgb_list": 3}, "expected a list"),
        ({"joint_state_list": []}, "expected 1, came 0 and 1"),
        ({"task_goal": []}, "expected a sentence"),
    ],
)
def test_challenge_what_cannot_be_used_is_told(
    speak_challenge: challenge.ChallengeDialect, picture_of: PictureOf, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(Refused, match=sentence):
        speak_challenge.read(challenge_packet(picture_of, [1], first=True, **changes))


# -- vla-eval


def vla_eval_packet(kind: str, payload: Any, seq: int = 5) -> bytes:
    return pack({"type": kind, "payload": payload, "seq": seq, "timestamp": 0.0}, "vla-eval")


def vla_eval_observation(picture_of: PictureOf, **changes: Any) -> bytes:
    payload: dict[str, Any] = {
        "images": {"agentview": picture_of(1), "whatever": picture_of(2)},
        "task_description": "pick",
        "states": np.zeros(3, np.float32),
    }
    return vla_eval_packet("observation", payload | changes)


def test_vla_eval_hello_asks_for_all_that_ponder_wants(speak_vla_eval: vla_eval.VlaEvalDialect) -> None:
    asked = speak_vla_eval.read(vla_eval_packet("hello", {"harness_version": "0.8.0", "protocol_version": 1}))
    told = unpack(asked.reply)  # type: ignore[arg-type]
    assert (asked.request, told["type"], told["seq"]) == (None, "hello", 5)
    assert told["payload"]["observation_params"]["send_video_history"] is True
    with pytest.raises(Refused, match="protocol version"):
        speak_vla_eval.read(vla_eval_packet("hello", {"protocol_version": 2}))


def test_vla_eval_an_episode_begins_with_its_first_observation(
    speak_vla_eval: vla_eval.VlaEvalDialect, picture_of: PictureOf
) -> None:
    assert speak_vla_eval.read(vla_eval_packet("episode_start", {"task": {"name": "PickIt"}})).request is None
    video = {"video_history": [picture_of(7), picture_of(8)], "wrist_video_history": [picture_of(9), picture_of(10)]}
    first = understood(speak_vla_eval.read(vla_eval_observation(picture_of, **video)))
    assert (first.begins, first.task, len(first.demo)) == (True, "PickIt", 2)
    assert [int(first.demo[1][name][0, 0, 0]) for name in ("front", "wrist")] == [8, 10]
    assert [int(first.frames[name][0, 0, 0]) for name in ("front", "wrist")] == [1, 2]
    assert not understood(speak_vla_eval.read(vla_eval_observation(picture_of))).begins


@pytest.mark.parametrize(
    ("metrics", "status"),
    [({"success": True}, "SUCCESS"), ({"success": False}, "FAIL"), ({}, "ONGOING"), (None, "ONGOING")],
)
def test_vla_eval_the_harness_says_how_it_ended(
    speak_vla_eval: vla_eval.VlaEvalDialect, metrics: Any, status: str
) -> None:
    asked = speak_vla_eval.read(vla_eval_packet("episode_end", {"metrics": metrics, "steps": 12}))
    assert isinstance(asked.request, Finish)
    assert asked.request.status.name == status
    assert asked.reply is None


def test_vla_eval_a_runner_of_the_other_mode_is_told_at_each_observation(
    speak_vla_eval: vla_eval.VlaEvalDialect, picture_of: PictureOf
) -> None:
    assert speak_vla_eval.read(vla_eval_packet("episode_start", {"task": {}, "mode": "live"})).reply is None
    for _ in range(2):
        with pytest.raises(Refused, match="--mode realtime"):
            speak_vla_eval.read(vla_eval_observation(picture_of))
    speak_vla_eval.read(vla_eval_packet("episode_start", {"task": {}}))
    assert understood(speak_vla_eval.read(vla_eval_observation(picture_of))).begins


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"images": {}}, "expected 2 .front, wrist., came 0"),
        ({"images": [1]}, "expected pictures by camera"),
        ({"states": None}, "expected 3 numbers"),
        ({"task_description": b"\xff\xfe"}, "expected a sentence"),
        ({"video_history": 3}, "video_history: expected a list"),
        ({"video_history": [1], "wrist_video_history": []}, "equally long"),
    ],
)
def test_vla_eval_what_cannot_be_used_is_told_with_its_number(
    speak_vla_eval: vla_eval.VlaEvalDialect, picture_of: PictureOf, changes: dict[str, Any], sentence: str
) -> None:
    speak_vla_eval.read(vla_eval_packet("episode_start", {"task": {}}))
    with pytest.raises(Refused, match=sentence):
        speak_vla_eval.read(vla_eval_observation(picture_of, **changes))
    told = unpack(speak_vla_eval.refuse("a sentence"))
    assert (told["type"], told["payload"], told["seq"]) == ("error", {"error": "a sentence"}, 5)


def test_vla_eval_an_observation_outside_of_episodes_is_refused(
    speak_vla_eval: vla_eval.VlaEvalDialect, picture_of: PictureOf
) -> None:
    with pytest.raises(Refused, match="expected episode_start"):
        speak_vla_eval.read(vla_eval_observation(picture_of))


def test_vla_eval_s_own_library_reads_and_writes_the_same(
    speak_vla_eval: vla_eval.VlaEvalDialect, picture_of: PictureOf
) -> None:
    theirs = pytest.importorskip("vla_eval.protocol.messages", reason="pip install vla-eval==0.8.0")
    start = theirs.Message(theirs.MessageType.EPISODE_START, {"task": {"name": "PickIt"}}, seq=1)
    speak_vla_eval.read(theirs.pack_message(start))
    seen = {"images": {"a": picture_of(1), "b": picture_of(2)}, "task_description": "pick", "states": np.zeros(3)}
    asked = speak_vla_eval.read(theirs.pack_message(theirs.Message(theirs.MessageType.OBSERVATION, seen, seq=2)))
    assert int(understood(asked).frames["wrist"][0, 0, 0]) == 2  # it travelled as a PNG
    rows = np.ones((1, 3), np.float32)
    told = theirs.unpack_message(speak_vla_eval.answer(asked, Answer(rows_NA=rows, tick=0, levels=(m.Level.PLAY,))))
    assert (told.type, told.seq, told.payload["actions"].tolist()) == (theirs.MessageType.ACTION, 2, [1.0, 1.0, 1.0])


# -- RoboMME's policy repository


def mme_vla_buffer(picture_of: PictureOf, shades: list[int], **changes: Any) -> bytes:
    images = np.stack([picture_of(shade)[None] for shade in shades])
    state = np.array([[shade, 0, 0] for shade in shades], np.float32)
    return pack({"images": images, "state": state, "add_buffer": True, "exec_start_idx": 0} | changes, "openpi")


def test_mme_vla_an_episode_begins_with_a_reset_and_its_video(
    speak_mme_vla: mme_vla.MmeVlaDialect, picture_of: PictureOf
) -> None:
    asked = speak_mme_vla.read(pack({"reset": True}, "openpi"))
    assert isinstance(asked.request, Finish)
    assert unpack(asked.reply) == {"reset_finished": True}  # type: ignore[arg-type]
    filled = speak_mme_vla.read(mme_vla_buffer(picture_of, [7, 8, 9], exec_start_idx=2))
    assert (filled.request, unpack(filled.reply)) == (None, {"add_buffer_finished": True})  # type: ignore[arg-type]
    step = understood(speak_mme_vla.read(openpi_packet(picture_of)))
    assert step.begins
    assert [(sorted(frames), int(frames["front"][0, 0, 0])) for frames in step.demo] == [(["front"], 7), (["front"], 8)]
    assert len(step.since) == 0


def test_mme_vla_what_was_seen_since_comes_with_the_wrists_last_picture(
    speak_mme_vla: mme_vla.MmeVlaDialect, picture_of: PictureOf
) -> None:
    speak_mme_vla.read(pack({"reset": True}, "openpi"))
    speak_mme_vla.read(openpi_packet(picture_of))
    speak_mme_vla.read(mme_vla_buffer(picture_of, [5, 6]))
    step = understood(speak_mme_vla.read(openpi_packet(picture_of, **{"observation/image": picture_of(6)})))
    assert not step.begins
    (seen,) = step.since
    assert [int(seen.frames[name][0, 0, 0]) for name in ("front", "wrist")] == [5, 2]
    assert seen.state.tolist() == [5, 0, 0]


def test_mme_vla_without_its_history_is_understood_too(
    speak_mme_vla: mme_vla.MmeVlaDialect, picture_of: PictureOf
) -> None:
    steps = [understood(speak_mme_vla.read(openpi_packet(picture_of))) for _ in range(2)]
    assert [(step.begins, len(step.demo), len(step.since)) for step in steps] == [(True, 0, 0), (False, 0, 0)]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"images": np.zeros((2, 4, 4, 3), np.uint8)}, r"expected \(T, 1, height, width, 3\)"),
        ({"images": np.zeros((0, 1, 4, 4, 3), np.uint8)}, r"expected \(T, 1, height, width, 3\)"),
        ({"state": np.zeros((3, 3))}, r"came \(2, 1, 4, 4, 3\) and 3"),
        ({"state": 5}, "state: expected a list, came 5"),
        ({"exec_start_idx": 2}, "exec_start_idx: expected 0 to 1"),
        ({"exec_start_idx": "0"}, "exec_start_idx: expected 0 to 1"),
        ({"images": np.zeros((2, 1, 4, 4, 3), np.float32)}, "expected a picture"),
    ],
)
def test_mme_vla_a_buffer_that_is_none_is_refused(
    speak_mme_vla: mme_vla.MmeVlaDialect, picture_of: PictureOf, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(Refused, match=sentence):
        speak_mme_vla.read(mme_vla_buffer(picture_of, [1, 2], **changes))


def test_mme_vla_a_client_that_plays_other_numbers_of_rows_is_told(
    speak_mme_vla: mme_vla.MmeVlaDialect, picture_of: PictureOf
) -> None:
    speak_mme_vla.read(openpi_packet(picture_of))
    with pytest.raises(Refused, match="start pp-gateway with --rows 3"):
        speak_mme_vla.read(mme_vla_buffer(picture_of, [1, 2, 3]))


TEXT = "按下 the button"


def spelled(array: np.ndarray) -> dict[str, Any]:
    return {"__ndarray__": True, "data": array.tobytes(), "dtype": array.dtype.str, "shape": list(array.shape)}


def spelled_by_msgpack_numpy(array: np.ndarray) -> dict[bytes, Any]:
    return {b"nd": True, b"type": array.dtype.str, b"shape": list(array.shape), b"data": array.tobytes()}


@pytest.mark.parametrize("spell", [spelled, spelled_by_msgpack_numpy])
@pytest.mark.parametrize("prompt", [TEXT, [TEXT, "other"], TEXT.encode(), np.asarray(TEXT), np.asarray([TEXT])])
def test_a_prompt_is_read_however_it_is_spelled(prompt: Any, spell: Callable[[np.ndarray], Any]) -> None:
    sent = spell(prompt) if isinstance(prompt, np.ndarray) else prompt
    assert reading.text(unpack(pack({"prompt": sent}, "openpi")), "prompt") == TEXT


CAMERAS = ("front", "wrist", "side")


@given(
    cameras=st.sets(st.sampled_from(CAMERAS), min_size=1).map(sorted),
    sent=st.permutations([*CAMERAS, "agentview", "third"]).flatmap(
        lambda names: st.integers(0, 5).map(lambda num: names[:num])
    ),
)
def test_a_picture_goes_to_the_camera_that_its_name_says_and_none_is_dropped(
    picture_of: PictureOf, cameras: list[str], sent: list[str]
) -> None:
    pictures = {name: picture_of(shade) for shade, name in enumerate(sent)}
    by_name = set(cameras) <= set(sent)
    if len(sent) != len(cameras) and not by_name:
        with pytest.raises(Refused, match=f"expected {len(cameras)}"):
            reading.frames(pictures, dict.fromkeys(cameras, ""))
        return
    frames = reading.frames(pictures, dict.fromkeys(cameras, ""))
    shades = {camera: int(frame[0, 0, 0]) for camera, frame in frames.items()}
    assert set(shades) == set(cameras)
    for camera in set(cameras) & set(sent):
        assert sent[shades[camera]] == camera
    if not by_name:
        assert sorted(shades.values()) == list(range(len(sent)))


def test_a_picture_of_no_camera_is_told_once(
    speak_openpi: openpi.OpenpiDialect, picture_of: PictureOf, caplog: pytest.LogCaptureFixture
) -> None:
    seen = {
        "observation/image": picture_of(1), "observation/wrist_image": picture_of(2),
        "observation/third_image": picture_of(3), "images": {"cam_4": picture_of(4), "depth": np.zeros(3)},
        openpi.STATE_KEY: np.zeros(3, np.float32), "prompt": "pick",
    }  # fmt: skip
    for _ in range(2):
        understood(speak_openpi.read(pack(seen, "openpi")))
    (told,) = (record.getMessage() for record in caplog.records if "no camera" in record.getMessage())
    assert "images/cam_4, observation/third_image; see --cameras" in told
