"""A pair trained on another robot's data plays that robot: RoboCasa-DC's fake, through its adapter and the gateway."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import av
import numpy as np
import pytest
from ponderpounce_robocasa import layout

from clock.check import disagreements
from dual_system.data.episode import About, EpisodeWriter, RobotColumns, Row, unpack
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.training import train
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log
from protocol.process import ENDING_S
from sim_client.launch import free_ports

pytestmark = [pytest.mark.e2e, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
TASK, INSTRUCTION, SEEDS = "OpenDrawer", "open the left drawer", (0, 1)
MAX_STEPS, ROWS, DEMO_FRAMES = 40, layout.NUM_ROWS, 3
PATIENCE_S = 120.0
ENVIRONMENT = os.environ | {
    "OMP_NUM_THREADS": "1",
    "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "integrations" / "ponderpounce_robocasa")]),
}


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A step of ``tiny_robocasa_dc`` on an episode of noise, after a demonstration by another body."""
    folder = tmp_path_factory.mktemp("pair")
    robot = RobotColumns(
        robot_type="panda_omron",
        state=tuple(f"{name}_{index}" for name, size in layout.STATE for index in range(size)),
        action=layout.ACTION_NAMES,
        cameras=tuple(layout.CAMERAS),
        has_demo_camera=True,
    )
    rng, episode = np.random.default_rng(0), EpisodeWriter(layout.PX, robot)
    for index in range(21 + 60):
        row = Row(
            state=rng.uniform(-1, 1, layout.NUM_STATE).astype(np.float32),
            action=rng.uniform(-1, 1, len(layout.ACTION_NAMES)).astype(np.float32),
            subgoal="",
            grounded_subgoal="",
            is_demonstration=index < 21,
        )
        shown = robot.shown_in(row.is_demonstration)
        picture = rng.integers(0, 256, (layout.PX, layout.PX, 3), np.uint8)
        episode.add(row, dict.fromkeys(shown, picture) if index % 20 == 0 or index >= 21 else {})
    writer = DatasetWriter(folder / "set", robot)
    about = About(
        task=TASK, instruction=INSTRUCTION, seed=0, difficulty="", origin="noise", is_success=True, image_px=layout.PX
    )
    writer.add(unpack(episode.pack(about)))
    writer.finish()
    arguments = ["--recipe", "tiny_robocasa_dc", "--data", str(folder / "set"), "--out", str(folder / "run")]
    arguments += ["--steps", "1", "--batch-episodes", "1", "--max-invocations", "1", "--no-progress"]
    assert train.main(arguments) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def benchmark_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, and one demonstration of 2.05 s, which the second scene wraps to."""
    folder = tmp_path_factory.mktemp("benchmark")
    for seed in SEEDS:
        place = folder / "scenes" / TASK / str(seed)
        place.mkdir(parents=True)
        (place / "environment.xml").write_text("<mujoco/>")
        (place / "ep_meta.json").write_text(json.dumps({"lang": INSTRUCTION}))
        np.savez(place / "initial_state.npz", np.array([0.0, -9.0, 0.1, 0.2, 0.0]))  # far from success
    video = folder / "gr1" / TASK / "videos" / "chunk-000" / "observation.images.over" / "episode_000000.mp4"
    video.parent.mkdir(parents=True)
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 256, 256, "yuv420p"
        for index in range(41):
            picture = np.full((256, 256, 3), 5 * index, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    (folder / "cameras.json").write_text(json.dumps({TASK: "over"}))
    return folder


@pytest.fixture(
    scope="module",
    params=[
        pytest.param("0", marks=pytest.mark.acceptance, id="one cognition"),
        pytest.param("1000", id="one a second"),
    ],
)
def played(
    request: pytest.FixtureRequest, pair: Path, benchmark_files: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, list[EpisodeRecord], list[dict[str, object]], str]:
    """Both scenes, played by the adapter's program: PONDER's period, the logs, its results and the gateway's log."""
    out, (port,) = tmp_path_factory.mktemp("played"), free_ports(1)
    command = [sys.executable, "-m", "sim_client.gateway", "--local", "--dialect", "openpi", "--rows", str(ROWS)]
    command += ["--listen", f"127.0.0.1:{port}", "--out", str(out), "--image-px", str(layout.PX)]
    command += ["--robot-file", str(ROOT / "examples/robots/panda_omron.toml"), "--query-period-ms", request.param]
    command += ["--cameras", *(f"{name}=observation/{name}" for name in layout.CAMERAS)]
    command += ["--ponder-checkpoint", str(pair / "ponder"), "--pounce-checkpoint", str(pair / "pounce")]
    with (out / "gateway.log").open("wb") as log:
        gateway = subprocess.Popen(command, env=ENVIRONMENT, stdout=log, stderr=log)
    try:
        end_s = time.monotonic() + PATIENCE_S
        while " ready " not in (out / "gateway.log").read_text():
            if gateway.poll() is not None or time.monotonic() > end_s:
                pytest.fail((out / "gateway.log").read_text())
            time.sleep(0.1)  # another process's log
        program = [sys.executable, "-m", "ponderpounce_robocasa", "--url", f"ws://127.0.0.1:{port}"]
        program += ["--environment", "ponderpounce_robocasa.fake:make", "--tasks", TASK, "--max-steps", str(MAX_STEPS)]
        program += ["--scenes", str(benchmark_files / "scenes"), "--cameras", str(benchmark_files / "cameras.json")]
        program += ["--demonstrations", str(benchmark_files / "gr1"), "--out", str(out / "results.jsonl")]
        done = subprocess.run(
            program, env=ENVIRONMENT, capture_output=True, text=True, timeout=2 * PATIENCE_S, check=False
        )
        assert done.returncode == 0, done.stderr + (out / "gateway.log").read_text()
        gateway.terminate()
        assert gateway.wait(2 * ENDING_S) == 0, (out / "gateway.log").read_text()
    finally:
        gateway.kill()
        gateway.wait()
    logs = sorted((read_log(path) for path in out.rglob("*.mcap")), key=lambda record: record.info.seed)
    results = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    return request.param, logs, results, (out / "gateway.log").read_text()


