"""Memory of a PONDER of real size, and of a session compared with its computed size.

Two measurements. *Sessions*: the engine is built with a few and with more sessions, and every allocated byte is
written once, because the operating system provides memory on writing; the difference per session is compared with
``EngineSpec.session_bytes``. *Episode*: ``ponder-serve`` with random weights of that size, a tiny ``pounce-serve`` and
``sim-client`` play one PickHighlight in lockstep, as separate processes; at the end ``ponder-serve``'s peak resident
memory is read from the kernel. Linux only (/proc).
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

import torch
from torch import Tensor

from benchmarks.report import Report, Row, show, spread
from dual_system.models.ponder import configs as ponder_configs
from dual_system.models.ponder.network import Ponder
from ponder_server.config import SizeName
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from protocol.command_line import parse
from protocol.mcap_log import read_log
from sim_client.launch import Daemons, start_local

MIB = 2**20
Built = TypeVar("Built")


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryOptions:
    """Sessions of a PONDER with random weights, and an episode with it."""

    size: SizeName = "qwen35_0p8b"
    dtype: Literal["float32", "bfloat16"] = "bfloat16"
    max_context_tokens: int = 16_384
    sessions: tuple[int, int] = (1, 3)
    """Number of sessions of the two engines to compare."""
    served_sessions: int = 2
    """--max-sessions of the episode's ponder-serve."""
    episode: bool = True
    seed: int = 0
    """Seed of the scene, which is an easy one."""
    max_steps: int = 1300
    limit_gib: float = 24.0
    """Limit of ponder-serve's memory; the report says whether it was kept."""


def main(argv: list[str] | None = None) -> int:
    options = parse(MemoryOptions, argv, prog="ponder-memory")
    torch.set_num_threads(1)
    report = Report(
        name=f"ponder_memory_{options.size}",
        question="Does PONDER of this size fit into memory, and does a session take what was computed?",
        config=options,
        warm_up="in the episode: ponder-serve's own warm-up, 36 fires.",
    )
    report.add_table("A session: computed, and what the engine takes for it", [session_row(options)])
    if options.episode:
        with tempfile.TemporaryDirectory() as folder:
            row, fires_ms = play(options, Path(folder))
        report.add_table("An episode in lockstep, the paper's schedule", [row])
        report.add_table("A fire in it, vision tower to cognition", [spread(fires_ms, "ms")])
        report.notes.append(
            f"ponder-serve's largest resident memory, weights and all, is {row['peak_gib']} GiB: "
            f"{'within' if row['is_within_limit'] else 'beyond'} {options.limit_gib:g} GiB."
        )
    report.notes += [
        f"{options.size} with random weights and the tiny vocabulary in the full table; one thread a process.",
        "allocated: tensors that the engine made, each counted once. resident: growth of the process when they are "
        "written.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def session_row(options: MemoryOptions) -> Row:
    """Memory of one more session, determined in three ways, in MiB."""
    ponder = Ponder.random(getattr(ponder_configs, options.size)(), seed=0, dtype=getattr(torch, options.dtype))
    fewer, more = options.sessions
    engines, allocated, resident = [], [], []  # all are kept: freed memory would stay resident
    for count in (fewer, fewer, more):  # the first one reuses free memory and is not compared
        config = EngineConfig(max_sessions=count, max_context_tokens=options.max_context_tokens)
        before = resident_bytes()
        engine, own = made_by(partial(QwenEngine, ponder, config))
        for tensor in own:
            tensor.fill_(1)
        resident.append(resident_bytes() - before)
        allocated.append(sum(tensor.nbytes for tensor in own))
        engines.append(engine)
    computed = engines[0].spec.session_bytes
    per_session = [(values[2] - values[1]) / (more - fewer) for values in (allocated, resident)]
    return {
        "max_context_tokens": options.max_context_tokens,
        "computed_mib": round(computed / MIB, 2),
        "allocated_mib": round(per_session[0] / MIB, 2),
        "resident_mib": round(per_session[1] / MIB, 2),
        "allocated_off_%": round(100 * (per_session[0] / computed - 1), 2),
        "resident_off_%": round(100 * (per_session[1] / computed - 1), 2),
    }


def made_by(build: Callable[[], Built]) -> tuple[Built, list[Tensor]]:
    """Result of ``build``, and the memory of the tensors that it created, as bytes tensors."""
    before = list(storages())  # held, so that no address is used twice
    built = build()
    known = {tensor.data_ptr() for tensor in before}
    return built, [tensor for tensor in storages() if tensor.data_ptr() not in known]


def storages() -> Iterator[Tensor]:
    """Storage of every live tensor, each once, as a bytes tensor."""
    seen: set[int] = set()
    for each in gc.get_objects():
        # Subclasses are left out: fake tensors name a device and have no memory there. isinstance would ask objects
        # for their __class__, which makes lazy ones warn.
        if type(each) not in (Tensor, torch.nn.Parameter) or each.is_meta:
            continue
        storage = each.untyped_storage()
        if (address := storage.data_ptr()) not in seen:
            seen.add(address)
            yield torch.empty(0, dtype=torch.uint8, device=each.device).set_(storage)


def resident_bytes() -> int:
    """Resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def play(options: MemoryOptions, folder: Path) -> tuple[Row, list[float]]:
    """Plays one easy episode with real processes; also returns the duration of every fire in ms."""
    ponder = ["--size", options.size, "--dtype", options.dtype, "--max-sessions", str(options.served_sessions)]
    ponder += ["--max-context-tokens", str(options.max_context_tokens)]
    hidden_size = getattr(ponder_configs, options.size)().hidden_size
    with Daemons(folder) as daemons:
        endpoints = start_local(
            daemons, robot="r0", with_clock=False, ponder=ponder, pounce=["--hidden-size", str(hidden_size)]
        )
        command = [sys.executable, "-m", "sim_client", "--mode", "lockstep", "--task", "PickHighlight"]
        command += ["--difficulty", "easy", "--seed", str(options.seed), "--max-steps", str(options.max_steps)]
        command += ["--patience-s", "3600", "--no-progress", "--out", str(folder), "--link.connect", *endpoints]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
        played = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if played.returncode != 0 or daemons.dead():
            raise RuntimeError(f"sim-client left with {played.returncode}: {played.stderr[-2000:]} {daemons.dead()}")
        peak_bytes = peak_resident_bytes(daemons.processes["ponder"].pid)
    (episode,) = json.loads((folder / "results.json").read_text())["episodes"]
    record = read_log(folder / episode["mcap"])
    lost = [event.text for event in record.events if event.name.endswith("_lost")]
    row: Row = {
        "scene": f"PickHighlight easy, seed {options.seed}",
        "outcome": episode["status"],
        "steps": episode["steps"],
        "fires": len(record.cognitions),
        "context_tokens": record.cognitions[-1].context_tokens,
        "servers_lost": len(lost),
        "first_loss": lost[0] if lost else None,
        "peak_gib": round(peak_bytes / 2**30, 2),
        "is_within_limit": peak_bytes <= options.limit_gib * 2**30,
    }
    return row, [cognition.infer_ns / 1e6 for cognition in record.cognitions]


def peak_resident_bytes(pid: int) -> int:
    """Peak resident memory of a running process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024


if __name__ == "__main__":
    sys.exit(main())
