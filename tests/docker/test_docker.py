"""The container files against what they speak of: scripts, options, ports, folders, extras, pins. Nothing is built."""

from __future__ import annotations

import ast
import functools
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import tyro
import yaml

from clock.config import ClockOptions
from ponder_server.config import PonderOptions
from pounce_server.config import PounceOptions
from protocol.sockets import endpoint
from protocol.topics import SHADOW_OF
from protocol.zenoh_bus import is_loopback
from sim_client.config import SimOptions
from sim_client.doctor_probes import GL_PACKAGES, ROBOSUITE, VULKAN_PACKAGE

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())
GPU: dict[str, Any] = yaml.safe_load((ROOT / "docker" / "compose.gpu.yaml").read_text())
ROOMS = ("protocol", "clock", "model_server", "dual_system", "ponder_server", "pounce_server", "sim_client")


class Role(NamedTuple):
    """What an image is for."""

    script: str
    options: type
    extras: frozenset[str]
    room: str


ROLES = {
    "clock": Role("clock-serve", ClockOptions, frozenset(), "clock"),
    "ponder": Role("ponder-serve", PonderOptions, frozenset({"serve"}), "ponder_server"),
    "pounce": Role("pounce-serve", PounceOptions, frozenset({"serve"}), "pounce_server"),
    "sim": Role("sim-client", SimOptions, frozenset({"sim", "replay"}), "sim_client"),
}
DEFAULTS = {"clock": ClockOptions().link, "ponder": PonderOptions().link, "pounce": PounceOptions().link}


def arguments_of(compose: dict[str, Any], name: str) -> Any:
    """The options that a service's command gives its program."""
    return tyro.cli(ROLES[name].options, args=[str(a) for a in compose["services"][name]["command"]])


def link_of(compose: dict[str, Any], name: str) -> Any:
    return arguments_of(compose, name).link


def instructions(name: str) -> list[tuple[str, str]]:
    """The Dockerfile's instructions, continued lines joined: ("COPY", "clock clock")."""
    text = (ROOT / "docker" / f"{name}.Dockerfile").read_text()
    text = re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    lines = [line.split(None, 1) for line in text.splitlines() if line.strip()]
    return [(verb, " ".join(rest.split())) for verb, rest in lines]


def copied(name: str) -> set[str]:
    return {source for verb, rest in instructions(name) if verb == "COPY" for source in rest.split()[:-1]}


def commands(name: str) -> str:
    return "\n".join(rest for verb, rest in instructions(name) if verb == "RUN")


def test_every_role_has_an_image_and_a_service() -> None:
    images = {path.name.removesuffix(".Dockerfile") for path in (ROOT / "docker").glob("*.Dockerfile")}
    assert images == COMPOSE["services"].keys() == ROLES.keys()
    assert GPU["services"].keys() <= COMPOSE["services"].keys()


@pytest.mark.parametrize("name", ROLES)
def test_a_service_is_built_from_its_file_with_the_repository_as_context(name: str) -> None:
    build = COMPOSE["services"][name]["build"]
    assert (ROOT / "docker" / build["context"]).resolve() == ROOT
    assert build["dockerfile"] == f"docker/{name}.Dockerfile"


@pytest.mark.parametrize("name", ROLES)
def test_everything_copied_exists_and_reaches_the_builder(name: str) -> None:
    ignore = (ROOT / "docker" / f"{name}.Dockerfile.dockerignore").read_text().splitlines()
    rules = [line for line in ignore if line and not line.startswith("#")]
    assert rules[0] == "*"
    assert {rule[1:] for rule in rules if rule.startswith("!")} == copied(name)
    assert [source for source in copied(name) if not (ROOT / source).exists()] == []


@functools.cache
def imported_by(room: str) -> set[str]:
    """Rooms that a room's files import."""
    found = set()
    for path in (ROOT / room).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found |= {m.partition(".")[0] for m in modules} & set(ROOMS)
    return found


@pytest.mark.parametrize("name", ROLES)
def test_an_image_holds_every_room_that_its_own_room_needs_and_no_other(name: str) -> None:
    needed, todo = set(), {ROLES[name].room}
    while todo:
        room = todo.pop()
        needed.add(room)
        todo |= imported_by(room) - needed
    assert copied(name) & set(ROOMS) == needed


@pytest.mark.parametrize("name", ROLES)
def test_the_entry_point_is_a_console_script_in_exec_form(name: str) -> None:
    """In shell form a shell would be process 1 and keep SIGTERM to itself."""
    (entry,) = [rest for verb, rest in instructions(name) if verb == "ENTRYPOINT"]
    assert ast.literal_eval(entry) == [ROLES[name].script]
    assert ROLES[name].script in PROJECT["scripts"]


