"""Commands: options as frozen dataclasses, with docstrings as ``--help``; and one sentence for what a person can mend.

A switch that is off by default has ``--x``; one that is on (`On`) has only ``--no-x``: its docstring says "Do not ...".
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import getpass
import io
import math
import os
import pwd
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from protocol import disk, extras
from protocol.errors import CommandError
from protocol.options import LinkOptions

Options = TypeVar("Options")
Main = Callable[..., int]
On = Annotated[bool, tyro.conf.arg(help_behavior_hint="(default: not given)")]
"""A switch that is on by default. Only its ``--no-x`` is shown, of which "(default: True)" would tell the opposite."""

_GONE = frozenset({"--link.no-shared-memory"})
"""Options that scripts may still name, and that ask for what is done anyway."""
_MOST = 1_000_000_000  # in seconds more than anybody waits, and in all units few enough to be counted in ns
_UNITS = ("_s", "_ms", "_hz", "_px", "_mb", "_ticks")
REFUSED, INTERRUPTED, READER_LEFT = 2, 130, 141  # the latter two as a shell counts SIGINT and SIGPIPE

_M_ARENA_MAX, _NUM_ARENAS = -8, 2  # glibc's malloc.h


def command(prog: str) -> Callable[[Main], Main]:
    """Decorates the ``main(argv)`` of a command; ``prog`` is its name, unless it is called with another.

    Whatever a person can mend (CommandError, OSError, ValueError, a package of an extra that is not installed) becomes
    one sentence on stderr and exit code 2. Other exceptions are defects of ours and keep their traceback. A reader that
    leaves (``| head``) ends a command silently. SIGTERM (docker stop, systemd) ends it as Ctrl-C does: logs are closed.
    """

    def decorate(main: Main) -> Main:
        @functools.wraps(main)
        def run(argv: Sequence[str] | None = None, **options: Any) -> int:
            name = options.get("prog", prog)
            _settle_in()
            try:
                try:
                    return main(argv, **options)
                finally:
                    sys.stdout.flush()
            except BrokenPipeError:
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python flushes once more when it exits
                return READER_LEFT
            except KeyboardInterrupt:
                sys.stderr.write(f"{name}: interrupted\n")
                return INTERRUPTED
            except ModuleNotFoundError as error:
                if (way_out := extras.way_out(error)) is None:
                    raise
                sys.stderr.write(f"{name}: {way_out}\n")
                return REFUSED
            except (CommandError, OSError, ValueError) as error:
                sys.stderr.write(f"{name}: {sentence(error)}\n")
                return REFUSED

        return run

    return decorate


def sentence(error: BaseException) -> str:
    """An error for a person: an operating system's begins with the file's name and has no number."""
    if not isinstance(error, OSError) or error.errno is None:
        return str(error)
    where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
    way_out = "; make room and start again" if error.errno in disk.FULL else ""
    return f"{where}{error.strerror}{way_out}"


def _interrupted(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def _settle_in() -> None:
    """Makes up for what a container may lack: a name and a home for its user, and an encoding that has every letter."""
    _share_arenas()
    is_ours = (
        threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    )
    if is_ours:
        signal.signal(signal.SIGTERM, _interrupted)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        getpass.getuser()
    except (KeyError, OSError):
        os.environ["USER"] = f"uid-{os.getuid()}"
    try:
        os.environ.setdefault("HOME", pwd.getpwuid(os.getuid()).pw_dir)
    except KeyError:
        os.environ["HOME"] = tempfile.gettempdir()


def _share_arenas() -> None:
    """Lets threads share two of glibc's heaps.

    By default each of the bus's and the renderer's threads may have its own, whose freed blocks serve no other:
    a server grew by 2 MB with every robot that came and went, a simulator by 2 MB an episode.
    Other C libraries have none.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, _NUM_ARENAS)


def parse(kind: type[Options], argv: Sequence[str] | None, *, prog: str) -> Options:
    """Returns the options in ``argv`` (None: the process's). Exits the process after ``--help`` or an error.

    Raises:
        ValueError: a number is not finite; a quantity with a unit is negative or above 1e9; a seed is negative.
    """
    argv = [argument for argument in (sys.argv[1:] if argv is None else argv) if argument not in _GONE]
    options = tyro.cli(kind, args=argv, prog=prog, description=kind.__doc__, config=(tyro.conf.FlagCreatePairsOff,))
    _check_numbers(options)
    return options


def _check_numbers(options: Any) -> None:
    for field in dataclasses.fields(options):
        value, name = getattr(options, field.name), field.name
        if dataclasses.is_dataclass(value):
            _check_numbers(value)
        elif isinstance(value, (int, float)):
            option = f"--{name.replace('_', '-')}"
            if not abs(value) < math.inf:
                raise ValueError(f"{option}: expected a finite number, came {value}")
            if name.endswith(_UNITS) and not 0 <= value <= _MOST:
                raise ValueError(f"{option}: expected a number from 0 to {_MOST}, came {value}")
            if name == "seed" and value < 0:
                raise ValueError(f"{option}: expected a number of at least 0, came {value}")


def flat(options: Any) -> dict[str, Any]:
    """Options as JSON values by their names on the command line, without groups."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, LinkOptions):
            found |= flat(value)
        else:
            found[field.name] = _plain(value)
    return found


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return flat(value)
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
