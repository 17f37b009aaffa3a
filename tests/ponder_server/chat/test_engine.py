"""A chat endpoint behind PONDER's contract: every failure of it is no transition, in time, and is told."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ponder_server.chat.ask import Ask
from ponder_server.chat.client import MAX_BYTES, ChatEndpoint
from ponder_server.chat.engine import ChatPonder
from ponder_server.contract import Fire, Opening, SessionError

ASK = Ask(prompt="A Panda at a table.", subgoals=("pick up the red cube", "press the button"))
ANSWER_S = 0.3
FRAMES = (np.zeros((16, 16, 3), np.uint8),)
Turns = dict[str, Callable[..., Any]]


def planner(chat: Any, key: str = "", **changes: Any) -> ChatPonder:
    """An engine that has asked once, with an open session."""
    engine = ChatPonder(
        ChatEndpoint(chat.url, key), "tiny-vl", ASK, **({"answer_s": ANSWER_S, "start_s": 5.0} | changes)
    )
    engine.open("e", Opening(instruction="put the cubes away"))
    return engine


def fires(engine: ChatPonder) -> Fire:
    return engine.fire("e", FRAMES)


def test_a_new_subgoal_is_a_transition_and_the_same_one_is_none(chat: Any, turns: Turns) -> None:
    engine, says = planner(chat), turns["says"]
    chat.script = [says("press the button"), says("Press the button"), says("pick up the red cube"), says("")]
    told = [(fire.is_transition, [text.text for text in fire.texts]) for fire in (fires(engine) for _ in range(4))]
    assert told == [(True, ["press the button"]), (False, []), (True, ["pick up the red cube"]), (False, [])]
    user = chat.requests[-1]["messages"][1]["content"]
    assert 'Subgoals so far: ["press the button", "pick up the red cube"].' in user[-1]["text"]
    assert sum(part["type"] == "image_url" for part in user) == 4
    assert (chat.requests[-1]["model"], chat.requests[-1]["path"]) == ("tiny-vl", "/v1/chat/completions")


def test_an_answer_has_no_vectors_and_the_tokens_of_its_reply(chat: Any) -> None:
    engine = planner(chat)
    fire = fires(engine)
    assert (fire.cognition.shape, fire.context_tokens, fire.trouble) == ((0, 0), 912, "")
    assert (engine.spec.num_carriers, engine.spec.gives_text, engine.spec.is_fake) == (0, True, False)
    assert engine.spec.model_hash.startswith("chat-tiny-vl@127.0.0.1:")
    assert len(engine.spec.model_hash) <= 128


WHOLE = b'{"choices": [{"message": {"content": "{\\"subgoal\\": \\"press the button\\"}"}}]}'
FAILURES: dict[str, tuple[str, tuple[Any, ...], str]] = {
    # by name: the kind of turn, its arguments, and what is told of it
    "slow": ("hangs", (), f"no reply within {ANSWER_S} s"),
    "drips": ("drips", (), f"no reply within {ANSWER_S} s"),
    "dies": ("dies", (), "no answer from http://127.0.0.1"),
    "no JSON": ("writes", ("Sure! Press the button.",), "the reply is no JSON: 'Sure!"),
    "not allowed": ("says", ("dance",), "none of the 2 allowed: 'dance'"),
    "500": ("sends", (b'{"error": {"message": "out of memory"}}', 500), "/v1: out of memory"),
    "429": ("sends", (b"slow  down", 429), "HTTP 429 from"),
    "elsewhere": ("sends", (b"", 302), "HTTP 302 from"),
    "huge": ("sends", (b" " * (MAX_BYTES + 1) + WHOLE,), "an answer of more than 1 MiB"),
    "cut off": ("sends", (WHOLE, 200, len(WHOLE) + 50), "the answer is cut off"),
    "empty": ("sends", (b"",), "the endpoint's answer is no JSON"),
    "out of tokens": ("writes", ("{", "length"), "cut off at the endpoint's limit"),
}


@pytest.mark.parametrize("name", FAILURES)
def test_a_failure_is_no_transition_and_the_next_reply_counts(chat: Any, turns: Turns, name: str) -> None:
    engine = planner(chat)
    kind, given, sentence = FAILURES[name]
    turn = turns[kind](*given) if given else turns.get(kind) or getattr(chat, kind)
    beats: list[float] = []
    chat.script = [turns["says"]("pick up the red cube"), turn, turns["says"]("press the button")]
    fires(engine)
    start_s = time.monotonic()
    failed = engine.fire("e", FRAMES, lambda: beats.append(time.monotonic()))
    assert time.monotonic() - start_s < ANSWER_S + 5  # it came back at all: nothing waits for a server without a limit
    assert (failed.is_transition, failed.texts) == (False, ())
    assert sentence in failed.trouble
    assert beats
    assert [text.text for text in fires(engine).texts] == ["press the button"]
    assert len(chat.requests[-1]["messages"][1]["content"]) > len(chat.requests[-2]["messages"][1]["content"])


def test_a_dead_endpoint_is_no_transition(chat: Any) -> None:
    engine = planner(chat)
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        engine._endpoint = ChatEndpoint(f"http://127.0.0.1:{unused.getsockname()[1]}/v1")
        fire = fires(engine)
    assert (fire.is_transition, fire.texts) == (False, ())
    assert "refused" in fire.trouble


def test_the_heart_beats_while_a_reply_is_awaited(chat: Any) -> None:
    engine = planner(chat)
    beats: list[float] = []
    chat.script = [chat.hangs]
    engine.fire("e", FRAMES, lambda: beats.append(time.monotonic()))
    assert len(beats) >= 4


def test_the_key_is_sent_and_told_to_nobody(chat: Any, turns: Turns, caplog: pytest.LogCaptureFixture) -> None:
    engine = planner(chat, key="my-word")
    error = json.dumps({"error": {"message": "Incorrect API key provided: my-word"}}).encode()
    chat.script = [turns["sends"](error, 401)]
    fire = fires(engine)
    engine.warm_up()
    assert set(chat.keys) == {"Bearer my-word"}
    assert fire.trouble.endswith("Incorrect API key provided: ***")
    told = [repr(engine.spec), caplog.text]
    assert not any("my-word" in text for text in told)
    chat.script = [turns["says"]("")]
    planner(chat)
    assert chat.keys[-1] is None


def test_it_waits_for_an_endpoint_that_is_still_loading(chat: Any, turns: Turns, monkeypatch: Any) -> None:
    monkeypatch.setattr("ponder_server.chat.engine._ASK_AGAIN_S", 0.01)
    loading = turns["sends"](b"loading", 503)
    chat.script = [loading, turns["dies"], loading, turns["says"]("press the button")]
    planner(chat)
    assert len(chat.requests) == 4
    assert any(part["type"] == "image_url" for part in chat.requests[0]["messages"][1]["content"])


@pytest.mark.parametrize(
    ("status", "start_s", "sentence"),
    [(404, 600.0, "HTTP 404 from .*no model tiny-vl"), (400, 600.0, "see pictures"), (503, 0.0, "HTTP 503")],
)
def test_an_endpoint_that_refuses_is_told_at_once(
    chat: Any, turns: Turns, status: int, start_s: float, sentence: str
) -> None:
    chat.script = [turns["sends"](b'{"error": {"message": "no model tiny-vl"}}', status)]
    with pytest.raises(ValueError, match=sentence):
        planner(chat, start_s=max(start_s, 0.5))


@pytest.mark.parametrize(
    "url",
    [
        "",
        "127.0.0.1:8000",
        "ftp://h/v1",
        "http:///v1",
        "http://" + "user:hidden@h/v1",
        "https://h/v1?key=hidden",
        "https://h/v1#k",
        "http://h:99999/v1",
    ],
)
def test_a_url_that_is_none_or_would_tell_a_secret_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="--url: ") as refused:
        ChatEndpoint(url)
    assert "hidden" not in str(refused.value)


@pytest.mark.parametrize("key", ["a\r\nX: y", "ключ"])
def test_a_key_that_no_header_may_have_is_refused_without_being_shown(key: str) -> None:
    with pytest.raises(ValueError, match="--key-variable") as refused:
        ChatEndpoint("http://h/v1", key)
    assert key not in str(refused.value)


def test_sessions_are_opened_once_and_closed_once(chat: Any) -> None:
    engine = planner(chat)
    with pytest.raises(SessionError, match="already open"):
        engine.open("e", Opening(instruction="again"))
    with pytest.raises(ValueError, match="instruction is empty"):
        engine.open("f", Opening(instruction=" "))
    engine.close("e")
    for use in (lambda: engine.close("e"), lambda: fires(engine)):
        with pytest.raises(SessionError, match="not open"):
            use()
