"""Tests that need another Python or another project's program, each in an environment of its own: ``make peers``.

Counts of what passed, by stage. A stage that fails is in the report, and the exit code is 1.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks.report import Report, Row
from protocol.command_line import parse

UNIT = "not gpu and not acceptance and not peers and not e2e and not slow"


@dataclass(frozen=True, slots=True, kw_only=True)
class PeersOptions:
    """Runs the unit tests under several Pythons, and the tests beside LeRobot."""

    pythons: tuple[Path, ...]
    """Interpreters with our packages, each of another version than the one that runs this and CI."""
    lerobot: Path | None = None
    """Interpreter with lerobot 0.6. None: those tests are skipped, and counted so."""
    rosbags: Path | None = None
    """Interpreter with rosbags and Pillow. None: that test is skipped, and counted so."""
    foxglove: Path | None = None
    """Folder node_modules with @mcap/core and what it needs. None: that test is skipped, and counted so."""
    jobs: int = 1
    """Processes that share the unit tests."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """The options that a report keeps: no path."""

    jobs: int


def main() -> int:
    options = parse(PeersOptions, None, prog="peers")
    report = Report(
        name="peers",
        question="Do the unit tests hold under other Pythons, and the formats beside other projects' own programs?",
        config=Config(jobs=options.jobs),
        warm_up="nothing",
    )
    rows = [
        _stage("unit tests", python, ["-m", UNIT, "-n", str(options.jobs), "--dist", "loadfile"], {})
        for python in options.pythons
    ]
    others = {
        "LEROBOT_PYTHON": options.lerobot,
        "ROSBAGS_PYTHON": options.rosbags,
        "FOXGLOVE_MODULES": options.foxglove,
    }
    beside = {name: str(python) for name, python in others.items() if python is not None}
    rows.append(_stage("beside other projects, and public folders", Path(sys.executable), ["-m", "peers"], beside))
    report.add_table("By stage", rows)
    if options.lerobot is not None:
        told = (
            "import lerobot, platform; print(f'LeRobot {lerobot.__version__} under Python', platform.python_version())"
        )
        report.notes.append(_said(options.lerobot, told))
    print(report.write())
    return int(any(row["failed"] for row in rows))


def _stage(name: str, python: Path, arguments: list[str], variables: Mapping[str, str]) -> Row:
    """Runs pytest; returns counts. A run that did not end properly counts as a failure."""
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "results.xml"
        command = [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={results}", *arguments]
        environment = os.environ | {"OMP_NUM_THREADS": "1"} | variables
        code = subprocess.run(command, env=environment, check=False).returncode
        suite = ET.parse(results).getroot().find("testsuite") if results.exists() else None
    counts = {
        each: int(suite.get(each, 0)) if suite is not None else 0 for each in ("tests", "failures", "errors", "skipped")
    }
    failed = counts["failures"] + counts["errors"]
    return {
        "stage": name,
        "python": _said(python, "import platform; print(platform.python_version())"),
        "passed": counts["tests"] - failed - counts["skipped"],
        "failed": max(failed, int(code not in (0, 1))),
        "skipped": counts["skipped"],
        "took_s": round(time.monotonic() - begin_s),
    }


def _said(python: Path, program: str) -> str:
    return subprocess.run([str(python), "-c", program], capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
