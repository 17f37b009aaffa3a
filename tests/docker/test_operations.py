"""Alerts, board, scrape file and systemd units against what the programs print and understand."""

from __future__ import annotations

import configparser
import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tyro
import yaml
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from clock import schedules
from clock.config import ClockOptions
from ponder_server.config import PonderOptions
from pounce_server.config import PounceOptions
from protocol import messages as m
from protocol.drops import DropReason
from protocol.metrics import IDENTITY, PREFIX, End, Metrics
from protocol.topics import EVENT

DOCKER = Path(__file__).parents[2] / "docker"
GROUPS = yaml.safe_load((DOCKER / "prometheus/alerts.yaml").read_text())["groups"]
ALERTS = [rule for group in GROUPS for rule in group["rules"]]
BOARD = json.loads((DOCKER / "grafana/ponderpounce.json").read_text())
QUERIES = [rule["expr"] for rule in ALERTS] + [t["expr"] for panel in BOARD["panels"] for t in panel["targets"]]
QUERIES += [variable["definition"] for variable in BOARD["templating"]["list"] if "definition" in variable]
DAEMONS: dict[str, type[Any]] = {"clock": ClockOptions, "ponder": PonderOptions, "pounce": PounceOptions}
PROMETHEUS_ITS_OWN = {"up"}
PROMTOOL = shutil.which("promtool")


def series_of(query: str) -> list[tuple[str, dict[str, str]]]:
    """Series that a query names, each with the label values it asks for: ("a_total", {"level": "hold|stopped"})."""
    named = re.findall(r"\b((?:ponderpounce|process)_\w+|up(?=\{))(?:\{([^}]*)\})?", query)
    return [(name, dict(re.findall(r'(\w+)!?=~?"([^"]*)"', labels))) for name, labels in named]


@pytest.fixture(scope="module")
def printed(new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo]) -> dict[str, set[str]]:
    """Every series that the three daemons print in an episode, with its labels."""
    rig, metrics = new_rig(), Metrics()
    health = m.Health(state=m.ServingState.READY, infer_p50_ns=1, infer_p99_ns=1)
    for proc in DAEMONS:
        metrics.watch(End(link=rig.links[proc], health=lambda: health, silent_ns=lambda: 0))
    info = episode_info(schedules.paper())
    timid = replace(info.robot, max_step=info.robot.max_step / 1000)  # so that ticks are limited
    rig.run(replace(info, robot=timid), 40)
    rig.links["clock"].publish(EVENT, m.Event(severity=m.Severity.INFO, name="a", text="b"), at_ns=0)
    families = text_string_to_metric_families(generate_latest(metrics).decode())
    return {sample.name: set(sample.labels) for family in families for sample in family.samples}


@pytest.mark.parametrize("query", QUERIES)
def test_every_series_of_an_alert_or_panel_is_printed(query: str, printed: dict[str, set[str]]) -> None:
    assert series_of(query)
    ours = [(name, labels) for name, labels in series_of(query) if name not in PROMETHEUS_ITS_OWN]
    for name, labels in ours:
        assert labels.keys() - {"job"} <= printed[name]
    grouped = {label for labels in re.findall(r"\b(?:by|on) \(([^)]*)\)", query) for label in labels.split(", ")}
    assert grouped <= {label for name, _ in ours for label in printed[name]}


def test_the_documented_series_are_the_printed_ones(printed: dict[str, set[str]]) -> None:
    page = (DOCKER.parent / "docs/operations.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(ponderpounce_\w+)` \|([^|]*)\|", page, re.MULTILINE)
    documented = {name: set(re.findall(r"`(\w+)`", labels)) | set(IDENTITY) for name, labels in rows}
    actual: dict[str, set[str]] = {}
    for name, labels in printed.items():
        if name.startswith(PREFIX):
            actual.setdefault(re.sub(r"_(bucket|count|sum)$", "", name), set()).update(labels)
    assert documented == actual


def test_values_that_alerts_ask_for_exist() -> None:
    rooms = ("clock", "ponder_server", "pounce_server", "model_server", "sim_client")
    sources = "\n".join(path.read_text() for room in rooms for path in (DOCKER.parent / room).rglob("*.py"))
    sources = re.sub(r'f"\{change\.proc\}(\w+)"', r'"ponder\1" "pounce\1"', sources)
    known: dict[str, Callable[[str], bool]] = {
        "level": lambda value: value.upper() in m.Level.__members__,
        "reason": lambda value: value in set(DropReason),
        "name": lambda value: f'"{value}"' in sources,
        "proc": lambda value: value in DAEMONS,
        "quantile": lambda value: value in ("0.5", "0.99"),
        "job": lambda value: value == "ponderpounce",
    }
    asked = {pair for query in QUERIES for _, labels in series_of(query) for pair in labels.items()}
    values = {(label, each) for label, value in asked if value != "$robot" for each in value.split("|")}
    unknown = {(label, value) for label, value in values if not known[label](value)}
    assert not unknown


