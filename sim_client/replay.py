"""``pp-replay``: a logged episode in rerun, with our layout. Reads the MCAP log itself; nothing is recorded twice.

A layout belongs to an application id, and rerun derives that of an MCAP from its file name; so the log is converted
to .rrd with a fixed id and the layout merged into it (two files opened side by side do not find each other).
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import tyro
from rerun.chunk import McapReader
from rerun.experimental import ViewerClient

from protocol import files
from protocol.command_line import command, parse
from protocol.errors import CommandError
from protocol.mcap_log import read_log, read_pictures, recover
from sim_client.blueprint import TIMELINE, episode_blueprint

APPLICATION_ID = "ponderpounce"
_OPEN_S = 60.0  # software rendering on a busy machine
_SETTLE_S = 3.0  # the viewer does not report when it has decoded and drawn its screen
_STEP_S = 0.1
_END_S = 5.0  # for a viewer that closed its connection to exit
_TAIL_CHARS = 500


class ReplayError(CommandError):
    """rerun could not convert, open or draw the episode."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayConfig:
    """Shows a recorded episode in rerun. With --save or --screenshot no window is opened."""

    file: tyro.conf.Positional[Path]
    """Episode log (.mcap, or .mcap.partial of a killed process)."""
    save: Path | None = None
    """File (.rrd) to write the episode and its layout to; open it with ``rerun FILE``."""
    screenshot: Path | None = None
    """File (.png) to draw to without a window; needs a Vulkan driver (mesa-vulkan-drivers has a software one)."""
    at: float = 0.0
    """Episode time of the screenshot in seconds."""


@command("pp-replay")
def main(argv: list[str] | None = None) -> int:
    config = parse(ReplayConfig, argv, prog="pp-replay")
    for target in filter(None, (config.save, config.screenshot)):
        files.make_way(target)
    with tempfile.TemporaryDirectory(prefix="ponderpounce-replay-") as folder:
        rrd = Path(folder) / "episode.rrd"
        t0_unix_ns = convert(config.file, rrd)
        if config.save is not None:
            _keep(rrd, config.save)
            sys.stdout.write(f"{config.save}: {config.save.stat().st_size / 1e6:.1f} MB\n")
        if config.screenshot is not None:
            png = Path(folder) / "frame.png"
            screenshot(rrd, png, t0_unix_ns + round(config.at * 1e9))
            _keep(png, config.screenshot)
            sys.stdout.write(f"{config.screenshot}: {config.at:g} s into the episode\n")
        elif config.save is None:
            _open_window(rrd)
    return 0


def _keep(made: Path, target: Path) -> None:
    """Copies a finished file: rerun has its own way with odd names and full disks."""
    with files.writing(target):
        shutil.copyfile(made, target)


def _open_window(rrd: Path) -> None:
    """Raises ReplayError if there is no display, or the viewer ends with an error."""
    if sys.platform == "linux" and not any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        raise ReplayError("no display here; give --screenshot frame.png, or --save episode.rrd to open it elsewhere")
    command = [_rerun(), "--bind", "127.0.0.1", "--port", "auto", str(rrd)]
    code = subprocess.run(command, env=_environ(), check=False).returncode
    if code:
        raise ReplayError(f"the viewer ended with exit code {code}; --save and --screenshot need no window")


def convert(log: Path, rrd: Path) -> int:
    """Writes the episode and its layout into ``rrd``; returns the unix time [ns] of episode time 0.

    rerun reads a copy of the log: it needs chunks and a summary, which MCAP leaves to the writer, and would believe
    what a picture or a chunk claims.

    Raises:
        OSError: a file cannot be read or written.
        FileError: ``log`` is not an episode's log.
        ReplayError: rerun refuses the conversion.
    """
    record = read_log(log)
    for _ in read_pictures(log):
        pass  # each is looked at
    with tempfile.TemporaryDirectory(prefix="ponderpounce-replay-") as folder:
        copy, episode, layout = (Path(folder) / name for name in ("episode.mcap", "episode.rrd", "layout.rbl"))
        recover(log, copy)
        recording_id = record.info.header.episode or log.stem
        with files.reading(log, "log that rerun can read"):
            stream = McapReader(copy).stream()
            stream.write_rrd(episode, application_id=APPLICATION_ID, recording_id=recording_id)
        episode_blueprint(record.info).save(APPLICATION_ID, layout)
        command = [_rerun(), "rrd", "merge", str(episode), str(layout), "-o", str(rrd)]
        merged = subprocess.run(command, env=_environ(), capture_output=True, check=False)
        if merged.returncode or not rrd.exists():
            raise ReplayError(f"rerun rrd merge failed: {merged.stderr.decode(errors='replace').strip()}")
    return record.info.t0_unix_ns


