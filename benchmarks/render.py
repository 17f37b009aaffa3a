"""Turns ``reports/*.json`` into ``reports/README.md``, so that no table is ever typed by hand."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.report import REPORTS, lines_of

HEAD = """# Measured

Written by `python -m benchmarks.render` from the JSON files beside it; do not edit. Percentiles are observed values
(nearest rank). Repeat one with `python -m benchmarks.<name>`.
"""


def render(reports: list[dict[str, Any]]) -> str:
    """Returns the whole page."""
    return "\n".join([HEAD, *(section(report) for report in reports)])


def reports_in(folder: Path) -> list[dict[str, Any]]:
    """The reports, each with its file's name: one benchmark may have run on several machines."""
    return [json.loads(path.read_text()) | {"name": path.stem} for path in sorted(folder.glob("*.json"))]


def section(report: dict[str, Any]) -> str:
    if "stages" in report:
        return day_section(report)
    machine, versions = report["machine"], report["versions"]
    cpu = " ".join(filter(None, (machine["cpu"], machine.get("instructions"))))
    loads = f"{machine['load_average_before'][0]} before, {machine['load_average_after'][0]} after"
    lines = [
        f"## {report['name']}",
        "",
        report["question"],
        "",
        f"{report['date']}, commit `{report['git']}`, {cpu}, {machine['cores']} cores, "
        f"load average {loads}, {machine['took_s']:.0f} s. Not counted: {report['warm_up']}",
        "",
    ]
    for table in report["tables"]:
        lines += [f"**{table['title']}**", "", *lines_of(table["rows"]), ""]
    lines += [f"- {note}" for note in report["notes"]]
    lines += ["", "Config: " + _inline(report["config"]) + "; " + _inline(versions) + ".", ""]
    return "\n".join(lines)


def day_section(report: dict[str, Any]) -> str:
    """That of a `gpu_day`, whose stages may have run at several commits."""
    lines = [f"## {report['name']}", "", report["question"], ""]
    for name, stage in report["stages"].items():
        rows = [cells for row, found in stage["rows"].items() for cells in _day_rows(row, found)]
        columns = [key for key in _DAY_COLUMNS if any(key in row for row in rows)]
        lines += [f"**{name}**, {stage['of']}, {stage['date']}, commit `{stage['git']}`", ""]
        lines += [*lines_of([{key: row.get(key) for key in columns} for row in rows]), ""]
    return "\n".join(lines)


_DAY_COLUMNS = ("row", "n", "min_ms", "p50_ms", "p95_ms", "predicted_p50_ms", "found")


def _day_rows(name: str, found: Any) -> list[dict[str, Any]]:
    """A row of durations, or what was found, one row for each name in it."""
    if not isinstance(found, dict):
        return [{"row": name, "found": f"{found:.3g}" if isinstance(found, float) else str(found)}]
    durations = {key: found[key] for key in _DAY_COLUMNS if key in found}
    others = [cells for key in found if key not in durations for cells in _day_rows(f"{name}: {key}", found[key])]
    return [{"row": name, **durations}, *others] if durations else others


def _inline(values: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())


def main(folder: Path = REPORTS) -> int:
    reports = reports_in(folder)
    (folder / "README.md").write_text(render(reports))
    print(f"{len(reports)} reports in {(folder / 'README.md').name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
