"""The checks of ``pp-doctor``: each probe is a function from facts to one ``Finding``.

The facts are arguments, so a test can break each of them. Checks that may hang, crash or import a large package
(rendering, torch) run in their own process.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import Literal, NamedTuple

from protocol.version import DISTRIBUTION

Role = Literal["all", "robot", "models", "clock"]

_EXTRAS: dict[Role, tuple[str, ...]] = {"all": ("sim", "serve"), "robot": ("sim",), "models": ("serve",), "clock": ()}
GL_PACKAGES = {
    "egl": ("libegl1", "libegl-mesa0", "libgl1-mesa-dri", "libopengl0"),
    "osmesa": ("libosmesa6",),
}
VULKAN_PACKAGE = "mesa-vulkan-drivers"
VULKAN_FOLDERS = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))
ROBOSUITE = "1.5.2"
FRAME_BYTES = 2 * 256 * 256 * 3  # one observation's two cameras
LEAST_FREE_BYTES = 1 << 30  # an episode of 1300 ticks logged with --pixels exact (8 MB/s) is half of it
LATE_SLEEP_MS = 5.0  # a tenth of a 50 ms tick
_NUM_SLEEPS = 50

_RENDER = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='.3' rgba='1 0 0 1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 64, 64)
renderer.update_scene(data)
picture = renderer.render()
renderer.close()
print("contrast", int(picture.max()) - int(picture.min()))
"""
_IMPORT_TORCH = """
import torch, transformers
from transformers.models.auto.configuration_auto import CONFIG_MAPPING_NAMES as known
device = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "CPU only"
print(f"torch {torch.__version__}, transformers {transformers.__version__}, {device}", "qwen3_5" in known, sep="|")
"""


class Level(StrEnum):
    OK = "ok"
    WARNING = "warning"
    """Something optional does not work, or works less well."""
    FAILED = "failed"


class Finding(NamedTuple):
    """One probe's answer. ``way_out``: a sentence, or what to type; "" if all is well."""

    name: str
    level: Level
    text: str
    way_out: str = ""


class Ran(NamedTuple):
    """How a process ended. ``code`` is None if it had to be killed."""

    code: int | None
    output: str

    @property
    def last_line(self) -> str:
        lines = self.output.strip().splitlines()
        return lines[-1] if lines else "no output"


Run = Callable[[Sequence[str], Mapping[str, str]], Ran]


def python(version: tuple[int, ...] = sys.version_info[:3]) -> Finding:
    text = ".".join(map(str, version))
    if version < (3, 11):
        way_out = "Make the environment with Python 3.11 or newer: make setup PYTHON=python3.11"
        return Finding("python", Level.FAILED, text, way_out)
    return Finding("python", Level.OK, text)


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def packages(role: Role, further: Sequence[str] = (), version_of: Callable[[str], str | None] = _installed) -> Finding:
    """The bounds of our own distribution and of its extras, the role's and ``further``, against what is installed."""
    ours = version_of(DISTRIBUTION)
    if ours is None:
        way_out = "make setup, or: pip install --no-deps -e ."
        return Finding("packages", Level.FAILED, f"{DISTRIBUTION} is not installed", way_out)
    extras = (*_EXTRAS[role], *further)
    wrong = []
    lines = metadata.requires(DISTRIBUTION) or []
    if unknown := sorted(set(further) - set(metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or ())):
        way_out = "docs/install.md lists the extras"
        return Finding("packages", Level.FAILED, f"{DISTRIBUTION} has no extra {', '.join(unknown)}", way_out)
    bounds = list(dict(_requirements(lines, extras)).items())
    for name, bound in bounds:
        version = version_of(name)
        if version is None:
            wrong.append(f"{name} is missing")
        elif not _is_within(version, bound):
            wrong.append(f"{name} is {version}, not {bound}")
    if wrong:
        name = f"{DISTRIBUTION}[{','.join(extras)}]" if extras else DISTRIBUTION
        way_out = f"make setup, or: pip install '{name}' (docs/install.md)"
        return Finding("packages", Level.FAILED, "; ".join(wrong), way_out)
    return Finding("packages", Level.OK, f"{DISTRIBUTION} {ours} and the {len(bounds)} it needs")


