"""Reports: observed percentiles, nothing private, and a page that is generated from them."""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks import render, report


@dataclass(frozen=True)
class Options:
    rounds: int = 3
    out: Path = Path("/somewhere/private/out")


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(report, "REPORTS", tmp_path)
    made = report.Report(name="speed", question="How fast?", config=Options(), warm_up="the first call.")
    made.add_table("Calls", [{"way": "ours", **report.spread([1.0, 2.0, 3.0], "ms")}])
    made.notes.append("measured by nobody")
    return made.write()


def test_percentiles_are_observed_values() -> None:
    values = [float(v) for v in range(1, 101)]
    assert report.spread(values, "ms") == {
        "n": 100, "min_ms": 1.0, "p50_ms": 50.0, "p95_ms": 95.0, "p99_ms": 99.0, "max_ms": 100.0,
    }  # fmt: skip


def test_nothing_measured_has_no_percentiles() -> None:
    assert report.spread([], "ms") == {
        "n": 0, "min_ms": None, "p50_ms": None, "p95_ms": None, "p99_ms": None, "max_ms": None,
    }  # fmt: skip


def test_a_report_names_what_ran_and_under_which_load(written: Path) -> None:
    found = json.loads(written.read_text())
    assert {"name", "question", "date", "git", "machine", "versions", "config", "warm_up"} <= found.keys()
    assert len(found["machine"]["load_average_before"]) == len(found["machine"]["load_average_after"]) == 3
    assert found["versions"]["python"] == platform.python_version()


def test_a_report_holds_no_path_and_no_host_name(written: Path) -> None:
    text = written.read_text()
    assert "/somewhere" not in text
    assert str(Path.home()) not in text
    assert not platform.node() or f'"{platform.node()}' not in text


def test_the_page_is_made_of_the_reports(written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert render.main(written.parent) == 0
    page = (written.parent / "README.md").read_text()
    assert "## speed" in page
    (row,) = (line for line in page.splitlines() if line.startswith("| ours"))
    assert row.replace(" ", "") == "|ours|3|1.0|2.0|3.0|3.0|3.0|"
    assert "- measured by nobody" in page


def test_a_report_of_another_machine_stands_beside_under_its_file_s_name(written: Path) -> None:
    (written.parent / "speed_elsewhere.json").write_text(written.read_text())
    assert [each["name"] for each in render.reports_in(written.parent)] == ["speed", "speed_elsewhere"]


def test_a_gpu_s_day_shows_every_row_of_every_stage_and_where_it_ran() -> None:
    rows = {
        "fire": {"n": 3, "p50_ms": 23.7, "predicted_p50_ms": 13.0},
        "solve": {"is_right": True, "n": 3, "p50_ms": 0.1},
        "trials": {"1x16": {"norm": "kernel: 2 us"}},
        "error": 0.05776,
        "broken": {"FAILED": "ValueError: no"},
    }
    stage = {"of": "full on cuda", "date": "2026-11-29", "git": "abc", "rows": rows}
    page = render.section({"name": "gpu_day", "question": "How fast?", "stages": {"fires": stage}})
    assert "**fires**, full on cuda, 2026-11-29, commit `abc`" in page
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("|")]
    assert cells[0] == ["row", "n", "p50_ms", "predicted_p50_ms", "found"]
    assert cells[2:] == [
        ["fire", "3", "23.7", "13.0", ""],
        ["solve", "3", "0.1", "", ""],
        ["solve: is_right", "", "", "", "True"],
        ["trials: 1x16: norm", "", "", "", "kernel: 2 us"],
        ["error", "", "", "", "0.0578"],
        ["broken: FAILED", "", "", "", "ValueError: no"],
    ]


def test_the_committed_page_is_what_the_committed_reports_give() -> None:
    reports = render.reports_in(report.REPORTS)
    page = report.REPORTS / "README.md"
    assert not reports or page.read_text() == render.render(reports)


@pytest.mark.parametrize("path", sorted(report.REPORTS.glob("*.json")), ids=lambda path: path.stem)
def test_committed_reports_hold_no_absolute_path(path: Path) -> None:
    assert not [word for word in path.read_text().split('"') if word.startswith("/") and len(word) > 1]
