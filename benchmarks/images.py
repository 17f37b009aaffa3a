"""Builds the four images, and plays a real-time episode with them, without a container engine's daemon.

python -m benchmarks.images                       # needs root and buildah; mmdebstrap as well without a registry

It is buildah with the isolation of a chroot: what runs is the images' programs, files, user and environment, and the
commands of ``docker/compose.yaml`` on one network, with a volume for the logs. What it cannot show is what an engine
adds: read-only roots, dropped capabilities, health checks that it asks itself, restarts, GPUs.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from benchmarks.report import Report, Row, show
from protocol.command_line import On, command, parse
from protocol.errors import CommandError

ROOT = Path(__file__).parents[1]
BASE = "docker.io/library/python:3.11-slim-bookworm"
NAMES = ("clock", "ponder", "pounce", "sim")
_STORAGE = {"STORAGE_DRIVER": "vfs", "BUILDAH_ISOLATION": "chroot"}
_READY_S, _EPISODE_S = 300.0, 300.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagesOptions:
    """Builds the images of docker/ and plays an episode with them."""

    stand_in: bool = False
    """Make the base image from Debian's packages (mmdebstrap) instead of pulling it."""
    mount: tuple[Path, ...] = ()
    """Folders with packages that the builds may read, at the same paths."""
    torch: str = ""
    """What is installed as torch: a requirement, or a wheel under --mount. "": the Dockerfiles' own, with CUDA."""
    episode: tuple[str, ...] = ("--task", "PickHighlight", "--difficulty", "easy", "--max-steps", "100")
    """Options of sim-client beside those of compose.yaml."""
    keep: bool = False
    """Do not remove the images."""
    report: On = True
    """Do not write the report."""


def buildah(*words: str | Path, **options: Any) -> str:
    """Runs buildah; returns what it prints. Raises CommandError with its last line if it fails."""
    done = subprocess.run(["buildah", *words], capture_output=True, text=True, check=False, **options)
    if done.returncode:
        raise CommandError(f"buildah {words[0]}: {(done.stderr.strip().splitlines() or ['no output'])[-1]}")
    return done.stdout.strip()


