"""An ask file is what it says, or is refused with the field's name."""

from __future__ import annotations

from pathlib import Path

import pytest

from ponder_server.chat.ask import Ask, read_ask
from protocol.errors import FileError


def test_a_file_says_what_is_asked(tmp_path: Path) -> None:
    path = tmp_path / "ask.toml"
    path.write_text(
        'prompt = "A Panda."\nsubgoals = ["pick  up the cube ", "press the button"]\npast = 0\ndemo = 4\n'
        "image_px = 256\nschema = false\n[request]\ntemperature = 0.0\nmax_tokens = 100\n"
    )
    ask = read_ask(path)
    assert ask == Ask(
        prompt="A Panda.",
        subgoals=("pick up the cube", "press the button"),
        past=0,
        demo=4,
        image_px=256,
        schema=False,
        request={"temperature": 0.0, "max_tokens": 100},
        digest=ask.digest,
    )
    path.write_text('prompt = "A Panda."')
    assert read_ask(path) == Ask(prompt="A Panda.", digest=read_ask(path).digest)
    assert read_ask(path).digest != ask.digest


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("past = 3", "prompt is missing"),
        ('prompt = " "', "prompt is missing"),
        ("prompt = 3", "prompt is missing"),
        ('prompt = "x"\nsubgoal = ["y"]', "unknown field 'subgoal'; expected prompt, subgoals"),
        ('prompt = "x"\nsubgoals = "y"', "subgoals: expected a list of texts"),
        ('prompt = "x"\nsubgoals = ["go", "Go"]', "subgoals: one of them is there twice"),
        ('prompt = "x"\nsubgoals = ["a\\u0007"]', "cannot be printed"),
        (f'prompt = "x"\nsubgoals = ["{"y" * 301}"]', "a subgoal of 301 characters; expected at most 300"),
        ('prompt = "x"\npast = -1', "past: expected 0 to 64, came -1"),
        ('prompt = "x"\npast = true', "past: expected 0 to 64, came True"),
        ('prompt = "x"\nimage_px = 8', "image_px: expected 32 to 4096"),
        ('prompt = "x"\nschema = 1', "schema: expected true or false"),
        ('prompt = "x"\nrequest = 1', "request: expected a table"),
        ('prompt = "x"\n[request]\nstream = true', "request.stream is written by ponder-serve; leave it out"),
        ('prompt = "x"\n[request]\nsince = 2026-01-01', "date is not JSON serializable"),
        ("prompt =", "is no file for --ask"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "ask.toml"
    path.write_text(text)
    with pytest.raises(FileError) as refused:
        read_ask(path)
    assert sentence in str(refused.value)
    assert str(path) in str(refused.value)
