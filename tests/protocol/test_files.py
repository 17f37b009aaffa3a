"""A file that is not what it should be, or cannot be written, is one sentence that names it; nothing waits for it."""

from __future__ import annotations

import errno
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol import files
from protocol.errors import CommandError, FileError
from protocol.files import read_object, require_file

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 1\n"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (POINTER.encode(), "a Git LFS pointer; fetch the file itself with: git lfs pull"),
        (b"", "an empty file"),
        (b"\xff\xfe", "'utf-8' codec"),
        (b"{", "Expecting property name"),
        (b"[" * 100_000, "nested too deeply"),
        (b"9" * 100_000, "limit"),
    ],
    ids=["lfs", "empty", "latin", "cut", "deep", "digits"],
)
def test_what_is_no_json_is_named_with_the_reason(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(FileError, match=rf"a\.json is no recipe: .*{reason}"):
        files.read_json(path, "recipe")


def test_a_text_beyond_the_limit_is_not_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(files, "MAX_TEXT_BYTES", 1 << 20)
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(10 << 30)  # sparse
    with pytest.raises(FileError, match="more than 1 MiB"):
        files.read_json(tmp_path / "a.json", "recipe")


@pytest.mark.parametrize("error", [KeyError("steps"), TypeError("int"), AttributeError("x"), RecursionError("x")])
def test_whatever_a_parser_raises_is_about_its_file(error: Exception, tmp_path: Path) -> None:
    (tmp_path / "a").write_text("x")
    with pytest.raises(FileError, match="a is no recipe: "), files.reading(tmp_path / "a", "recipe"):
        raise error


def test_a_sentence_that_is_there_already_is_kept(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match=r"^collect less$"), files.reading(tmp_path, "dataset"):
        raise CommandError("collect less")


def test_a_pipe_or_a_device_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        with pytest.raises(FileError, match=f"{name} is a pipe or a device; expected a file"):
            files.read_json(tmp_path / name, "recipe")
    with pytest.raises(IsADirectoryError, match="is a folder; expected a file"):
        files.open_file(tmp_path)


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        RuntimeError("I/O: No space left on device (os error 28)"),
    ],
    ids=["python", "rust"],
)
def test_a_full_disk_is_told_with_the_file(error: Exception, tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space left on device") as raised, files.writing(tmp_path / "a"):
        raise error
    assert (raised.value.errno, raised.value.filename) == (errno.ENOSPC, str(tmp_path / "a"))


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(NotADirectoryError, match="out is a file; expected a folder"):
        files.folder(tmp_path / "out")
    with pytest.raises(NotADirectoryError, match="out"):
        files.folder(tmp_path / "out" / "below")
    assert files.folder(tmp_path / "new" / "one").is_dir()


def test_arrays_that_unpack_to_more_than_the_limit_are_not_unpacked(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(1 << 20))
    assert files.read_npz(tmp_path / "a.npz", "head")["x"].shape == (1 << 20,)
    with pytest.raises(FileError, match=r"a\.npz is no head: its arrays have 8388\d+ bytes, more than 1 MiB"):
        files.read_npz(tmp_path / "a.npz", "head", most_bytes=1 << 20)


def test_arrays_of_objects_and_of_sizes_that_nobody_has_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "objects.npz", x=np.array([{}], dtype=object))
    with pytest.raises(FileError, match=r"objects\.npz is no head"):
        files.read_npz(tmp_path / "objects.npz", "head")
    with zipfile.ZipFile(tmp_path / "vast.npz", "w") as packed, packed.open("x.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (1 << 60,)})
    with pytest.raises(FileError, match=r"vast\.npz is no head"):
        files.read_npz(tmp_path / "vast.npz", "head")


def test_json_of_any_kind_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"ü": [1]}, ensure_ascii=False), encoding="utf-8")
    assert files.read_json(tmp_path / "a.json", "recipe") == {"ü": [1]}


def test_a_byte_order_mark_is_no_part_of_the_json(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + b'{"a": 1}\r\n')
    assert read_object(tmp_path / "a.json") == {"a": 1}


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\noid x\n"), "Git LFS .*git lfs pull"),
        (lambda path: path.write_text('{"a": '), "is no JSON object: Expecting value"),
        (lambda path: path.write_text("[]"), "is no JSON object: it holds a list"),
        (lambda path: path.write_text("[" * 100_000), "is no JSON object: nested too deeply"),
        (lambda path: path.write_text('{"a": ' + "9" * 10_000 + "}"), "is no JSON object: .*digits"),
        (lambda path: path.write_bytes(b"\xff\xfe{}"), "is no JSON object: .*decode"),
        (lambda path: path.write_text(""), "is an empty file"),
        (lambda path: path.mkdir(), "is a folder; expected a file"),
        (os.mkfifo, "is a pipe or a device; expected a file"),
        (lambda path: path.symlink_to("/dev/zero"), "is a pipe or a device; expected a file"),
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
        monkeypatch.setattr(files, "MAX_TEXT_BYTES", 100)
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
