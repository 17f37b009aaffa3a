"""Reports of measurements with machine, versions and options, as JSON that ``render`` turns into tables.

A report contains no host name and no path.
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

REPORTS = Path(__file__).parent / "reports"
_SIMD = ("avx2", "avx512f", "avx512_bf16", "amx_bf16")
_PACKAGES = (
    "numpy", "eclipse-zenoh", "protobuf", "mujoco", "torch", "mcap", "websockets", "msgpack", "openpi-client",
)  # fmt: skip

Row = dict[str, str | int | float | None]


@dataclass(kw_only=True)
class Report:
    """Opened before the first measurement, so that the machine's load before and after is recorded.

    Args:
        name: name of the JSON file.
        question: the question that the numbers answer.
        config: the options of this run.
        warm_up: description of the uncounted work before measuring.
    """

    name: str
    question: str
    config: Any
    warm_up: str
    tables: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    _load: tuple[float, float, float] = field(default_factory=os.getloadavg)
    _start_s: float = field(default_factory=time.monotonic)

    def add_table(self, title: str, rows: Sequence[Row]) -> None:
        """Adds rows with the same keys; units are part of the keys."""
        self.tables.append({"title": title, "rows": list(rows)})

    def write(self) -> Path:
        report = {
            "name": self.name,
            "question": self.question,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "git": git_version(),
            "machine": {
                "cpu": _cpu_model(),
                "instructions": _instructions(),
                "cores": os.cpu_count(),
                "load_average_before": [round(value, 2) for value in self._load],
                "load_average_after": [round(value, 2) for value in os.getloadavg()],
                "took_s": round(time.monotonic() - self._start_s, 1),
            },
            "versions": _versions(),
            "config": _as_json(dataclasses.asdict(self.config)),
            "warm_up": self.warm_up,
            "tables": self.tables,
            "notes": self.notes,
        }
        REPORTS.mkdir(exist_ok=True)
        path = REPORTS / f"{self.name}.json"
        path.write_text(json.dumps(report, indent=1) + "\n")
        return path


def spread(values: Sequence[float], unit: str) -> Row:
    """n, minimum, nearest-rank percentiles and maximum: all of them observed values."""
    if not values:
        return {"n": 0, f"min_{unit}": None} | {f"{name}_{unit}": None for name in ("p50", "p95", "p99", "max")}
    p50, p95, p99 = np.percentile(values, (50, 95, 99), method="inverted_cdf")
    found = {"min": min(values), "p50": p50, "p95": p95, "p99": p99, "max": max(values)}
    return {"n": len(values)} | {f"{name}_{unit}": round(float(value), 3) for name, value in found.items()}


def show(report: Report) -> None:
    """Prints the tables to the terminal."""
    for table in report.tables:
        print(f"\n{table['title']}")
        print("\n".join(lines_of(table["rows"])))
    for note in report.notes:
        print(f"- {note}")


def lines_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A markdown table, aligned so that it also reads as text."""
    if not rows:
        return ["(no rows)"]
    cells = [list(rows[0])] + [["" if value is None else str(value) for value in row.values()] for row in rows]
    widths = [max(2, *(len(line[column]) for line in cells)) for column in range(len(cells[0]))]  # a mark is two
    is_text = [any(isinstance(row[key], str) for row in rows) for key in rows[0]]
    marks = [":" + "-" * (w - 1) if text else "-" * (w - 1) + ":" for w, text in zip(widths, is_text, strict=True)]
    padded = [
        [cell.ljust(w) if text else cell.rjust(w) for cell, w, text in zip(line, widths, is_text, strict=True)]
        for line in cells
    ]
    return ["| " + " | ".join(line) + " |" for line in [padded[0], marks, *padded[1:]]]


def _cpu_model() -> str:
    return _cpu_info("model name") or platform.machine()


def _instructions() -> str:
    """The CPU's widest vector and matrix instructions: models of one name may differ in them."""
    return " ".join(flag for flag in _SIMD if flag in _cpu_info("flags").split())


def _cpu_info(name: str) -> str:
    """An entry of the first core in /proc/cpuinfo; empty if not on Linux."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")


def git_version() -> str:
    """Commit of the working tree; "+changes" if tracked files differ from it."""
    here = Path(__file__).parent
    try:
        sha = subprocess.run(["git", "rev-parse", "--short=12", "HEAD"], cwd=here, capture_output=True, check=True)
        changed = subprocess.run(["git", "diff", "--quiet", "HEAD"], cwd=here, capture_output=True, check=False)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return sha.stdout.decode().strip() + ("+changes" if changed.returncode else "")


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "linux": platform.release()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _as_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(item) for item in value]
    return value.name if isinstance(value, Path) else value
