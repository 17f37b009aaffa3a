"""A full disk ends the recording and results.json; the episodes are played, told, and the disk is named at the end."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import pytest

from sim_client import __main__ as sim_client
from sim_client import recorder, suite

FULL = OSError(errno.ENOSPC, "No space left on device", "results.json")
OPTIONS = ("--policy", "oracle", "--max-steps", "2", "--episodes", "2", "--no-progress", "--out")


def full(*_: Any, **__: Any) -> None:
    raise FULL


def test_both_episodes_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(suite, "write_json", full)
    assert sim_client.main([*OPTIONS, str(tmp_path), "--no-record"]) == 2
    said = capsys.readouterr()
    assert said.out.count("PickHighlight seed=") == 2
    assert said.err == "sim-client: results.json: No space left on device; make room and start again\n"


@pytest.mark.sim
def test_an_episode_without_a_log_is_played_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results: list[dict[str, Any]] = []
    monkeypatch.setattr(recorder, "EpisodeLog", full)
    monkeypatch.setattr(suite, "write_json", lambda path, value: results.append(value))
    assert sim_client.main([*OPTIONS, str(tmp_path)]) == 0
    for episode in results[-1]["episodes"]:
        assert "No space left on device: the episode is not recorded" in str(episode["warnings"])


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").touch()
    assert sim_client.main([*OPTIONS, str(tmp_path / "out")]) == 2
    assert "out is a file; expected a folder" in capsys.readouterr().err
