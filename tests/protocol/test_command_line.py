"""What a person can mend is one sentence and exit code 2; a defect keeps its traceback; a reader may leave."""

from __future__ import annotations

import ctypes
import errno
import getpass
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import tyro
from hypothesis import given
from hypothesis import strategies as st

from protocol.command_line import command, parse
from protocol.errors import CommandError, FileError


def that_raises(error: BaseException) -> Callable[..., int]:
    @command("pp-thing")
    def main(argv: list[str] | None = None, prog: str = "pp-thing") -> int:
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (CommandError("collect less"), "pp-thing: collect less\n"),
        (FileError("a is no log"), "pp-thing: a is no log\n"),
        (ValueError("no such recipe"), "pp-thing: no such recipe\n"),
        (OSError(errno.EACCES, "Permission denied", "a/b"), "pp-thing: a/b: Permission denied\n"),
        (OSError(errno.ENOSPC, "No space left on device", "a"),
         "pp-thing: a: No space left on device; make room and start again\n"),
        (FileExistsError("a exists: name another"), "pp-thing: a exists: name another\n"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)  # fmt: skip
def test_what_a_person_can_mend_is_a_sentence(error: Exception, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert that_raises(error)([]) == 2
    assert capsys.readouterr().err == said


@dataclass(frozen=True)
class Timing:
    patience_s: float = 1.0
    """Longest wait."""


@dataclass(frozen=True)
class Options:
    timing: tyro.conf.OmitArgPrefixes[Timing] = Timing()
    offset: float = 0.0
    """Any finite number."""
    delay_ms: int = 300
    """A quantity."""
    seed: int = 0
    """Of the scene."""


@given(
    st.tuples(st.sampled_from(["patience-s", "offset"]), st.floats())
    | st.tuples(st.sampled_from(["delay-ms", "seed"]), st.integers(-(10**30), 10**30))
)
def test_a_number_that_is_none_or_cannot_be_is_refused_by_its_option_s_name(said: tuple[str, float]) -> None:
    name, value = said
    argv = [f"--{name}={value!r}"]
    most = {"patience-s": 10**9, "delay-ms": 10**9}.get(name, math.inf)
    if math.isfinite(value) and (0 <= value <= most or name == "offset"):
        options = parse(Options, argv, prog="pp-thing")
        assert {"patience-s": options.timing.patience_s, "offset": options.offset, "delay-ms": options.delay_ms,
                "seed": options.seed}[name] == value  # fmt: skip
    else:
        with pytest.raises(ValueError, match=f"--{name}: expected a( finite)? number"):
            parse(Options, argv, prog="pp-thing")


def test_a_verb_is_called_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert that_raises(ValueError("no"))([], prog="pp-thing do") == 2
    assert capsys.readouterr().err == "pp-thing do: no\n"


def test_an_interrupted_command_ends_as_a_shell_expects(capsys: pytest.CaptureFixture[str]) -> None:
    assert that_raises(KeyboardInterrupt())([]) == 130
    assert capsys.readouterr().err == "pp-thing: interrupted\n"


def test_sigterm_ends_a_command_as_ctrl_c_does(capsys: pytest.CaptureFixture[str]) -> None:
    @command("pp-thing")
    def main(argv: list[str] | None = None) -> int:
        os.kill(os.getpid(), signal.SIGTERM)
        return 0

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    assert main([]) == 130
    assert capsys.readouterr().err == "pp-thing: interrupted\n"


@pytest.mark.parametrize("error", [TypeError("x"), KeyError("x"), AssertionError()])
def test_a_defect_is_not_hidden(error: Exception) -> None:
    with pytest.raises(type(error)):
        that_raises(error)([])


def test_a_user_without_a_name_and_a_home_gets_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that runs under a number of its own."""

    def unknown(*_: object) -> str:
        raise KeyError("getpwuid(): uid not found: 65533")

    for name in ("USER", "LOGNAME", "LNAME", "USERNAME", "HOME"):
        monkeypatch.setenv(name, "")  # so that it is restored
        monkeypatch.delenv(name)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    assert command("pp-thing")(lambda argv: 0)([]) == 0
    assert getpass.getuser() == f"uid-{os.getuid()}"
    assert os.path.isdir(os.environ["HOME"])


def test_a_reader_that_leaves_ends_it_silently_and_every_letter_can_be_said() -> None:
    code = (
        "import sys; from protocol.command_line import command\n"
        "@command('pp-thing')\n"
        "def main(argv):\n"
        "    for _ in range(100_000): print('\\u03c0 0.5')\n"
        "    return 0\n"
        "sys.exit(main([]))"
    )
    environ = os.environ | {"PYTHONIOENCODING": "ascii"}
    command_line = [sys.executable, "-c", code]
    with subprocess.Popen(command_line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == b"\\u03c0 0.5\n"
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


_MANY_THREADS = """
import ctypes, sys, threading
from protocol.command_line import command

libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.fopen.restype = ctypes.c_void_p

@command("thread-maker")
def main(argv=None):
    barrier = threading.Barrier(16)

    def allocate():
        barrier.wait()
        libc.malloc(ctypes.c_size_t(1000))
        barrier.wait()

    threads = [threading.Thread(target=allocate) for _ in range(16)]
    for thread in threads: thread.start()
    for thread in threads: thread.join()
    libc.malloc_info(0, ctypes.c_void_p(libc.fopen(b"/dev/stdout", b"w")))
    libc.fflush(None)
    return 0

sys.exit(main([]))
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_info"), reason="not glibc")
def test_threads_share_two_heaps() -> None:
    done = subprocess.run([sys.executable, "-c", _MANY_THREADS], capture_output=True, text=True, check=True)
    assert done.stdout.count("<heap nr=") <= 2, done.stdout
