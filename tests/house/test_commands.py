"""Commands with verbs: each verb has a module with a main, --help lists them all, and a mistyped one is refused."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dual_system import commands
from dual_system.commands import COMMANDS, REFUSED

ENTRIES = {
    "sim-client": commands.sim_client,
    "pp-eval": commands.evaluate,
    "pp-train": commands.train,
    "pp-gateway": commands.gateway,
    "pp-collect": commands.collect,
    "pp-export": commands.export,
    "pp-parity": commands.parity,
    "pp-diagnose": commands.diagnose,
    "pp-replay": commands.replay,
}
VERBS = [(name, verb) for name, command in COMMANDS.items() for verb in command.verbs]

every_command = pytest.mark.parametrize("name", COMMANDS)
every_verb = pytest.mark.parametrize(("name", "verb"), VERBS)


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[str], dict[str, Any]]]:
    """The mains that were called, in place of being run; each returns 7."""
    calls: list[tuple[str, list[str], dict[str, Any]]] = []

    def pretended(module: str) -> SimpleNamespace:
        def main(argv: list[str], **options: Any) -> int:
            calls.append((module, argv, options))
            return 7

        return SimpleNamespace(main=main)

    monkeypatch.setattr(commands, "importlib", SimpleNamespace(import_module=pretended))
    return calls


def parameters_of_main(module: str) -> list[str]:
    """Read from the source: a module of training or serving needs packages that this computer may lack."""
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name == "main":
            return [argument.arg for argument in node.args.args]
    raise AssertionError(f"{module} has no main")


def test_every_installed_command_tells_what_a_person_can_mend(root: Path) -> None:
    """All are decorated with `protocol.command_line.command`, the verbs' mains as well."""
    scripts = tomllib.loads((root / "pyproject.toml").read_text())["project"]["scripts"]
    entries = {name: tuple(target.split(":")) for name, target in scripts.items()}
    entries |= {f"{name} {verb}": (COMMANDS[name].verbs[verb].module, "main") for name, verb in VERBS}
    entries |= {f"{name} itself": (command.default, "main") for name, command in COMMANDS.items()}
    bare = [name for name, (module, function) in entries.items() if not is_command(root, module, function)]
    assert not bare


def is_command(root: Path, module: str, function: str) -> bool:
    path = root / f"{module.replace('.', '/')}.py"
    nodes = ast.parse(path.read_text(encoding="utf-8")).body
    (found,) = (node for node in nodes if isinstance(node, ast.FunctionDef) and node.name == function)
    return any(isinstance(each, ast.Call) and ast.unparse(each.func) == "command" for each in found.decorator_list)


def test_each_command_has_an_entry() -> None:
    assert ENTRIES.keys() == COMMANDS.keys()


@every_command
def test_a_command_s_default_module_has_a_main(name: str) -> None:
    assert parameters_of_main(COMMANDS[name].default)[0] == "argv"


@every_verb
def test_a_verb_s_module_has_a_main_that_takes_its_name(name: str, verb: str) -> None:
    assert parameters_of_main(COMMANDS[name].verbs[verb].module) == ["argv", "prog"]


@every_verb
def test_a_verb_s_module_is_given_the_rest(called: list[Any], name: str, verb: str) -> None:
    assert ENTRIES[name]([verb, "a", "--b"]) == 7
    assert called == [(COMMANDS[name].verbs[verb].module, ["a", "--b"], {"prog": f"{name} {verb}"})]


@every_command
@pytest.mark.parametrize("argv", [[], ["--out", "x"], ["a.mcap", "b.mcap"], ["logs/a"]])
def test_without_a_verb_the_default_module_is_given_everything(called: list[Any], name: str, argv: list[str]) -> None:
    assert ENTRIES[name](argv) == 7
    assert called == [(COMMANDS[name].default, argv, {})]


def test_a_file_that_is_there_is_no_verb(called: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("episode").touch()
    assert commands.export(["episode"]) == 7
    assert called == [(COMMANDS["pp-export"].default, ["episode"], {})]


@every_command
@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_help_lists_every_verb(called: list[Any], name: str, flag: str, capsys: pytest.CaptureFixture[str]) -> None:
    ENTRIES[name]([flag])
    lines = capsys.readouterr().out.splitlines()
    for verb, of in COMMANDS[name].verbs.items():
        assert any(line.startswith(f"  {name} {verb} ") and line.endswith(f" {of.summary}") for line in lines)


@pytest.mark.parametrize(
    ("name", "typed", "meant"),
    [
        ("pp-collect", "corect", "correct"),
        ("pp-collect", "pair", "pairs"),
        ("pp-diagnose", "Counterfactual", "counterfactual"),
    ],
)
def test_a_mistyped_verb_is_refused_with_the_nearest(
    called: list[Any], name: str, typed: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ENTRIES[name]([typed, "--out", "x"]) == REFUSED == 2
    assert f"Did you mean {meant!r}?" in capsys.readouterr().err
    assert not called


def test_a_word_like_no_verb_is_refused_with_all(called: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.collect(["zzz"]) == REFUSED
    assert (
        capsys.readouterr().err
        == "pp-collect: 'zzz' is neither a verb nor a file. Verbs: correct, import, bags, card, kitchen, pairs.\n"
    )
    assert not called


@pytest.mark.parametrize(
    ("call", "unneeded"),
    [
        ("collect(['--help'])", "torch"),
        ("collect(['pairs', '--help'])", "torch"),
        pytest.param("export(['hf', '--help'])", "mujoco", marks=pytest.mark.acceptance),  # contracts say it, too
    ],
)
def test_a_verb_imports_only_what_it_needs(call: str, unneeded: str) -> None:
    code = (
        "import atexit, sys\n"
        "from dual_system import commands\n"
        f"atexit.register(lambda: sys.stderr.write(str({unneeded!r} in sys.modules)))\n"
        f"commands.{call}\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "False"
