"""A mapping file is read whole, or refused with the field that is wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from protocol.errors import FileError
from protocol.peers.mapping import Prompt, read_mapping

TEXT = """
rate_hz = 15
horizon = 10
num_proprio = 3
num_commands = 3

[prompt]
key = "prompt"
text = "{subgoal}"

[cameras.front]
key = ["images", "front"]
size_px = [224, 224]
fit = "pad"

[cameras.side]
ignored = true

[[state]]
key = "joints"
from = [0, 1]
unit = "deg"

[[state]]
key = "gripper"
from = [2]
scale = -0.04
offset = 0.04

[[action]]
key = "actions"
to = [0, 1]
kind = "velocity"
unit = "rad/s"

[[action]]
key = "actions"
columns = [2]
to = [2]
kind = "gripper"
scale = -2.0
offset = 1.0

[[action]]
key = "actions"
columns = [3]
kind = "ignored"
"""


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Any]:
    def read(*changes: tuple[str, str]) -> Any:
        text = TEXT
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        (tmp_path / "droid.toml").write_text(text)
        return read_mapping(tmp_path / "droid.toml")

    return read


def test_a_file_is_read(read: Callable[..., Any]) -> None:
    found = read()
    assert (found.name, found.rate_hz, found.play_hz, found.horizon, found.num_rows) == ("droid", 15, 15, 10, 10)
    assert [(camera.camera, camera.key) for camera in found.cameras] == [
        ("front", ("images", "front")), ("side", None)
    ]  # fmt: skip
    assert found.state_keys() == {("joints",): 2, ("gripper",): 1}
    assert found.action_keys() == {("actions",): 4}
    assert found.actions[0].measured == (0, 1)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rate_hz = 15", "rate_hz = 15.5", "rate_hz"),
        ("rate_hz = 15", "rate_hz = true", "rate_hz"),
        ("rate_hz = 15", "", "'rate_hz' is missing"),
        ("horizon = 10", "horizon = 0", "horizon"),
        ("horizon = 10", "horizon = 10\nrows = 3", "rows is not known"),
        ('text = "{subgoal}"', 'text = "go"', "expected {instruction}, {subgoal}"),
        ('fit = "pad"', 'fit = "crop"', "stretch or pad"),
        ("size_px = [224, 224]", "size_px = [224]", "[height, width]"),
        ("size_px = [224, 224]", "size_px = 224", "size_px"),
        ("from = [0, 1]", "from = [0, 3]", "measured number 3: expected 0 to 2"),
        ("from = [0, 1]", "from = [0, 1]\ncolumns = [0, 2]", "each column of a key once"),
        ('unit = "deg"', 'unit = "gon"', "unit = 'gon'"),
        ('unit = "rad/s"', 'unit = "rad"', "only a velocity is per second"),
        ('kind = "velocity"', 'kind = "speed"', "kind = 'speed'"),
        ("to = [0, 1]", "to = [0, 2]", "each of the 3 commands once, came [0, 2, 2]"),
        ("scale = -2.0", "scale = 0", "scale = 0"),
        ("scale = -2.0", "scale = nan", "expected a number"),
        ("columns = [3]", "columns = [4]", "'ignored'"),
        ('key = "joints"', 'key = "prompt"', "another key for every value"),
        ('key = "joints"', 'key = ["prompt", "a"]', "another key for every value"),
        ('key = "joints"', "key = []", "expected a name"),
        ("ignored = true", "ignored = false", "is not known"),
        ("[prompt]", "[prompt", ""),
    ],
)
def test_what_is_wrong_is_named(read: Callable[..., Any], old: str, new: str, said: str) -> None:
    with pytest.raises(FileError, match=r"droid\.toml is no mapping file") as refused:
        read((old, new))
    assert said in str(refused.value)


def test_a_window_has_the_present_where_it_says_nothing(read: Callable[..., Any]) -> None:
    found = read(("rate_hz = 15", "window = {state = [-2, 0], state_pad = 'is_pad'}\nrate_hz = 15"))
    assert (found.window.video_ticks, found.window.state_ticks) == ((0,), (-2, 0))
    assert (found.video_pad, found.state_pad) == (None, ("is_pad",))
    assert read().window is None


@pytest.mark.parametrize(
    ("window", "said"),
    [
        ("{video = [-1]}", "[window] video = [-1]: they ascend, and end with 0"),
        ("{video = [0, -1]}", "they ascend"),
        ("{video = [-1, -1, 0]}", "they ascend"),
        ("{video = [0, 1]}", "expected whole numbers from -100 to 0"),
        ("{state = [-101, 0]}", "expected whole numbers from -100 to 0"),
        ("{state = [-0.5, 0]}", "expected whole numbers"),
        ("{state = []}", "expected whole numbers"),
        (f"{{state = {list(range(-16, 1))}}}", "at most 16 of them"),
        ("{frames = [-1, 0]}", "[window]: frames is not known"),
    ],
)
def test_a_window_that_is_none_is_refused(read: Callable[..., Any], window: str, said: str) -> None:
    with pytest.raises(FileError) as refused:
        read(("rate_hz = 15", f"window = {window}\nrate_hz = 15"))
    assert said in str(refused.value)


def test_another_file_has_another_digest(read: Callable[..., Any]) -> None:
    assert read().digest != read(("scale = -2.0", "scale = -1.0")).digest


@pytest.mark.parametrize(
    ("text", "subgoal", "said"),
    [
        ("{instruction}", "now", "the task"),
        ("{subgoal}", "", "the task"),
        ("{subgoal}", "now", "now"),
        ("Task: {instruction}, Subgoal: {subgoal}.", "now", "Task: the task, Subgoal: now."),
        ("Task: {instruction}, Subgoal: {subgoal}.", "", "the task"),
        ("{instruction} {subgoal}", "{instruction}", "the task {instruction}"),
    ],
)
def test_the_prompt_is_the_subgoal_as_soon_as_there_is_one(text: str, subgoal: str, said: str) -> None:
    assert Prompt(key=("prompt",), text=text).said("the task", subgoal) == said