def test_the_program_says_how_each_scene_ended(played: tuple[object, ...]) -> None:
    _, _, results, _ = played
    assert [(each["seed"], each["demonstration"], each["demo_frames"]) for each in results] == [(0, 0, 3), (1, 0, 3)]  # type: ignore[attr-defined]
    assert [(each["steps"], each["held"]) for each in results] == [(MAX_STEPS, 0)] * 2  # type: ignore[attr-defined]


def test_ponder_reads_the_demonstration_and_the_log_follows_from_itself(played: tuple[object, ...]) -> None:
    _, logs, _, gateway = played
    assert len(logs) == len(SEEDS)  # type: ignore[arg-type]
    assert f"demo={DEMO_FRAMES}" in gateway  # type: ignore[operator]
    for record in logs:  # type: ignore[attr-defined]
        assert next(disagreements(record), None) is None
        assert record.info.robot.name == "panda_omron"
        assert record.info.has_demo
        assert record.info.schedule.wait == m.WaitKind.STAND_STILL


def test_every_chunk_is_played_in_full_and_a_new_one_comes_each_16_ticks(played: tuple[object, ...]) -> None:
    _, logs, _, _ = played
    num_chunks = -(-MAX_STEPS // ROWS)
    for record in logs:  # type: ignore[attr-defined]
        assert [each.tick for each in record.invocations] == [ROWS * number for number in range(num_chunks)]
        assert [chunk.horizon for chunk in record.chunks] == [ROWS] * num_chunks
        for tick in record.ticks:
            assert (tick.t_row0, tick.row) == (tick.tick // ROWS * ROWS, tick.tick % ROWS)
            assert tick.level == m.Level.PLAY


def test_each_invocation_refers_to_the_newest_cognition_that_is_ready(played: tuple[object, ...]) -> None:
    """ref(j) = max{t: tau_t + d_t <= tau_j}, whatever PONDER's period; the age is true and grows."""
    period_ms, logs, _, _ = played
    for record in logs:  # type: ignore[attr-defined]
        stamps = [each for each in record.stamps if each.kind == m.StampKind.COGNITION]
        assert record.invocations
        for asked in record.invocations:
            ready = [each for each in stamps if each.ready_ns <= asked.now_ns]
            newest = max(ready, key=lambda each: each.index)
            assert (asked.ref_query, asked.age_ns) == (newest.index, asked.now_ns - newest.source_ns)
        queries = {each.ref_query for each in record.invocations}
        assert queries == {0} if period_ms == "0" else len(queries) > 1
