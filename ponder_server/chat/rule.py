"""What is asked of a chat model, and how its reply is read. Pure: from frames and texts to a request, and back."""

from __future__ import annotations

import base64
import json
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ponder_server.chat.ask import Ask, checked_subgoal
from ponder_server.contract import Frame, Opening
from protocol import images

MAX_TOLD = 32
"""Subgoals of the past that are told."""

_RULES = """\
Answer with one JSON object and nothing else: {"subgoal": "..."}. It is what the arm has to do now. While the current \
subgoal is not finished, repeat it word for word; when it is, name the next one."""
_FENCE = "```"
_THOUGHT = "</think>"


class BrokenReply(ValueError):
    """A reply that says no subgoal; the message says what came instead."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One observation as it is shown again: its number, its pictures as data URLs, the subgoal in force before it."""

    number: int
    pictures: tuple[str, ...]
    subgoal: str


@dataclass(slots=True)
class History:
    """An episode as the chat model is told it."""

    ask: Ask
    task: str
    demo: tuple[tuple[str, ...], ...]
    seen: deque[Seen]
    subgoals: list[str] = field(default_factory=list)
    num_seen: int = 0

    @classmethod
    def of(cls, ask: Ask, opening: Opening) -> History:
        chosen = np.linspace(0, len(opening.demo_frames) - 1, min(ask.demo, len(opening.demo_frames))).round()
        demo = tuple(pictures(opening.demo_frames[int(index)], ask.image_px) for index in chosen)
        return cls(ask, opening.instruction, demo, deque(maxlen=ask.past + 1))

    @property
    def subgoal(self) -> str:
        """The subgoal in force; "" before the first."""
        return self.subgoals[-1] if self.subgoals else ""

    def see(self, frames: tuple[Frame, ...]) -> None:
        self.num_seen += 1
        self.seen.append(Seen(self.num_seen, pictures(frames, self.ask.image_px), self.subgoal))

    def take(self, subgoal: str) -> bool:
        """Takes a reply's subgoal; returns whether it is a new one."""
        if not subgoal or subgoal == self.subgoal:
            return False
        self.subgoals.append(subgoal)
        return True


def body_of(model: str, history: History) -> bytes:
    """The body of a chat-completions request about the newest observation of ``history``, which has at least one."""
    ask = history.ask
    wanted = f"{ask.prompt.strip()}\n\n{_RULES}"
    if ask.subgoals:
        wanted += "\nThe only subgoals are:\n" + "\n".join(f"- {each}" for each in ask.subgoals)
    request: dict[str, Any] = {
        **ask.request,
        "model": model,
        "messages": [{"role": "system", "content": wanted}, {"role": "user", "content": _told(history)}],
    }
    if ask.schema:
        request["response_format"] = {"type": "json_schema", "json_schema": _schema(ask)}
    return json.dumps(request).encode()


def reply_of(data: bytes, ask: Ask) -> tuple[str, int]:
    """The subgoal of a chat-completions reply ("": none), and the tokens that it cost (0: the endpoint does not say).

    Raises:
        BrokenReply: it is none, is cut off, or names a subgoal that is not allowed.
    """
    try:
        reply = json.loads(data)
    except (ValueError, RecursionError):
        raise BrokenReply(f"the endpoint's answer is no JSON: {_shown(data)}") from None
    choices = reply.get("choices") if isinstance(reply, dict) else None
    choice = choices[0] if isinstance(choices, list) and choices else None
    message = choice.get("message") if isinstance(choice, dict) else None
    content = message.get("content") if isinstance(message, dict) else None
    if not isinstance(choice, dict) or not isinstance(content, str):
        raise BrokenReply(f"the endpoint's answer has no choices[0].message.content: {_shown(data)}")
    if choice.get("finish_reason") == "length":
        raise BrokenReply(f"the reply is cut off at the endpoint's limit of tokens: {_shown(content)}")
    usage = reply.get("usage")
    tokens = usage.get("total_tokens") if isinstance(usage, dict) else 0
    return _subgoal(content, ask), tokens if type(tokens) is int and 0 <= tokens < 2**32 else 0


def _subgoal(content: str, ask: Ask) -> str:
    said = content.rpartition(_THOUGHT)[2].strip()  # models that think aloud do it before
    if said.startswith(_FENCE):
        said = said.partition("\n")[2].rpartition(_FENCE)[0]
    try:
        found = json.loads(said)
    except (ValueError, RecursionError):
        raise BrokenReply(f"the reply is no JSON: {_shown(content)}") from None
    subgoal = found.get("subgoal") if isinstance(found, dict) else None
    if not isinstance(subgoal, str):
        raise BrokenReply(f'the reply is no {{"subgoal": "..."}}: {_shown(content)}')
    try:
        subgoal = checked_subgoal(subgoal)
    except ValueError as error:
        raise BrokenReply(f"the reply has {error}") from None
    if not ask.subgoals or not subgoal:
        return subgoal
    allowed = {each.casefold(): each for each in ask.subgoals}
    if subgoal.casefold() not in allowed:
        raise BrokenReply(f"the reply's subgoal is none of the {len(ask.subgoals)} allowed: {_shown(subgoal)}")
    return allowed[subgoal.casefold()]


def pictures(frames: tuple[Frame, ...], most_px: int) -> tuple[str, ...]:
    """JPEG data URLs of frames (h, w, 3), each averaged down by a whole factor to sides of at most ``most_px``."""
    return tuple(
        "data:image/jpeg;base64," + base64.b64encode(images.jpeg(_smaller(frame, most_px))).decode() for frame in frames
    )


def _smaller(frame: Frame, most_px: int) -> Frame:
    factor = -(-max(frame.shape[:2]) // most_px)
    height, width = (side // factor for side in frame.shape[:2])
    if factor == 1 or not (height and width):
        return frame
    whole = frame[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return whole.mean((1, 3)).round().astype(np.uint8)


def _told(history: History) -> list[dict[str, Any]]:
    parts = [_text(f"Task: {history.task}")]
    if history.demo:
        parts.append(_text(f"A demonstration of it, {len(history.demo)} instants, the oldest first:"))
        parts += [_picture(url) for views in history.demo for url in views]
    *past, newest = history.seen
    for seen in past:
        parts.append(_text(f"Observation {seen.number}, subgoal then: {json.dumps(seen.subgoal or None)}"))
        parts += [_picture(url) for url in seen.pictures]
    parts.append(_text(f"Observation {newest.number}, now:"))
    parts += [_picture(url) for url in newest.pictures]
    told = history.subgoals[-MAX_TOLD:]
    parts.append(_text(f"Subgoals so far: {json.dumps(told)}. Current subgoal: {json.dumps(history.subgoal or None)}."))
    return parts


def _text(text: str) -> dict[str, Any]:
    return {"type": "text", "text": text}


def _picture(url: str) -> dict[str, Any]:
    return {"type": "image_url", "image_url": {"url": url}}


def _schema(ask: Ask) -> dict[str, Any]:
    text: dict[str, Any] = {"type": "string"}
    if ask.subgoals:
        text["enum"] = list(ask.subgoals)
    properties = {"subgoal": text}
    shape = {"type": "object", "properties": properties, "required": ["subgoal"], "additionalProperties": False}
    return {"name": "subgoal", "strict": True, "schema": shape}


def _shown(said: bytes | str) -> str:
    return f"{said[:120]!r}"
