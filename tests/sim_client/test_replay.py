"""An episode in rerun: it converts with its layout, and a viewer without a window draws every view."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from PIL import Image as Picture

from protocol import codec, images, topics
from protocol import messages as m
from protocol.mcap_log import EpisodeLog
from sim_client import replay

T0 = 1_700_000_000_000_000_000
MS = 1_000_000
RED, BLUE = (200, 30, 30), (30, 30, 200)
STUB = """#!{python}
import socket, subprocess, sys, time
if "--headless" not in sys.argv:
    sys.exit(subprocess.run(["{rerun}", *sys.argv[1:]]).returncode)
if {listens}:
    server = socket.create_server(("127.0.0.1", int(sys.argv[sys.argv.index("--port") + 1])))
    time.sleep(1)
sys.exit("{words}")
"""


@pytest.fixture(scope="module")
def info() -> m.EpisodeInfo:
    delay = m.Delay(kind=m.DelayKind.MEASURED)
    return m.EpisodeInfo(
        header=m.Header(robot="arm", session="s", episode="episode-1", epoch=1, proc="sim"),
        task="PickHighlight",
        suite="tests",
        seed=0,
        difficulty="easy",
        instruction="Pick.",
        schedule=m.Schedule(
            mode=m.Mode.LOCKSTEP,
            control_hz=20,
            horizon=20,
            query_period_ns=1000 * MS,
            invoke_period_ticks=10,
            query_delay=delay,
            invoke_delay=delay,
            max_age_ns=2000 * MS,
            stale_limit_ns=4000 * MS,
            hold_limit_ticks=4,
            decelerate_ticks=10,
            max_ticks=100,
        ),
        robot=m.Robot(
            name="arm",
            command_low=np.full(8, -2, np.float32),
            command_high=np.full(8, 2, np.float32),
            max_step=np.zeros(8, np.float32),
            initial_command=np.zeros(8, np.float32),
            cameras=("front", "wrist"),
            image_height=64,
            image_width=64,
            num_proprio=8,
            is_simulated=True,
        ),
        t0_unix_ns=T0,
    )


def frame(colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((64, 64, 3), colour, np.uint8)


@pytest.fixture(scope="module")
def record(info: m.EpisodeInfo) -> Callable[[Path, Callable[[m.Observation], m.Observation]], Path]:
    """Three seconds of everything that the layout shows."""

    def recorded(path: Path, change: Callable[[m.Observation], m.Observation] = lambda o: o) -> Path:
        log = EpisodeLog(path, info, when_full="wait")

        def say(topic: topics.Topic, message: object, proc: str, at_ns: int) -> None:
            header = m.Header(robot="arm", episode="episode-1", proc=proc, clock_id=m.EPISODE_CLOCK, at_ns=at_ns)
            signed = replace(message, header=header)
            log.write(topic, signed, codec.encode(signed), T0 + at_ns)

        for number in range(60):
            at_ns = 50 * MS * number
            row = np.sin(0.1 * number + np.arange(8)).astype(np.float32)
            seen = {"front": frame(RED), "wrist": frame(BLUE)}
            say(
                topics.OBSERVATION,
                change(
                    m.Observation(tick=number, source_ns=at_ns, proprio=row, images=images.pack(seen, m.ImageCodec.RAW))
                ),
                "sim",
                at_ns,
            )
            account = m.Tick(tick=number, deadline_ns=at_ns, decided_ns=at_ns, late_ns=0, level=m.Level.PLAY, state=row,
                             action=-row, raw_row=-row, age_ms=300.0 + 50 * (number % 20), late_ms=0.2)  # fmt: skip
            say(topics.TICK, account, "clock", at_ns)
            if number % 10 == 0:
                for proc, state in (("ponder", "append"), ("pounce", "infer"), ("sim", "running"), ("clock", "play")):
                    say(topics.PHASE, m.Phase(state=state if number % 20 else "idle"), proc, at_ns)
                grasp = m.Subgoal(kind=m.SubgoalKind.SUBGOAL, text=f"pick cube {number}", tick=number)
                say(topics.SUBGOAL, grasp, "ponder", at_ns)
                starved = m.Event(severity=m.Severity.WARNING, name="starved", text="no row", tick=number)
                say(topics.EVENT, starved, "clock", at_ns)
        assert log.close().error == ""
        return path

    return recorded


def test_an_episode_converts_with_its_layout(record: Callable[..., Path], tmp_path: Path) -> None:
    rrd = tmp_path / "episode.rrd"
    assert replay.main([str(record(tmp_path / "a.mcap")), "--save", str(rrd)]) == 0
    verified = subprocess.run(
        [replay._rerun(), "rrd", "stats", str(rrd)], env=replay._environ(), capture_output=True, text=True, check=True
    )
    assert verified.returncode == 0
    content = rrd.read_bytes()
    assert b"/camera/front" in content
    assert content.count(b"ponderpounce") >= 2  # the recording's application id and the layout's are the same


def test_a_cut_log_is_replayed_up_to_its_cut(record: Callable[..., Path], tmp_path: Path) -> None:
    whole = record(tmp_path / "a.mcap")
    cut = tmp_path / "b.mcap.partial"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 3])
    assert replay.main([str(cut), "--save", str(tmp_path / "b.rrd")]) == 0
    assert (tmp_path / "b.rrd").stat().st_size > 10_000


@pytest.mark.parametrize(
    "container",
    [
        {"use_chunking": False},
        {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False},
    ],
    ids=["unchunked", "without a summary"],
)
def test_every_message_is_replayed_from_any_container(
    container: dict[str, bool], record: Callable[..., Path], tmp_path: Path
) -> None:
    whole, other = record(tmp_path / "a.mcap"), tmp_path / "b.mcap"
    with other.open("wb") as file:
        writer = Writer(file, **container)  # type: ignore[arg-type]
        writer.start()
        channels: dict[str, int] = {}
        with whole.open("rb") as source:
            for schema, channel, message in make_reader(source).iter_messages():
                if channel.topic not in channels:
                    at = writer.register_schema(schema.name, schema.encoding, schema.data)  # type: ignore[union-attr]
                    channels[channel.topic] = writer.register_channel(channel.topic, "protobuf", at)
                writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    for log in (whole, other):
        assert replay.main([str(log), "--save", str(log.with_suffix(".rrd"))]) == 0
    assert (tmp_path / "b.rrd").stat().st_size > 0.9 * (tmp_path / "a.rrd").stat().st_size


def test_without_a_display_the_ways_out_are_named(
    record: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert replay.main([str(record(tmp_path / "a.mcap"))]) == 2
    said = capsys.readouterr().err
    assert "no display" in said
    assert "--screenshot" in said
    assert "--save" in said


@pytest.mark.parametrize("option", ["--save", "--screenshot"])
@pytest.mark.parametrize("target", ["a.mcap", "link", "other.log"])
def test_a_log_is_never_overwritten(
    option: str, target: str, record: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = record(tmp_path / "a.mcap")
    content = log.read_bytes()
    (tmp_path / "link").symlink_to(log)
    (tmp_path / "other.log").write_bytes(content)
    assert replay.main([str(log), option, str(tmp_path / target)]) == 2
    assert f"{target} is a log: a record is never overwritten" in capsys.readouterr().err
    assert log.read_bytes() == (tmp_path / "other.log").read_bytes() == content


@pytest.mark.parametrize("option", ["--save", "--screenshot"])
def test_a_target_that_cannot_be_written_is_named_at_once(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert replay.main([str(tmp_path / "a.mcap"), option, str(tmp_path / "file" / "a")]) == 2
    assert "file is a file; expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize("content", [None, b"not a log"])
def test_what_is_no_log_is_exit_2(content: bytes | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "odd.mcap"
    if content is not None:
        path.write_bytes(content)
    assert replay.main([str(path), "--save", str(tmp_path / "odd.rrd")]) == 2
    assert "odd.mcap" in capsys.readouterr().err
    assert not (tmp_path / "odd.rrd").exists()


@pytest.mark.parametrize("words", ["no adapter", "panicked at 'no adapter'\\n 6: main\\n" + 60 * " 7: frame\\n"])
@pytest.mark.parametrize("listens", [False, True])
def test_a_viewer_that_finds_no_driver_is_told_as_that(
    listens: bool,
    words: str,
    record: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """At once, and after it has begun to listen, which is when the real one looks for a driver."""
    stub = tmp_path / "rerun"
    stub.write_text(STUB.format(python=sys.executable, rerun=replay._rerun(), listens=listens, words=words))
    stub.chmod(0o755)
    monkeypatch.setattr(replay, "_rerun", lambda: str(stub))
    png = tmp_path / "a.png"
    assert replay.main([str(record(tmp_path / "a.mcap")), "--screenshot", str(png)]) == 2
    said = capsys.readouterr().err
    assert "is a Vulkan driver installed" in said
    assert "no adapter" in said
    assert "frame" not in said
    assert not png.exists()


@pytest.mark.e2e
@pytest.mark.slow
class TestScreenshot:
    """Needs a Vulkan driver; Mesa's lavapipe (mesa-vulkan-drivers) will do."""

    def test_every_view_is_drawn(self, record: Callable[..., Path], tmp_path: Path) -> None:
        png = tmp_path / "a.png"
        assert replay.main([str(record(tmp_path / "a.mcap")), "--screenshot", str(png), "--at", "1.5"]) == 0
        drawn = np.asarray(Picture.open(io.BytesIO(png.read_bytes())).convert("RGB")).astype(int)
        assert drawn.shape == (1080, 1920, 3)
        for colour, columns in ((RED, slice(0, 534)), (BLUE, slice(534, 1068))):
            is_there = (np.abs(drawn[:460, columns] - colour) < 12).all(axis=-1)
            assert is_there.mean() > 0.5  # the camera fills most of its view
        plots, lanes = drawn[490:820], drawn[870:1040]
        assert len(np.unique(plots.reshape(-1, 3), axis=0)) > 100  # lines, not an empty grid
        is_colourful = (lanes.max(axis=-1) - lanes.min(axis=-1)) > 60
        assert is_colourful.mean() > 0.3  # bars

    def test_a_picture_that_cannot_be_drawn_is_exit_2(
        self, record: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def broken(seen: m.Observation) -> m.Observation:
            data = b"\xff\xd8 no jpeg"
            return replace(seen, images=tuple(replace(i, codec=m.ImageCodec.JPEG, data=data) for i in seen.images))

        log = record(tmp_path / "a.mcap", broken)
        assert replay.main([str(log), "--screenshot", str(tmp_path / "a.png")]) == 2
        assert "a.mcap is no episode log: Image.data" in capsys.readouterr().err
