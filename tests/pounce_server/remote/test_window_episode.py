"""A policy server that looks at several instants, over a whole lockstep episode: what it sees, what the log says of it,
and that the log alone gives the same rows again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from pounce_server.remote.engine import RemoteEngine
from pounce_server.remote.openpi import OpenpiPeer
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log
from protocol.peers.mapping import PolicyMapping, read_mapping
from sim_client.recorder import Recorder
from sim_client.replay_through import main

VIDEO, STATE, NUM_TICKS = (-7, -2, 0), (-3, -1, 0), 60
MAPPING = """
rate_hz = 20
horizon = 20
num_proprio = 3
num_commands = 3
prompt = {{key = "prompt", text = "{{instruction}}"}}
cameras.front = {{key = "image"}}
cameras.wrist = {{key = "wrist_image"}}
state = [{{key = "state", from = [0, 1, 2]}}]
action = [{{key = "actions", to = [0, 1, 2], kind = "position"}}]
window = {{video = {video}, state = {state}, video_pad = "video_pad", state_pad = "state_pad"}}
"""


def rows(seen: dict[str, Any]) -> dict[str, Any]:
    """What the arm did over the window goes on, and each instant's picture, or its padding, changes a number."""
    state, shades = seen["state"], seen["image"].mean(axis=(1, 2, 3)) - 10 * seen["video_pad"]
    step = (state[-1] - state[0]) / 3 + 2e-5 * shades.sum() + [0.01, 0, -0.01]
    return {"actions": state[-1] + np.clip(step, -0.05, 0.05) * np.arange(1, 21)[:, None]}


@pytest.fixture
def mapping_file(tmp_path: Path) -> Callable[..., Path]:
    def write(name: str, video: tuple[int, ...] = VIDEO) -> Path:
        (tmp_path / name).write_text(MAPPING.format(video=list(video), state=list(STATE)))
        return tmp_path / name

    return write


@pytest.fixture
def played(
    new_rig: Callable[..., Any], openpi_server: Any, mapping_file: Callable[..., Path], episode_info: Any,
    paper: m.Schedule, tmp_path: Path,
) -> Callable[..., tuple[Path, EpisodeRecord]]:  # fmt: skip
    """One episode, in which pictures are made at the ticks alone that somebody looks at."""
    openpi_server.policy.script = rows
    mapping: PolicyMapping = read_mapping(mapping_file("policy.toml"))

    def play(pixels: str) -> tuple[Path, EpisodeRecord]:
        peer = OpenpiPeer(openpi_server.url, mapping)
        engine = RemoteEngine(peer, mapping, openpi_server.url, answer_s=5, start_s=5)
        rig, path = new_rig(pounce_engine=engine), tmp_path / f"{pixels}.mcap"
        openpi_server.policy.seen.clear()
        recorder = Recorder(rig.links["sim"], pixels)
        recorder.begin(episode_info(paper), path)
        rig.meanwhile = recorder.step
        rig.run(episode_info(paper), NUM_TICKS, lambda tick: rig.clock.conductor.will_look(tick))
        recorder.end(m.EpisodeResult(status=m.TaskStatus.ONGOING, is_success=False, reason="", num_ticks=NUM_TICKS))
        peer.close()
        return path, read_log(path)

    return play


@pytest.fixture
def through(
    openpi_server: Any, mapping_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, dict[str, Any]]]:
    def run(log: Path, video: tuple[int, ...] = VIDEO) -> tuple[int, dict[str, Any]]:
        mapping = mapping_file("again.toml", video)
        code = main([str(log), "--backend", "openpi", "--url", openpi_server.url, "--mapping", str(mapping), "--json"])
        return code, json.loads(capsys.readouterr().out)

    return run


def test_the_policy_sees_the_window_of_every_invocation_and_the_log_says_what_was_padded(
    played: Callable[..., Any], openpi_server: Any
) -> None:
    _, record = played("exact")
    assert next(disagreements(record), None) is None
    states = {each.tick: each.proprio for each in record.observations}
    assert len(record.chunks) > 2
    assert np.ptp([tick.action[0] for tick in record.ticks]) > 0.1
    for chunk, seen in zip(record.chunks, openpi_server.policy.seen, strict=True):
        wanted = [chunk.t_row0 + offset for offset in STATE]
        np.testing.assert_array_equal(seen["state"], [states[max(tick, 0)] for tick in wanted])
        assert seen["state_pad"].tolist() == [tick < 0 for tick in wanted]
        assert seen["image"].shape[0] == seen["wrist_image"].shape[0] == len(VIDEO)
        assert seen["video_pad"].tolist() == [chunk.t_row0 + offset < 0 for offset in VIDEO]
        assert chunk.padded_video_ticks == tuple(offset for offset in VIDEO if chunk.t_row0 + offset < 0)
        assert chunk.padded_state_ticks == tuple(offset for offset in STATE if chunk.t_row0 + offset < 0)


def test_the_log_alone_gives_the_same_rows_again(played: Callable[..., Any], through: Callable[..., Any]) -> None:
    path, record = played("exact")
    code, found = through(path)
    assert (code, found["max"], found["pixels"], found["not_answered"]) == (0, 0.0, "exact", 0)
    assert (found["chunks"], found["padded_otherwise"]) == (len(record.chunks), 0)
    code, found = through(path, (-5, -2, 0))  # pictures of that tick were never made
    assert (code, found["padded_otherwise"]) == (1, len(record.chunks))


def test_pictures_come_from_their_own_channels_and_it_says_so(
    played: Callable[..., Any], through: Callable[..., Any]
) -> None:
    path, record = played("jpeg")
    _, found = through(path)
    assert (found["pixels"], found["chunks"], found["padded_otherwise"]) == ("jpeg", len(record.chunks), 0)
    assert found["max"] < 0.05
