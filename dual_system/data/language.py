"""LeRobot's two columns of language (0.6), written beside our own: its tools show and render them.

``language_persistent`` holds the same list in every row of an episode: what is in force from a timestamp on, until the
next of its style. ``language_events`` holds what happens in a row, which is nothing here: LeRobot registers no style
for a transition. Source: `lerobot.datasets.language` of 0.6.1.
"""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from dual_system.data.episode import Rows
from dual_system.data.video import FPS

PERSISTENT, EVENTS = "language_persistent", "language_events"
FEATURE = {"dtype": "language", "shape": [1], "names": None}

_EVENT = [
    pa.field("role", pa.string(), nullable=False),
    pa.field("content", pa.string()),
    pa.field("style", pa.string()),
    pa.field("camera", pa.string()),
    pa.field("tool_calls", pa.list_(pa.string())),  # of JSON
]
_PERSISTENT = [*_EVENT[:3], pa.field("timestamp", pa.float32(), nullable=False), *_EVENT[3:]]
TYPES = {PERSISTENT: pa.list_(pa.struct(_PERSISTENT)), EVENTS: pa.list_(pa.struct(_EVENT))}


def language_columns(spoken: list[dict[str, Any]], num_rows: int) -> dict[str, pa.Array]:
    """Both columns of an episode: ``spoken``, made by `said`, and no events."""
    return {
        PERSISTENT: pa.array([spoken] * num_rows, TYPES[PERSISTENT]),
        EVENTS: pa.array([[]] * num_rows, TYPES[EVENTS]),
    }


def spoken_in(rows: Rows) -> list[dict[str, Any]]:
    """The persistent rows of an episode: its grounded subgoals, or plain ones where there are none."""
    found, subtask = [], ""
    for row in range(len(rows)):
        text = rows.grounded_subgoal[row] or rows.subgoal[row]
        if rows.demonstration_reasoning[row]:
            found.append(said(rows.demonstration_reasoning[row], "memory", row / FPS))
        if text and (text != subtask or rows.is_transition[row]):
            found.append(said(text, "subtask", row / FPS))
            subtask = text
    return found


def said(content: str, style: str, at_s: float) -> dict[str, Any]:
    """One persistent row, of the assistant's: a subgoal is its "subtask", its reasoning is "memory"."""
    return {
        "role": "assistant",
        "content": content,
        "style": style,
        "timestamp": at_s,
        "camera": None,
        "tool_calls": None,
    }