def make_stand_in() -> None:
    """Debian's own Python under the name of the official image, with this machine's certificates and pip settings."""
    with tempfile.TemporaryDirectory() as folder:
        archive = Path(folder) / "root.tar"
        packages = "--include=python3,python3-pip,python3-venv,ca-certificates"
        subprocess.run(
            ["mmdebstrap", "--mode=root", "--variant=minbase", packages, "bookworm", archive],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        container = buildah("from", "scratch")
        buildah("add", container, archive, "/")
        for path in ("/etc/ssl/certs/ca-certificates.crt", "/etc/pip.conf"):
            if Path(path).exists():
                buildah("copy", container, path, path)
        links = "rm -f /usr/lib/python3*/EXTERNALLY-MANAGED; ln -sf python3 /usr/bin/python"
        buildah("run", container, "--", "sh", "-c", links)
        buildah("commit", "--rm", container, BASE)


def build(name: str, options: ImagesOptions) -> Row:
    start_s = time.monotonic()
    arguments = ["--build-arg", f"TORCH={options.torch}"] if options.torch else []
    mounts = [word for path in options.mount for word in ("--volume", f"{path}:{path}:ro")]
    pip = [word for key in os.environ if key.startswith("PIP_") for word in ("--env", f"{key}={os.environ[key]}")]
    buildah(
        "build", "--pull-never" if options.stand_in else "--pull", "--network", "host", *mounts, *pip, *arguments,
        "--file", ROOT / "docker" / f"{name}.Dockerfile", "--tag", _tag(name), ROOT,
    )  # fmt: skip
    took_s = round(time.monotonic() - start_s)
    image = json.loads(buildah("inspect", "--type", "image", _tag(name)))["OCIv1"]["config"]
    root = Path(buildah("mount", container := buildah("from", _tag(name))))
    size = sum(path.lstat().st_size for path in root.rglob("*") if path.is_file() and not path.is_symlink())
    buildah("rm", container)
    return {
        "image": name,
        "build_s": took_s,
        "size_MB": round(size / 1e6),
        "user": image.get("User", ""),
        "entry": " ".join(image["Entrypoint"]),
    }


def _tag(name: str) -> str:
    return f"localhost/ponderpounce-{name}"


@contextmanager
def running(name: str, arguments: Sequence[str], said: Path, volume: str = "") -> Iterator[subprocess.Popen[bytes]]:
    """A container of an image, with its own entry point, user and environment."""
    container = buildah("from", _tag(name))
    entry = json.loads(buildah("inspect", container))["OCIv1"]["config"]["Entrypoint"]
    volumes = ["--volume", volume] if volume else []
    if volume:  # else buildah mounts a volume of its own where the image declares one
        buildah("config", "--volume", f"{volume.partition(':')[2]}-", container)
    words = ["buildah", "run", "--network", "host", *volumes, container, "--", *entry, *arguments]
    with said.open("wb") as file:
        process = subprocess.Popen(words, stdout=file, stderr=file, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(30)
        buildah("rm", container)


def await_ready(url: str, process: subprocess.Popen[bytes], said: Path) -> float:
    """Asks what a health check asks; returns the seconds until it is answered with 200."""
    start_s = time.monotonic()
    while time.monotonic() - start_s < _READY_S:
        if process.poll() is not None:
            raise CommandError(f"{said.stem} left with exit code {process.returncode}: {_last_line(said)}")
        try:
            with urllib.request.urlopen(url, timeout=5):
                return time.monotonic() - start_s
        except (urllib.error.URLError, OSError):
            time.sleep(0.5)
    raise CommandError(f"{url} did not answer 200 within {_READY_S:.0f} s: {_last_line(said)}")


def _last_line(path: Path) -> str:
    return (path.read_text(errors="replace").strip().splitlines() or ["no output"])[-1]


def play(options: ImagesOptions, folder: Path) -> list[Row]:
    """Starts the daemons with their commands of compose.yaml, then the robot; checks its log in the clock's image."""
    services = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"]
    rows: list[Row] = []
    out = folder / "out"
    out.mkdir()
    shutil.chown(out, 1000)
    volume = f"{out}:/out"
    with running("ponder", services["ponder"]["command"], folder / "ponder.log") as ponder, running(
        "pounce", services["pounce"]["command"], folder / "pounce.log"
    ) as pounce, running("clock", services["clock"]["command"], folder / "clock.log") as clock:  # fmt: skip
        for name, process in (("clock", clock), ("ponder", ponder), ("pounce", pounce)):
            at = services[name]["command"][-1]
            path = "healthz" if name == "clock" else "readyz"
            took_s = await_ready(f"http://{at}/{path}", process, folder / f"{name}.log")
            rows.append({"what": f"{name} answers /{path} with 200", "result": f"after {took_s:.0f} s"})
        words = [*services["sim"]["command"], "--no-progress", *options.episode]
        with running("sim", words, folder / "sim.log", volume) as sim:
            rows.append({"what": "sim-client's exit code", "result": str(sim.wait(_EPISODE_S))})
    (episode,) = json.loads((out / "results.json").read_text())["episodes"]
    rows.append({"what": "its episode", "result": f"{episode['status']} after {episode['steps']} steps"})
    container = buildah("from", _tag("clock"))
    log = f"/out/{episode['mcap']}"
    rows.append(
        {
            "what": "pp-check in the clock's image",
            "result": buildah("run", "--volume", volume, container, "--", "pp-check", log).removeprefix(log),
        }
    )
    buildah("rm", container)
    return rows


@command("images")
def main(argv: list[str] | None = None) -> int:
    options = parse(ImagesOptions, argv, prog="python -m benchmarks.images")
    for name in ("buildah", *(("mmdebstrap",) if options.stand_in else ())):
        if shutil.which(name) is None:
            raise CommandError(f"{name} is not installed: apt-get install {name}")
    os.environ.update(_STORAGE)
    report = Report(
        name="images",
        question="Do the four images build, and does an episode play with them?",
        config=replace(options, mount=(), torch=Path(options.torch).name),  # no path of the machine
        warm_up="none",
    )
    if options.stand_in:
        make_stand_in()
    built = []
    for name in NAMES:
        built.append(build(name, options))
        print(built[-1], flush=True)
    report.add_table("Built", built)
    with tempfile.TemporaryDirectory() as folder:
        try:
            report.add_table("An episode", play(options, Path(folder)))
        except CommandError:
            for said in sorted(Path(folder).glob("*.log")):
                print(f"--- {said.name}\n{said.read_text(errors='replace')[-2000:]}")
            raise
    report.notes += [
        "Built and run by buildah with the isolation of a chroot, as the images' own user, with the commands of "
        "docker/compose.yaml. Not shown: read-only roots, capabilities, an engine's health checks and restarts, a GPU.",
        *(["The base image is a stand-in from Debian's packages: Debian's Python 3.11."] if options.stand_in else []),
    ]
    if options.report:
        report.write()
    show(report)
    if not options.keep:
        for name in NAMES:
            buildah("rmi", "--force", _tag(name))
    return 0


if __name__ == "__main__":
    sys.exit(main())