def _requirements(lines: Sequence[str], extras: Sequence[str]) -> Iterator[tuple[str, str]]:
    """(name, bounds) of those that are always needed or by one of ``extras``: ``mujoco``, ``<3.10,>=3.4``.

    An extra that is made of others brings theirs.
    """
    for line in lines:
        requirement, _, marker = (part.strip() for part in line.partition(";"))
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", marker)
        if (extra is None or extra[1] in extras) and (parts := re.match(r"([\w.-]+)\s*(.*)", requirement)):
            if parts[1] == DISTRIBUTION:
                yield from _requirements(lines, re.findall(r"[\w-]+", parts[2]))
            else:
                yield parts[1], parts[2]


def _is_within(version: str, bounds: str) -> bool:
    """For the operators and plain versions that our pyproject uses."""
    have = _release(version)
    for clause in filter(None, bounds.split(",")):
        parts = re.fullmatch(r"(>=|<|==)\s*([\d.]+)", clause.strip())
        if parts is None:
            raise ValueError(f"bound {clause!r}: only >=, < and == are understood here")
        bound = _release(parts[2])
        if not {">=": have >= bound, "<": have < bound, "==": have == bound}[parts[1]]:
            return False
    return True


def _release(version: str) -> tuple[int, ...]:
    """The numbers, without trailing zeros: 2.13.0+cpu is (2, 13)."""
    parts = re.match(r"\d+(\.\d+)*", version)
    numbers = [int(n) for n in parts[0].split(".")] if parts else []
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def run(command: Sequence[str], environment: Mapping[str, str], *, limit_s: float = 120.0) -> Ran:
    """Runs ``command`` with the environment changed so; its output and errors together."""
    try:
        done = subprocess.run(
            command,
            env={**os.environ, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Ran(None, f"no answer within {limit_s:.0f} s")
    return Ran(done.returncode, done.stdout)


def gl(backend: str, run: Run = run, environment: Mapping[str, str] = os.environ) -> Finding:
    """Renders one picture and checks that it is not empty."""
    ran = run([sys.executable, "-c", _RENDER], {"MUJOCO_GL": backend})
    contrast = re.search(r"^contrast (\d+)$", ran.output, re.MULTILINE)
    if ran.code == 0 and contrast and int(contrast[1]) > 0:
        return Finding("gl", Level.OK, "a 64 px frame came out")
    text = "the frame came out empty" if contrast else f"no frame: {ran.last_line}"
    packages, platform = GL_PACKAGES.get(backend), environment.get("PYOPENGL_PLATFORM", backend)
    if packages is not None and platform not in ("", backend):
        way_out = f"PYOPENGL_PLATFORM={platform} contradicts MUJOCO_GL={backend}: unset it"
    elif packages is None:
        way_out = f"MUJOCO_GL={backend} needs a display; without one use MUJOCO_GL=egl or osmesa"
    else:
        way_out = f"{_apt(*packages)}; then MUJOCO_GL={backend}"
    return Finding("gl", Level.FAILED, text, way_out)


def _apt(*packages: str) -> str:
    return f"as root: apt-get install -y --no-install-recommends {' '.join(packages)}"


def _locate_robosuite() -> Path | None:
    """Located, never imported: importing it compiles for seconds and can spoil rendered frames."""
    spec = importlib.util.find_spec("robosuite")
    return Path(spec.submodule_search_locations[0]) if spec and spec.submodule_search_locations else None


def robosuite(locate: Callable[[], Path | None] = _locate_robosuite) -> Finding:
    """The Panda's meshes, all that is used of it."""
    folder = locate()
    way_out = f"pip install --no-deps robosuite=={ROBOSUITE}  (its own pins contradict numpy 2)"
    if folder is None:
        return Finding("robosuite", Level.FAILED, "not installed", way_out)
    model = folder / "models" / "assets" / "robots" / "panda" / "robot.xml"
    if not model.is_file():
        return Finding("robosuite", Level.FAILED, f"{model} is missing", way_out)
    return Finding("robosuite", Level.OK, "the Panda's model and meshes are there")


def _passes_a_frame() -> bool:
    """Whether an observation-sized message arrives as it was sent.

    Raises:
        TransportError: no session opens.
        TimeoutError: nothing arrives within 5 s.
    """
    from protocol.topics import Priority
    from protocol.zenoh_bus import Endpoints, ZenohBus
    from sim_client.launch import free_ports

    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    key, frame, deadline_s = "pp/@v1/doctor/frame", os.urandom(FRAME_BYTES), time.monotonic() + 5.0
    listener = ZenohBus(Endpoints(listen=(endpoint,)))
    try:
        caller = ZenohBus(Endpoints(connect=(endpoint,)))
        try:
            frames = caller.subscribe(key, keep=1)
            while not (arrived := frames.drain()):
                if time.monotonic() > deadline_s:
                    raise TimeoutError("nothing arrived within 5 s")
                listener.publish(key, frame, encoding="", attachment=b"", priority=Priority.DATA)
                caller.wait(20_000_000)
            return arrived[-1].payload == frame
        finally:
            caller.close()
    finally:
        listener.close()


def zenoh_loopback(passes_a_frame: Callable[[], bool] = _passes_a_frame) -> Finding:
    """Two sessions on 127.0.0.1 and one observation between them."""
    name = "zenoh"
    try:
        is_same = passes_a_frame()
    except (ImportError, OSError, RuntimeError) as error:
        way_out = "make setup; let 127.0.0.1 be reachable (container networks, firewalls)"
        return Finding(name, Level.FAILED, f"no loopback session: {error}", way_out)
    if not is_same:
        return Finding(name, Level.FAILED, "a message arrived changed", "Report this, please.")
    return Finding(name, Level.OK, f"{FRAME_BYTES} bytes passed between two sessions")


def torch(run: Run = run) -> Finding:
    """Imports what the model servers import."""
    ran = run([sys.executable, "-c", _IMPORT_TORCH], {})
    versions, _, knows = ran.last_line.partition("|")
    if ran.code != 0:
        way_out = "make setup; for another build of torch: make setup TORCH=torch==VERSION or TORCH=file.whl"
        return Finding("torch", Level.FAILED, f"does not import: {ran.last_line}", way_out)
    if knows != "True":
        text = f"{versions}: this transformers does not know Qwen3.5"
        return Finding("torch", Level.FAILED, text, f"make setup, or: pip install '{DISTRIBUTION}[serve]'")
    return Finding("torch", Level.OK, versions)


def _who_is_alive(endpoint: str) -> str:
    """The liveliness tokens behind ``endpoint``: "clock of r0"; "" if there is none."""
    from protocol.topics import alive_key
    from protocol.zenoh_bus import Endpoints, ZenohBus

    bus = ZenohBus(Endpoints(connect=(endpoint,)))
    try:
        tokens, deadline_s = bus.watch_alive(alive_key("*", "*")), time.monotonic() + 1.0
        while time.monotonic() < deadline_s:
            keys = [sample.key.split("/") for sample in tokens.drain() if sample.payload]
            if keys:
                return ", ".join(f"{key[4]} of {key[2]}" for key in keys)
            bus.wait(50_000_000)
        return ""
    finally:
        bus.close()


def sockets(folder: Path | None = None, who_is_alive: Callable[[str], str] = _who_is_alive) -> Finding:
    """The daemons' default sockets: usable, and whose. ``sim-client --local`` takes other ones and never minds."""
    from protocol.errors import TransportError
    from protocol.sockets import FOLDER, endpoint, make_private

    folder, alive = folder or FOLDER, []
    try:
        for proc in ("clock", "ponder", "pounce"):
            path = folder / f"{proc}.sock"
            make_private(path)
            if path.exists() and (who := who_is_alive(endpoint(proc, folder))):
                alive.append(who)
    except TransportError as error:
        return Finding("sockets", Level.WARNING, str(error), f"rm -r {folder}, or see why it is there: ls -ld {folder}")
    return Finding("sockets", Level.OK, f"in {folder}: " + (", ".join(alive) or "nobody is there"))


def _vulkan_drivers() -> list[str]:
    return [path.name for folder in VULKAN_FOLDERS for path in folder.glob("*.json")]


def rerun(
    version_of: Callable[[str], str | None] = _installed, drivers: Callable[[], Sequence[str]] = _vulkan_drivers
) -> Finding:
    """The viewer, and the software Vulkan that it needs to draw without a screen."""
    version = version_of("rerun-sdk")
    if version is None:
        way_out = f"pip install '{DISTRIBUTION}[replay]'; logs can be checked (pp-check) without it"
        return Finding("rerun", Level.WARNING, "rerun-sdk is not installed", way_out)
    if not any(name.startswith("lvp_icd") for name in drivers()):
        text = f"rerun-sdk {version}; no software Vulkan (lavapipe): no pictures without a GPU and a screen"
        return Finding("rerun", Level.WARNING, text, _apt(VULKAN_PACKAGE))
    return Finding("rerun", Level.OK, f"rerun-sdk {version}, lavapipe for pictures without a screen")


def disk(
    out: Path,
    free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    may_write: Callable[[Path], bool] = lambda folder: os.access(folder, os.W_OK),
) -> Finding:
    """Where logs would go, or the nearest folder above that exists."""
    folder = next(path for path in (out.absolute(), *out.absolute().parents) if path.is_dir())
    if not may_write(folder):
        return Finding(
            name="disk", level=Level.FAILED, text=f"{folder} is not writable", way_out="sim-client --out DIR"
        )
    free = free_bytes(folder)
    text = f"{free / 1e9:.1f} GB free for {out}"
    if free < LEAST_FREE_BYTES:
        way_out = "Make room, or record elsewhere: sim-client --out DIR"
        return Finding("disk", Level.FAILED, text, way_out)
    return Finding("disk", Level.OK, text)


def cpu(cores: int | None = None, load: float | None = None) -> Finding:
    """Cores that this process may use, and how many are wanted already."""
    cores = cores if cores is not None else len(os.sched_getaffinity(0))
    load = load if load is not None else os.getloadavg()[0]
    text = f"{cores} cores, load {load:.1f}"
    if cores < 2:
        way_out = "Three processes share one core: prefer --mode lockstep, where time waits"
        return Finding("cpu", Level.WARNING, text, way_out)
    if load > cores:
        way_out = "Others are busy here: latencies and ticks will be late; lockstep episodes stay exact"
        return Finding("cpu", Level.WARNING, text, way_out)
    return Finding("cpu", Level.OK, text)


def _sleep_errors_ms() -> list[float]:
    """How much longer than asked each of 50 sleeps of 1 ms took."""
    errors = []
    for _ in range(_NUM_SLEEPS):
        start_ns = time.monotonic_ns()
        time.sleep(0.001)
        errors.append((time.monotonic_ns() - start_ns) / 1e6 - 1.0)
    return errors


def clock(sleep_errors_ms: Callable[[], Sequence[float]] = _sleep_errors_ms) -> Finding:
    """How late a sleeping process wakes: the floor under every tick's lateness. p99 by nearest rank."""
    errors = sorted(sleep_errors_ms())
    p99 = errors[-(-len(errors) * 99 // 100) - 1]
    text = f"sleeps of 1 ms overrun by {p99:.2f} ms (p99 of {len(errors)})"
    if p99 > LATE_SLEEP_MS:
        way_out = "Ticks of 50 ms will be late by as much: quieten the machine, or give clock-serve a core of its own"
        return Finding("clock", Level.WARNING, text, way_out)
    return Finding("clock", Level.OK, text)


def checkpoint(kind: str, folder: Path) -> Finding:
    """The files a checkpoint folder must have; loading, which checks every tensor, is the server's work."""
    needed = ["config.json", "tokenizer.json"] if kind == "ponder" else ["tokenizer.model"]
    missing = [name for name in needed if not (folder / name).is_file()]
    weights = ["model.safetensors", "model.safetensors.index.json"]
    weights += ["model.safetensors.packed"] if kind == "ponder" else []
    if not any((folder / name).is_file() for name in weights):
        missing.append("model.safetensors")
    if missing:
        text = f"{folder} has no {', '.join(missing)}"
        way_out = f"Name a checkpoint folder with --{kind}-checkpoint, or none for a tiny random network"
        return Finding("checkpoint", Level.FAILED, text, way_out)
    return Finding("checkpoint", Level.OK, f"{folder} has its files")