def test_alerts_say_who_is_woken_and_what_happened() -> None:
    assert {rule["labels"]["severity"] for rule in ALERTS} == {"page", "ticket"}
    assert all(len(rule["annotations"]["summary"]) > 20 for rule in ALERTS)
    assert len({rule["alert"] for rule in ALERTS}) == len(ALERTS)


@pytest.mark.skipif(PROMTOOL is None, reason="promtool is not installed")
@pytest.mark.parametrize("words", [("rules", "alerts.yaml"), ("config", "prometheus.yaml")], ids=lambda words: words[0])
def test_promtool_understands_the_files(words: tuple[str, str]) -> None:
    what, name = words
    command = [str(PROMTOOL), "check", what, str(DOCKER / "prometheus" / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.peers
def test_grafana_s_own_types_read_the_board_and_lose_nothing_that_is_drawn() -> None:
    dashboard = pytest.importorskip("grafana_foundation_sdk.models.dashboard")
    read = dashboard.Dashboard.from_json(BOARD)
    assert read.title == BOARD["title"]
    panels = zip(read.panels, BOARD["panels"], strict=True)
    assert all(one.title == other["title"] and len(one.targets) == len(other["targets"]) for one, other in panels)
    assert [variable.name for variable in read.templating.list_val] == [v["name"] for v in BOARD["templating"]["list"]]


def test_the_board_s_panels_do_not_overlap() -> None:
    cells = [
        (x, y)
        for at in (panel["gridPos"] for panel in BOARD["panels"])
        for x in range(at["x"], at["x"] + at["w"])
        for y in range(at["y"], at["y"] + at["h"])
    ]
    assert len(set(cells)) == len(cells)
    assert max(x for x, _ in cells) < 24
    assert len({panel["id"] for panel in BOARD["panels"]}) == len(BOARD["panels"])


# -- systemd


def unit(name: str) -> Any:
    """The unit's [Service] section."""
    parser = configparser.RawConfigParser()
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(DOCKER / "systemd" / f"{name}-serve.service")
    return parser["Service"]


def options_of(name: str) -> Any:
    program, *arguments = shlex.split(unit(name)["ExecStart"])
    assert Path(program).name == f"{name}-serve"
    return tyro.cli(DAEMONS[name], args=[argument for argument in arguments if argument != "$OPTIONS"])


def test_units_of_one_host_find_each_other_in_their_own_folder() -> None:
    listened = {name: options_of(name).link.listen for name in DAEMONS}
    assert set(options_of("clock").link.connect) == {*listened["ponder"], *listened["pounce"]}
    for name in DAEMONS:
        folder, service = f"/run/{unit(name)['RuntimeDirectory']}", unit(name)
        assert listened[name] == (f"unixsock-stream/{folder}/{name}.sock",)
        assert (service["RuntimeDirectoryMode"], service["RuntimeDirectoryPreserve"]) == ("0700", "yes")


@pytest.mark.parametrize("name", DAEMONS)
def test_a_unit_is_no_root_writes_nowhere_drains_and_comes_back(name: str) -> None:
    service = unit(name)
    assert service["User"] == "ponderpounce"
    assert (service["ProtectSystem"], service["NoNewPrivileges"]) == ("strict", "yes")
    assert (service["KillSignal"], service["Restart"]) == ("SIGUSR1", "always")
    assert service["RestartPreventExitStatus"] == "2"
    assert int(service["WatchdogSec"]) > 2 * 10  # twice the silence from which /healthz calls a server hung


def targets() -> Iterator[str]:
    (job,) = yaml.safe_load((DOCKER / "prometheus/prometheus.yaml").read_text())["scrape_configs"]
    assert job["job_name"] == "ponderpounce"
    for static in job["static_configs"]:
        yield from static["targets"]


def test_prometheus_scrapes_where_units_and_containers_print() -> None:
    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    in_compose = [tyro.cli(DAEMONS[name], args=services[name]["command"]).operations.metrics for name in DAEMONS]
    assert list(targets()) == [options_of(name).operations.metrics for name in DAEMONS] == in_compose
