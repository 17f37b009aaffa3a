"""The examples run, and print what they promise."""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
import time
from pathlib import Path

import pytest

from clock.check import disagreements
from protocol.mcap_log import read_log
from protocol.probe import HEALTHY
from protocol.probe import main as probe
from sim_client.launch import free_ports

EXAMPLES = Path(__file__).parents[2] / "examples"
ENVIRONMENT = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"), "OMP_NUM_THREADS": "1"}


def printed(name: str, *arguments: str, cwd: Path) -> str:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    ran = subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What the lockstep episode printed; its last line is the log's path."""
    folder = tmp_path_factory.mktemp("episode")
    return printed("02_lockstep_episode.py", str(folder / "out"), cwd=folder)


def test_examples_are_numbered_without_gaps_and_explain_how_to_run_them() -> None:
    names = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert [int(name[:2]) for name in names] == list(range(1, len(names) + 1))
    assert [name for name in names if f"python examples/{name}" not in (EXAMPLES / name).read_text()] == []


def test_the_rule_sees_an_answer_from_the_instant_it_is_ready(tmp_path: Path) -> None:
    lines = [re.split(r"\s{2,}", line.strip()) for line in printed("01_reference_rule.py", cwd=tmp_path).splitlines()]
    every = {at: seen for at, seen, *_ in lines[1:]}
    assert every["299 ms"] == "null, 0 ms old"
    assert every["300 ms"] == "C_0, 300 ms old"
    assert every["2869 ms"] == "C_1, 1869 ms old"
    assert every["2870 ms"] == "C_2, 870 ms old"
    assert {held for _, _, held, _ in lines[1:] if "C_1" in held or "C_3" in held} == set()


@pytest.mark.sim
@pytest.mark.slow
def test_the_paper_s_schedule_gives_every_invocation_a_cognition_of_300_ms(episode: str) -> None:
    ages = re.findall(r"sees C_(\d+), (\d+) ms old", episode)
    assert ages == [("0", "300"), ("1", "300"), ("2", "300")]


@pytest.mark.sim
@pytest.mark.slow
def test_a_log_is_read_back_and_agrees_with_itself(episode: str, tmp_path: Path) -> None:
    told = printed("03_read_a_log.py", episode.splitlines()[-1], cwd=tmp_path)
    assert "agrees with itself" in told
    assert "ticks        60 play" in told
    assert "61 from front (jpeg), 61 from wrist (jpeg)" in told  # one before every action, one after the last


@pytest.mark.sim
@pytest.mark.slow
def test_robomme_s_scores_are_read_from_logs_and_name_the_benchmark_s_scene(episode: str, tmp_path: Path) -> None:
    log = Path(episode.splitlines()[-1])
    records = [
        {"task": "PickHighlight", "episode": number, "seed": 620000 + number, "difficulty": "hard"} for number in (0, 1)
    ]
    (tmp_path / "list.json").write_text(json.dumps({"records": records}))
    told = printed("robomme/scores.py", "list.json", str(log.parents[2]), "scores", cwd=tmp_path)
    assert told == "0 of 1 solved\n"
    (found,) = json.loads((tmp_path / "scores" / "results.json").read_text())["episodes"]
    assert (found["seed"], found["difficulty"], found["steps"], found["null_invocations"]) == (620000, "hard", 60, 0)


def test_the_worth_of_memory_is_counted_scene_by_scene(tmp_path: Path) -> None:
    for name, successes in {"real": [True, True, False, True], "null": [False, True, True, False]}.items():
        episodes = [
            {"task": "StopCube", "run": 0, "seed": seed, "difficulty": "easy", "success": success}
            for seed, success in enumerate(successes)
        ]
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps({"config": {}, "episodes": episodes}))
    told = printed("05_worth_of_memory.py", "real", "null", cwd=tmp_path).splitlines()
    assert told[0].endswith("3 of 4 episodes solved")
    assert told[1].endswith("2 of 4, in the same scenes")
    assert told[2].endswith("2 only with memory, 1 only without")


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.usefixtures("short_warm_up")
def test_a_policy_of_one_s_own_moves_the_arm(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In this process, which has imported everything; the next test runs the file in one of its own."""
    monkeypatch.setattr(sys, "argv", ["04_your_own_policy.py"])
    runpy.run_path(str(EXAMPLES / "04_your_own_policy.py"), run_name="__main__")
    told = capsys.readouterr().out
    low, high = map(float, re.findall(r"[+-]\d\.\d+", told))
    assert told.startswith("40 ticks")
    assert low < -0.05 < 0.05 < high


@pytest.mark.e2e
def test_a_policy_of_one_s_own_stands_in_for_pounce_serve(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    command = [sys.executable, str(EXAMPLES / "04_your_own_policy.py"), "--serve", endpoint]
    with subprocess.Popen(command, cwd=tmp_path, env=ENVIRONMENT) as server:
        try:
            deadline_s = time.monotonic() + 20
            while probe(["pounce", "--link.connect", endpoint, "--within-ms", "500"]) != HEALTHY:
                assert server.poll() is None
                assert time.monotonic() < deadline_s
        finally:
            server.terminate()
        assert server.wait(10) == 0


@pytest.mark.sim
@pytest.mark.e2e
@pytest.mark.slow
def test_openpi_s_own_client_plays_through_the_gateway(tmp_path: Path) -> None:
    pytest.importorskip("openpi_client", reason="pip install --no-deps openpi-client==0.1.2")
    at_pounce, port = f"tcp/127.0.0.1:{free_ports(1)[0]}", free_ports(1)[0]
    policy = [sys.executable, str(EXAMPLES / "04_your_own_policy.py"), "--serve", at_pounce]
    gateway = [sys.executable, "-m", "sim_client.gateway", "--dialect", "openpi", "--rows", "10", "--ponder", "none"]
    gateway += ["--link.connect", at_pounce, "--listen", f"127.0.0.1:{port}", "--out", str(tmp_path)]
    with (
        (tmp_path / "gateway.txt").open("wb") as told,
        subprocess.Popen(policy, env=ENVIRONMENT) as served,
        subprocess.Popen(gateway, env=ENVIRONMENT, stderr=told) as serving,
    ):
        try:
            deadline_s = time.monotonic() + 60
            while " ready " not in (tmp_path / "gateway.txt").read_text():
                assert time.monotonic() < deadline_s
                assert serving.poll() is None
                time.sleep(0.05)  # another process's log: there is nothing to wait on
            lines = printed("07_openpi_client.py", f"127.0.0.1:{port}", cwd=tmp_path).splitlines()
            serving.terminate()
            assert serving.wait(30) == 0
        finally:
            serving.kill()
            served.terminate()
    assert lines[1:] == [f"tick {tick:3}: 10 rows, {{'PLAY'}}" for tick in (0, 10, 20, 30)]
    (log,) = tmp_path.rglob("*.mcap")
    assert next(disagreements(read_log(log)), None) is None
