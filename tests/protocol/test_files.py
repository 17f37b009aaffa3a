"""A file from elsewhere is refused with its name and the way out, or read."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from protocol import files
from protocol.files import read_object, require_file


def test_a_byte_order_mark_is_no_part_of_the_json(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + b'{"a": 1}\r\n')
    assert read_object(tmp_path / "a.json") == {"a": 1}


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\noid x\n"), "Git LFS .*git lfs pull"),
        (lambda path: path.write_text('{"a": '), "is no JSON, or was cut short"),
        (lambda path: path.write_text("[]"), "expected a JSON object, came list"),
        (lambda path: path.write_text("[" * 100_000), "is no JSON.*recursion"),
        (lambda path: path.write_text('{"a": ' + "9" * 10_000 + "}"), "is no JSON.*digits"),
        (lambda path: path.write_bytes(b"\xff\xfe{}"), "is no JSON.*decode"),
        (lambda path: path.write_text(""), "is empty"),
        (lambda path: path.mkdir(), "not a regular file"),
        (os.mkfifo, "not a regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "not a regular file"),
        (lambda path: path.symlink_to("blob"), "links to blob, which is not there"),
        (lambda path: path.symlink_to(path.name), r"links to a\.json"),
        (lambda path: None, "No such file"),
        (lambda path: path.write_text("{" + " " * 200 + "}"), "has 202 bytes; at most 100"),
    ],
)
def test_what_is_no_json_object_is_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], Any], said: str
) -> None:
    path = tmp_path / "a.json"
    make(path)
    if "at most" in said:
        monkeypatch.setattr(files, "MAX_JSON_BYTES", 100)
    with pytest.raises((OSError, ValueError), match=said) as error:
        read_object(path)
    assert str(path) in str(error.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_of_somebody_else_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("x")
    path.chmod(0)
    with pytest.raises(PermissionError, match=str(path)):
        require_file(path)
