"""Builds both wheels and installs each extra by the line of docs/install.md into an environment of its own.

There every command answers ``--help`` or names its extra, ``pp-doctor`` looks, and what the extra is for is run once.
``make wheels`` runs it; packages come from the index that pip is set up with. Environments are removed afterwards.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.report import Report, Row, show
from protocol.command_line import REFUSED, On, parse
from sim_client.launch import free_ports

ROOT = Path(__file__).parents[1]
CLIENT = ROOT / "integrations" / "ponderpounce_client"
SCRIPTS = tuple(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"])
TORCH, ROBOSUITE = "torch==2.13.0", "robosuite==1.5.2"
SMALL = ROOT / "checkpoints" / "small"
PATIENCE_S = 600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One computer of docs/install.md: what is installed, and the commands that show what it is for.

    ``runs`` may say {log} and {data}, of this interpreter, and {out}, an empty folder.
    """

    extras: tuple[str, ...] = ()
    role: str = "clock"
    robosuite: bool = False
    runs: tuple[str, ...] = ()
    installer: str = "pip"
    python: str = "3.11"

    @property
    def name(self) -> str:
        return f"[{','.join(self.extras)}]" if self.extras else "no extra"

    @property
    def has_torch(self) -> bool:
        return bool({"serve", "train", "kernels"} & set(self.extras))


