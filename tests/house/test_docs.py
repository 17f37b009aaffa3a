"""What the documents say about the code is looked up in the code: links, files, commands, options, tables."""

from __future__ import annotations

import ast
import re
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from clock import schedules
from clock.feasibility import check_feasible
from clock.reference import Ready, refer
from protocol import topics
from protocol.mcap_log import log_topic
from protocol.messages import Delivery, Level, Mode

ROOT = Path(__file__).parents[2]
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for folder in (ROOT / "docs", ROOT, ROOT / "examples")
    for path in sorted(folder.glob("*.md"))
}
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
ROOMS = ("protocol", "clock", "model_server", "dual_system", "ponder_server", "pounce_server", "sim_client")
FOLDERS = (*ROOMS, "integrations", "benchmarks", "tests", "examples", "docker", "docs")
every_page = pytest.mark.parametrize("page", PAGES)


def code(text: str) -> str:
    """Only what is set as code: fenced, indented or in backticks."""
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    indented = re.findall(r"^    .*$", text, re.MULTILINE)
    return "\n".join([*fenced, *indented, *re.findall(r"`([^`\n]+)`", text)])


@every_page
def test_links_lead_somewhere(page: str) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", PAGES[page])
    dead = [link for link in links if "://" not in link and not ((ROOT / page).parent / link).exists()]
    assert not dead


@every_page
def test_files_that_are_named_exist(page: str) -> None:
    named = re.findall(rf"(?<![\w/.-])((?:{'|'.join(FOLDERS)})/[\w./-]*\w)", code(PAGES[page]))
    gymnasium_ids = {name for name in named if re.search(r"-v\d+$", name)}
    assert [name for name in named if not (ROOT / name).exists() and name not in gymnasium_ids] == []


@cache
def _options() -> set[str]:
    """Every option that one of our programs has: fields of the dataclasses that tyro reads, and ``--no-`` of flags."""
    found = {"--help"}
    for path in (*ROOMS, "benchmarks"):
        for file in (ROOT / path).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef) and node.name.endswith(("Options", "Config")):
                    for field in node.body:
                        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                            name = field.target.id.replace("_", "-")
                            prefix = "link." if node.name == "LinkOptions" else ""
                            found |= {f"--{prefix}{name}", f"--{prefix}no-{name}"}
    client = ROOT / "integrations" / "ponderpounce_client" / "ponderpounce_client"
    program = (client / "program.py").read_text(encoding="utf-8")
    strategy = ROOT / "integrations" / "lerobot_strategy_ponderpounce" / "lerobot_strategy_ponderpounce"
    robocasa = ROOT / "integrations" / "ponderpounce_robocasa" / "ponderpounce_robocasa"
    program += "".join((folder / "__main__.py").read_text(encoding="utf-8") for folder in (strategy, robocasa))
    return found | set(re.findall(r'"(--[a-z-]+)"', program))


@every_page
def test_options_that_are_named_exist(page: str) -> None:
    strangers = re.compile(
        r"^.*\b(?:pip|docker|apt-get|git|hf download|uv run|python gr00t\S*|vla-eval run|evaluator\.py"
        r"|lerobot-rollout|lerobot-eval|lerobot_policy_ponderpounce|lerobot_strategy_ponderpounce) .*$",
        re.MULTILINE,
    )
    whole_lines = PAGES[page].replace("\\\n", " ")
    named = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", code(strangers.sub("", whole_lines))))
    assert named - _options() - {"--serve", "--nproc-per-node"} == set()  # an example's own; torchrun's


@every_page
def test_programs_that_are_named_are_installed(page: str) -> None:
    named = set(re.findall(r"(?<![\w/.-])(pp-[a-z]+|[a-z]+-serve|sim-client)(?![\w-])", code(PAGES[page])))
    assert named <= SCRIPTS.keys()


@every_page
def test_make_targets_that_are_named_exist(page: str) -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"\bmake ([a-z]+)", code(PAGES[page]))) <= targets


def _rows(page: str, width: int) -> list[list[str]]:
    """Table rows of so many cells, without the heading."""
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in PAGES[page].splitlines() if "|" in line]
    return [row for row in rows if len(row) == width and not set("".join(row)) <= set("-: ")]


def test_the_table_of_streams_is_the_code_s() -> None:
    documented = {row[1].strip("`"): (row[0].strip("`"), row[4], row[5]) for row in _rows("docs/protocol.md", 6)[1:]}
    actual = {}
    for topic in topics.STREAMS:
        key = topics.stream_key(topic, "r0", "{episode}", "{proc}").removeprefix(f"{topics.ROOT}/r0/")
        actual[key] = (topic.cls.__name__, topic.priority.name, str(topic.keep))
    assert documented == actual


def test_the_calls_are_the_code_s() -> None:
    processes = {"clock-serve", "ponder-serve", "pounce-serve", "sim-client"}
    rows = _rows("docs/protocol.md", 3)
    documented = {name for row in rows if row[0].startswith("`") and (name := row[0].strip("`").split()[0])}
    calls = {call.name for call in vars(topics).values() if isinstance(call, topics.Call)}
    assert calls == documented - processes


def test_every_rung_of_the_ladder_is_told() -> None:
    documented = [row[0].strip("`") for row in _rows("docs/clock.md", 3) if re.fullmatch("`[A-Z]+`", row[0])]
    assert documented == [level.name for level in Level if level]


def test_channels_of_the_log_are_the_code_s() -> None:
    documented = set(re.findall(r"(?<=`)/[a-z0-9_/<>]+(?=`)", PAGES["docs/logging.md"]))
    procs = ("clock", "ponder", "pounce", "sim")
    actual = {log_topic(topic, proc) for topic in topics.STREAMS for proc in procs}
    assert documented - actual <= {"/camera/<name>", "/log/<lane>"}
    assert actual - documented <= {"/clock/subgoal", "/s1/subgoal"}  # channels that stay empty


def test_the_timeline_that_is_drawn_follows_from_the_rule() -> None:
    lines = {line[:18].strip(): line[18:] for line in PAGES["docs/clock.md"].splitlines() if len(line) > 18}
    tick_ns = 50_000_000
    looks = [match.start() for match in re.finditer(r"\d", lines["PONDER  query"])]
    ready = [match.start() for match in re.finditer("╮", lines["PONDER  query"])]
    assert [match.start() for match in re.finditer("▼", lines["ready"])] == ready
    stamps = [
        Ready(query=t, source_ns=source * tick_ns, ready_ns=at * tick_ns)
        for t, (source, at) in enumerate(zip(looks, ready, strict=True))
    ]
    invoked = [match.start() for match in re.finditer("●", lines["POUNCE  invoked"])]
    given = [refer(stamps, at * tick_ns, Delivery()) for at in invoked]
    assert [f"C_{reference.query}" for reference in given] == lines["ref(j)"].split()
    assert [f"{reference.age_ns / 1e9:.1f}" for reference in given] == lines["age [s]"].split()
    assert [match.start() for match in re.finditer("├", lines["chunk in use"])] == invoked


def test_the_sentence_about_the_paper_s_schedule_is_what_the_code_says() -> None:
    paper = replace(schedules.paper(), mode=Mode.REALTIME, invoke_delay=schedules.MEASURED)
    assert check_feasible(paper, 25_000_000).sentence() in PAGES["docs/clock.md"]
    assert check_feasible(schedules.realtime(), 25_000_000).is_feasible