@pytest.mark.parametrize("name", ROLES)
def test_an_image_installs_its_own_extras_at_the_pinned_versions(name: str) -> None:
    (extras,) = re.findall(r'pip install --no-cache-dir -c requirements\.txt "?\.(?:\[([\w,]+)\])?"?', commands(name))
    installed = frozenset(filter(None, extras.split(",")))
    assert installed == ROLES[name].extras
    assert installed <= PROJECT["optional-dependencies"].keys()


@pytest.mark.parametrize("name", ROLES)
def test_torch_is_where_models_are_and_its_pin_is_the_makefile_s(name: str) -> None:
    pins = re.findall(r"\btorch==[\w.]+", " ".join(rest for _, rest in instructions(name)))
    wanted = re.findall(r"\btorch==[\w.]+", (ROOT / "Makefile").read_text())
    assert pins == (wanted[:1] if "serve" in ROLES[name].extras else [])


def test_the_simulator_s_image_holds_what_the_doctor_looks_for() -> None:
    assert {*GL_PACKAGES["egl"], VULKAN_PACKAGE} <= set(commands("sim").split())
    assert f"--no-deps robosuite=={ROBOSUITE}" in commands("sim")
    assert f"robosuite=={ROBOSUITE}" in (ROOT / "Makefile").read_text()


@pytest.mark.parametrize("name", ROLES)
def test_nothing_runs_as_root(name: str) -> None:
    assert [rest for verb, rest in instructions(name) if verb == "USER"] == ["ponderpounce"]


@pytest.mark.parametrize("name", [name for name in ROLES if name != "clock"])
def test_all_share_the_clock_s_loopback(name: str) -> None:
    service = COMPOSE["services"][name]
    assert service["network_mode"] == "service:clock"
    assert "ports" not in service


@pytest.mark.parametrize("link", [lambda name: ROLES[name].options().link, lambda name: link_of(COMPOSE, name)])
def test_the_endpoints_are_local_and_find_each_other(link: Callable[[str], Any]) -> None:
    listened = [each for name in DEFAULTS for each in link(name).listen]
    assert all(map(is_loopback, listened))
    assert len(set(listened)) == len(DEFAULTS)
    shadows = {endpoint(name) for name in SHADOW_OF}  # they may come later
    assert set(link("clock").connect) - shadows == {*link("ponder").listen, *link("pounce").listen}
    assert set(link("sim").connect) - shadows == set(listened)


@pytest.mark.parametrize("name", GPU["services"])
def test_with_a_gpu_a_server_listens_at_the_same_place(name: str) -> None:
    assert link_of(GPU, name).listen == link_of(COMPOSE, name).listen


@pytest.mark.parametrize("name", DEFAULTS)
def test_a_health_check_asks_its_own_process_where_it_answers(name: str) -> None:
    check = COMPOSE["services"][name]["healthcheck"]
    kind, python, dash_c, code = check["test"]
    assert (kind, python, dash_c) == ("CMD", "python", "-c")
    path = "healthz" if name == "clock" else "readyz"  # the clock would wait for the others
    for compose in (COMPOSE, GPU):
        if name in compose["services"]:
            assert f"http://{arguments_of(compose, name).operations.metrics}/{path}'" in code
    limit_s = int(re.findall(r"timeout=(\d+)", code)[0])
    assert limit_s < int(check["timeout"].removesuffix("s"))


@pytest.mark.parametrize("name", ROLES)
def test_a_container_writes_only_where_it_must(name: str) -> None:
    service = COMPOSE["services"][name]
    assert (service["read_only"], service["cap_drop"], service["tmpfs"]) == (True, ["ALL"], ["/tmp"])
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["logging"]["options"] == {"max-size": "20m", "max-file": "5"}


@pytest.mark.parametrize("name", DEFAULTS)
def test_stopping_a_daemon_drains_it(name: str) -> None:
    service = COMPOSE["services"][name]
    assert (service["stop_signal"], service["stop_grace_period"]) == ("SIGUSR1", "5m")


@pytest.mark.parametrize("compose", [COMPOSE, GPU], ids=["compose", "gpu"])
@pytest.mark.parametrize("name", ROLES)
def test_a_command_is_understood_by_the_program(compose: dict[str, Any], name: str) -> None:
    arguments = compose["services"].get(name, {}).get("command", [])
    assert isinstance(tyro.cli(ROLES[name].options, args=[str(a) for a in arguments]), ROLES[name].options)


def test_the_simulator_uses_the_clock_service_that_runs_beside_it() -> None:
    options = tyro.cli(SimOptions, args=COMPOSE["services"]["sim"]["command"])
    assert options.runs_clock_daemon
    assert not options.local
    assert [volume.partition(":")[2] for volume in COMPOSE["services"]["sim"]["volumes"]] == [str(options.out)]


def test_the_simulator_waits_for_everyone_with_a_health_check() -> None:
    waits_for = COMPOSE["services"]["sim"]["depends_on"]
    assert waits_for.keys() == {name for name, service in COMPOSE["services"].items() if "healthcheck" in service}
    assert all(condition == {"condition": "service_healthy"} for condition in waits_for.values())