def screenshot(rrd: Path, png: Path, at_unix_ns: int) -> None:
    """Draws the episode at one instant of its log time.

    Raises:
        ReplayError: the viewer did not open it, or reports a problem.
    """
    with _headless() as viewer:
        viewer.open([str(rrd.resolve())])
        _await(lambda: _has_opened(viewer), f"the viewer did not open {rrd} within {_OPEN_S:.0f} s")
        viewer.set_location(viewer.get_state().recordings[0].location)
        time.sleep(_SETTLE_S)
        # Without play_state="paused" the cursor drifts to the end.
        viewer.set_time(TIMELINE, timestamp=np.datetime64(at_unix_ns, "ns"), play_state="paused")
        time.sleep(_SETTLE_S)
        views = viewer.get_state().views
        problems = [f"{view.name}: {report.summary}" for view in views for report in view.reports]
        # A picture that cannot be decoded is reported by no view, only in the viewer's log.
        problems += [entry.message for entry in viewer.get_logs() if entry.level == "ERROR"]
        viewer.save_screenshot(str(png.resolve()))
        _await(png.exists, f"the viewer drew no {png} within {_OPEN_S:.0f} s")
    if problems or not views:
        raise ReplayError("the viewer reports: " + ("; ".join(problems) or "no view was opened"))


@contextlib.contextmanager
def _headless() -> Iterator[Any]:
    """A viewer without a window, reachable from this machine only."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [_rerun(), "--headless", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"]
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        # In its own process group: ``rerun`` is a script that starts the viewer, and both have to end.
        process = subprocess.Popen(command, env=_environ(), stdout=output, stderr=output, start_new_session=True)
        try:
            _await(lambda: process.poll() is not None or _listens(port), "the viewer did not start")
            if process.poll() is not None:
                raise ReplayError(_last_words(output))
            yield ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        except ConnectionError as error:  # it listens before it searches for a driver, and exits if there is none
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_END_S)
                raise ReplayError(_last_words(output)) from error
            raise ReplayError(f"the viewer does not answer: {error}") from error
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # it holds nothing that would be lost
            process.wait()


def _last_words(output: IO[str]) -> str:
    output.seek(0)
    text = output.read()
    panic = text.find("panicked at")  # what follows is a backtrace
    message = text[-_TAIL_CHARS:].strip() if panic < 0 else text[panic:].partition("\n")[0]
    return f"the viewer ended at once; is a Vulkan driver installed (mesa-vulkan-drivers has one)? It said: {message}"


def _has_opened(viewer: Any) -> bool:
    state = viewer.get_state()
    return bool(not state.loading and state.recordings and state.recordings[0].timelines)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _await(is_done: Any, otherwise: str) -> None:
    deadline_s = time.monotonic() + _OPEN_S
    while not is_done():
        if time.monotonic() > deadline_s:
            raise ReplayError(otherwise)
        time.sleep(_STEP_S)


def _rerun() -> str:
    """The viewer that belongs to this environment, activated or not."""
    return str(Path(sysconfig.get_path("scripts")) / "rerun")


def _environ() -> dict[str, str]:
    """A private place for the viewer's settings, in which its analytics are switched off."""
    private = Path(tempfile.gettempdir()) / f"ponderpounce-rerun-{os.getuid()}"
    private.mkdir(mode=0o700, exist_ok=True)
    environ = dict(os.environ)
    environ.setdefault("XDG_RUNTIME_DIR", str(private))
    environ["XDG_CONFIG_HOME"] = str(private)
    if not (private / "rerun" / "analytics.json").exists():
        subprocess.run([_rerun(), "analytics", "disable"], env=environ, capture_output=True, check=True)
    return environ


if __name__ == "__main__":
    sys.exit(main())
