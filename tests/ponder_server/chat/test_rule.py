"""What a chat model is told of an episode, and which replies are subgoals."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest
import simplejpeg
from hypothesis import given
from hypothesis import strategies as st

from ponder_server.chat.ask import Ask
from ponder_server.chat.rule import BrokenReply, History, body_of, pictures, reply_of
from ponder_server.contract import Opening

ASK = Ask(prompt="A Panda at a table.", past=2, demo=2)
CLOSED = Ask(prompt="A Panda.", subgoals=("pick up the red cube", "press the button"))
SCRIPT = st.lists(st.sampled_from(["", "pick", "place", "press"]), min_size=1, max_size=12)


def frame(shade: int) -> Any:
    return np.full((8, 12, 3), shade, np.uint8)


def answer(content: Any, **choice: Any) -> bytes:
    return json.dumps({"choices": [{"message": {"content": content}, **choice}]}).encode()


def asked(history: History) -> tuple[str, list[str], list[int]]:
    """The system's text, the user's texts, and the shades of the pictures, in order."""
    body = json.loads(body_of("any-model", history))
    system, user = body["messages"]
    parts = user["content"]
    urls = [part["image_url"]["url"] for part in parts if part["type"] == "image_url"]
    shades = [
        int(simplejpeg.decode_jpeg(base64.b64decode(url.removeprefix("data:image/jpeg;base64,")))[0, 0, 0])
        for url in urls
    ]
    return system["content"], [part["text"] for part in parts if part["type"] == "text"], shades


@given(SCRIPT)
def test_the_newest_observations_and_every_subgoal_are_told(script: list[str]) -> None:
    history = History.of(ASK, Opening(instruction="put the cubes away"))
    said: list[str] = []
    for number, subgoal in enumerate(script, 1):
        history.see((frame(10 * number),))
        _, texts, shades = asked(history)
        assert shades == [10 * each for each in range(max(1, number - ASK.past), number + 1)]
        assert texts[0] == "Task: put the cubes away"
        current = json.dumps(said[-1] if said else None)
        assert texts[-1] == f"Subgoals so far: {json.dumps(said)}. Current subgoal: {current}."
        is_new = subgoal not in ("", said[-1] if said else "")
        assert history.take(subgoal) is is_new
        said += [subgoal] if is_new else []
    assert history.subgoal == (said[-1] if said else "")


def test_a_demonstration_is_shown_from_its_beginning_to_its_end() -> None:
    demo = tuple((frame(shade), frame(shade + 5)) for shade in range(0, 100, 20))
    history = History.of(ASK, Opening(instruction="as shown", demo_frames=demo))
    history.see((frame(200), frame(210)))
    _, texts, shades = asked(history)
    assert shades == [0, 5, 80, 85, 200, 210]
    assert texts[1] == "A demonstration of it, 2 instants, the oldest first:"


def test_a_closed_vocabulary_is_told_and_is_in_the_schema() -> None:
    history = History.of(CLOSED, Opening(instruction="go"))
    history.see((frame(0),))
    system, _, _ = asked(history)
    assert "- pick up the red cube\n- press the button" in system
    shape = json.loads(body_of("m", history))["response_format"]["json_schema"]["schema"]
    assert shape["properties"]["subgoal"] == {"type": "string", "enum": list(CLOSED.subgoals)}


def test_fields_of_the_file_go_with_the_request_and_the_schema_may_stay_out() -> None:
    history = History.of(Ask(prompt="x", schema=False, request={"temperature": 0.5}), Opening(instruction="go"))
    history.see((frame(0),))
    body = json.loads(body_of("m", history))
    assert (body["model"], body["temperature"], "response_format" in body) == ("m", 0.5, False)


@pytest.mark.parametrize(
    "content",
    [
        '{"subgoal": "pick up the red cube"}',
        ' {"subgoal": " Pick up the\\nred cube "}\n',
        '```json\n{"subgoal": "pick up the red cube"}\n```',
        '<think>the {cube} is red</think>{"subgoal": "pick up the red cube", "why": "it is due"}',
    ],
)
def test_a_reply_is_read_as_chat_models_write_it(content: str) -> None:
    assert reply_of(answer(content), CLOSED) == ("pick up the red cube", 0)


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"<html>", "the endpoint's answer is no JSON: b'<html>'"),
        (b"[" * 100_000, "is no JSON"),
        (b"1" * 5_000, "is no JSON"),
        (b"[]", "has no choices[0].message.content"),
        (b'{"choices": []}', "has no choices[0].message.content"),
        (b'{"choices": [3]}', "has no choices[0].message.content"),
        (answer(None), "has no choices[0].message.content"),
        (answer("pick up the red cube"), "the reply is no JSON: 'pick up"),
        (answer('{"subgoal": "pick up the red cube"}', finish_reason="length"), "cut off at the endpoint's limit"),
        (answer('{"subgoal": "pick up'), "the reply is no JSON"),
        (answer('["pick up the red cube"]'), "the reply is no {"),
        (answer('{"subgoal": 3}'), "the reply is no {"),
        (answer('{"subgoal": "dance"}'), "none of the 2 allowed: 'dance'"),
        (answer(json.dumps({"subgoal": "x" * 301})), "a subgoal of 301 characters"),
        (answer('{"subgoal": "a\\u0000b"}'), "cannot be printed"),
        (answer('{"subgoal": "\\ud800"}'), "cannot be printed"),  # a half of a pair, which no message can carry
    ],
)
def test_a_broken_reply_is_told_with_its_beginning(data: bytes, sentence: str) -> None:
    with pytest.raises(BrokenReply) as broken:
        reply_of(data, CLOSED)
    assert sentence in str(broken.value)
    assert len(str(broken.value)) < 300


@given(
    st.binary(max_size=60)
    | st.text(max_size=60).map(answer)
    | st.text(max_size=40).map(lambda s: answer(json.dumps({"subgoal": s})))
)
def test_whatever_comes_is_a_subgoal_that_can_be_sent_or_a_broken_reply(data: bytes) -> None:
    try:
        subgoal, _ = reply_of(data, ASK)
    except BrokenReply:
        return
    assert subgoal.encode().decode() == subgoal
    assert len(subgoal) <= 300


@given(st.integers(1, 90), st.integers(1, 90), st.integers(32, 64))
def test_pictures_are_sent_with_sides_of_at_most_so_many_pixels(height: int, width: int, most_px: int) -> None:
    (url,) = pictures((np.full((height, width, 3), 120, np.uint8),), most_px)
    sent = simplejpeg.decode_jpeg(base64.b64decode(url.partition(",")[2]))
    if min(height, width) >= 3:  # a side of nothing would be left
        assert max(sent.shape[:2]) <= most_px
    if max(height, width) <= most_px:
        assert sent.shape[:2] == (height, width)
    assert abs(int(sent.mean()) - 120) <= 2