ABSENT = "! pounce-serve --backend {} --start-s 2 --mapping examples/policies/{} --url {}"
IN_PROCESS = "sim-client --in-process --max-steps 20 --no-progress --out {out}"
COLLECT = "pp-collect --tasks PickHighlight --episodes 1 --difficulties easy --out {out}/set"
GYM = (
    'python -c "import gymnasium, dual_system.tasks.gymnasium_env; '
    "e = gymnasium.make('ponderpounce/PickHighlight-v0'); e.reset(seed=0); e.step(e.action_space.sample()); e.close()\""
)
OPENPI = """
import sys
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

policy = WebsocketClientPolicy("127.0.0.1", int(sys.argv[1]))
seen = np.zeros((256, 256, 3), np.uint8)
state = np.float32([0.0, 0.39, 0.0, -1.96, 0.0, 2.36, 0.79, 0.04])
pictures = {"observation/image": seen, "observation/wrist_image": seen}
for _ in range(3):
    policy.infer({**pictures, "observation/state": state, "prompt": "pick the highlighted cubes"})
"""
CASES = (
    *(Case(python=python, runs=("pp-check {log}",)) for python in ("3.11", "3.12", "3.13")),
    Case(extras=("gateway",), runs=("pp-check {log}",)),
    Case(extras=("policies",), runs=(ABSENT.format("openpi", "openpi_panda.toml", "ws://127.0.0.1:9"),)),
    Case(extras=("groot",), runs=(ABSENT.format("groot", "groot_panda.toml", "tcp://127.0.0.1:9"),)),
    Case(extras=("replay",), runs=("pp-replay {log} --save {out}/episode.rrd",)),
    Case(extras=("hub",)),
    Case(extras=("sim",), role="robot", robosuite=True, runs=("sim-client --policy oracle --out {out}",)),
    Case(extras=("sim", "gym"), role="robot", robosuite=True, runs=(GYM,)),
    Case(extras=("sim", "data"), role="robot", robosuite=True, runs=(COLLECT, "pp-export {log} --out {out}/exported")),
    Case(extras=("sim", "data", "import"), role="robot", robosuite=True, runs=("pp-collect import --help",)),
    Case(extras=("serve",), role="models"),
    Case(extras=("serve", "kernels"), role="models"),
    Case(extras=("serve", "sim"), role="all", robosuite=True, runs=(IN_PROCESS,)),
    Case(extras=("serve", "sim"), role="all", robosuite=True, runs=(IN_PROCESS,), installer="uv", python="3.12"),
    Case(
        extras=("train",),
        role="all",
        robosuite=True,
        runs=(COLLECT, "pp-train --recipe tiny --data {out}/set --out {out}/run --steps 1 --no-progress"),
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelsOptions:
    """Installs the wheels as docs/install.md says, an environment for each extra."""

    only: tuple[str, ...] = ()
    """Names of cases, such as `[serve,sim]`, or `no extra`. Empty: all."""
    report: On = True
    """Do not write the report."""


def main() -> int:
    options = parse(WheelsOptions, None, prog="wheels")
    report = Report(
        name="wheels",
        question="Do the wheels install as docs/install.md says, and do their commands do what each extra is for?",
        config=options,
        warm_up="nothing",
    )
    with tempfile.TemporaryDirectory(prefix="wheels-") as folder:
        place = Path(folder)
        wheels = _built(place)
        log = _recorded(place)
        rows = []
        for case in CASES:
            if not options.only or case.name in options.only:
                rows.append(_row(case, wheels[0], log, place))
                print(rows[-1], flush=True)
        report.add_table("Each environment", rows)
        if not options.only:
            report.add_table("Lockstep episodes between environments", _apart(wheels, place))
    if options.report:
        report.write()
    show(report)
    return int(any("failed" in str(row.values()) for table in report.tables for row in table["rows"]))


def _built(place: Path) -> tuple[Path, Path]:
    """The server's wheel and the client's."""
    dist = place / "dist"
    _run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", dist, ROOT, CLIENT], place)
    (server,), (client,) = dist.glob("ponderpounce_server-*.whl"), dist.glob("ponderpounce_client-*.whl")
    return server, client


def _recorded(place: Path) -> Path:
    """A log of this interpreter, to be read by environments that cannot play."""
    arguments = ["--in-process", "--max-steps", "20", "--no-progress", "--out", place / "recorded"]
    _run([sys.executable, "-m", "sim_client", *arguments], ROOT)
    (log,) = (place / "recorded").rglob("*.mcap")
    return log


@contextmanager
def _environment(case: Case, wheel: Path, place: Path) -> Iterator[Path]:
    """The folder of an environment's commands, installed by the documented lines."""
    place.mkdir(exist_ok=True)
    root = place / "environment"
    requirement = f"ponderpounce-server{case.name if case.extras else ''} @ file://{wheel}"
    if case.installer == "uv":
        uv = place / "uv" / "bin" / "uv"
        if not uv.exists():
            _run([sys.executable, "-m", "venv", place / "uv"], place)
            _run([place / "uv" / "bin" / "pip", "install", "--quiet", "uv"], place)
        _run([uv, "venv", "--quiet", "--python", f"python{case.python}", root], place)
        install = [uv, "pip", "install", "--quiet", "--python", root / "bin" / "python"]
    else:
        _run([f"python{case.python}", "-m", "venv", root], place)
        install = [root / "bin" / "pip", "install", "--quiet"]
    try:
        if case.has_torch:
            _run([*install, TORCH], place)
        _run([*install, requirement], place)
        if case.robosuite:
            _run([*install, "--no-deps", ROBOSUITE], place)
        yield root / "bin"
    finally:
        shutil.rmtree(root)


def _row(case: Case, wheel: Path, log: Path, place: Path) -> Row:
    begin_s = time.monotonic()
    row: Row = {"environment": case.name, "python": case.python, "by": case.installer}
    try:
        with _environment(case, wheel, place) as commands:
            row |= {"installed_s": round(time.monotonic() - begin_s), "mib": _mib(commands.parent)}
            row |= _helped(commands) | {"pp-doctor": _looked(case, commands)}
            row |= {"run": _played(case, commands, log, place / "out")}
    except subprocess.CalledProcessError as error:
        row |= dict.fromkeys(("installed_s", "mib", "start", "name_their_extra", "pp-doctor"))
        row |= {"run": f"failed: {error}"}
    finally:
        shutil.rmtree(place / "out", ignore_errors=True)
    return row


def _mib(root: Path) -> int:
    return sum(path.stat().st_size for path in root.rglob("*") if path.is_file() and not path.is_symlink()) >> 20


def _helped(commands: Path) -> Row:
    """How many commands answer --help, and how many say which extra they lack. Raises for any other answer."""
    answers = []
    for script in SCRIPTS:
        done = _done([commands / script, "--help"], ROOT.parent)
        if done.returncode not in (0, REFUSED) or (done.returncode and "pip install 'ponderpounce" not in done.stderr):
            raise subprocess.CalledProcessError(done.returncode, script, done.stdout, done.stderr)
        answers.append(done.returncode)
    return {"start": answers.count(0), "name_their_extra": answers.count(REFUSED)}


def _looked(case: Case, commands: Path) -> str:
    further = ["--extras", *case.extras] if case.extras else []
    done = _done([commands / "pp-doctor", "--role", case.role, "--required-only", *further], ROOT.parent)
    return done.stdout.strip().splitlines()[-1] if done.returncode == 0 else f"failed: {done.stdout[-300:]}"


def _played(case: Case, commands: Path, log: Path, out: Path) -> str:
    """What was run, as one line. A command after ``!`` has to be refused with a sentence and without a traceback."""
    told = []
    for line in case.runs:
        refused, words = line.startswith("! "), line.removeprefix("! ").format(log=log, out=out)
        done = _done([f"{commands}/{words}"], ROOT, shell=True)
        if (done.returncode != 0) != refused or "Traceback" in done.stderr:
            raise subprocess.CalledProcessError(done.returncode, line, done.stdout, done.stderr[-1500:])
        name = " ".join(words.split()[:2]) if words.split()[1].isalpha() else words.split()[0]
        told.append(f"{name} says {done.stderr.strip().splitlines()[-1]!r}" if refused else name)
        if logs := sorted(out.rglob("*.mcap")):
            _run([commands / "pp-check", *logs], ROOT)
            told.append("pp-check agrees")
    return ", ".join(told)


def _apart(wheels: tuple[Path, Path], place: Path) -> list[Row]:
    """Models without MuJoCo, and two robots without torch: a simulated one, and openpi's client behind the gateway."""
    robots = {
        "[sim]": Case(extras=("sim",), robosuite=True),
        "[gateway], openpi-client 0.1.2": Case(extras=("gateway",)),
    }
    links = {name: f"unixsock-stream/{place}/{name}.sock" for name in ("ponder", "pounce")}
    connect = ["--link.connect", *links.values()]
    rows, running = [], []

    def start(command: Path, *arguments: str | Path) -> None:
        running.append(subprocess.Popen([command, *arguments], cwd=place, env=_outside()))

    with ExitStack() as stack:
        serving, simulating, answering = (
            stack.enter_context(_environment(case, wheels[0], place / f"apart-{number}"))
            for number, case in enumerate((Case(extras=("serve",)), *robots.values()))
        )
        try:
            for name, link in links.items():
                start(serving / f"{name}-serve", "--checkpoint", SMALL / name, "--link.listen", link)
            out = place / "apart"
            _run([simulating / "sim-client", *connect, "--max-steps", "100", "--no-progress", "--out", out], place)
            _run([answering / "pip", "install", "--quiet", "--no-deps", "openpi-client==0.1.2"], place)
            (port,) = free_ports(1)
            listen = ["--listen", f"127.0.0.1:{port}", "--out", place / "behind"]
            start(answering / "pp-gateway", "--dialect", "openpi", "--rows", "10", *connect, *listen)
            _wait_for(port)
            _run([answering / "python", "-c", OPENPI, str(port)], place)
        finally:
            for process in reversed(running):
                process.send_signal(signal.SIGTERM)
                process.wait(60)
        for (name, _), folder, commands in zip(
            robots.items(), ("apart", "behind"), (simulating, answering), strict=True
        ):
            (log,) = (place / folder).rglob("*.mcap")
            said = _run([commands / "pp-check", log], place).stdout.strip()
            rows.append({"models": "[serve]", "robot": name, "pp-check": said.removeprefix(f"{log}: ")})
    return rows


def _wait_for(port: int) -> None:
    """Waits until a server listens: openpi's client asks once. Raises OSError when patience ends."""
    ends_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            return
        except OSError:
            if time.monotonic() > ends_s:
                raise
        time.sleep(0.2)


def _outside() -> dict[str, str]:
    """The environment without what would lead back to this checkout."""
    hidden = ("PYTHONPATH", "VIRTUAL_ENV", "MUJOCO_GL")
    return {name: value for name, value in os.environ.items() if name not in hidden} | {"OMP_NUM_THREADS": "1"}


def _done(command: Sequence[str | Path], cwd: Path, *, shell: bool = False) -> subprocess.CompletedProcess[str]:
    words: str | list[str] = str(command[0]) if shell else [str(word) for word in command]
    return subprocess.run(
        words, cwd=cwd, env=_outside(), shell=shell, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


def _run(command: Sequence[str | Path], cwd: Path) -> subprocess.CompletedProcess[str]:
    done = _done(command, cwd)
    if done.returncode:
        print(done.stdout[-2000:], done.stderr[-4000:], sep="\n", file=sys.stderr)
        done.check_returncode()
    return done


if __name__ == "__main__":
    sys.exit(main())
