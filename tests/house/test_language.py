"""A docstring's sentences have subjects: none begins with a bare "Of ..." or "Who ..."."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = (
    "dual_system", "ponder_server", "pounce_server", "clock", "protocol", "model_server", "sim_client", "benchmarks"
)  # fmt: skip
BARE = ("Of ", "Who ")
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
_SENTENCE_START = re.compile(r"(?<=\. )|\n\s*\n\s*")


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every docstring of a module, class or function, and of every attribute docstring."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        for before, statement in zip((None, *body), body, strict=False):
            is_first = before is None and isinstance(node, _DOCUMENTED)
            if not (is_first or isinstance(before, ast.Assign | ast.AnnAssign)):
                continue
            match statement:
                case ast.Expr(value=ast.Constant(value=str() as text)):
                    yield statement.lineno, text


def bare_sentences(source: str) -> list[tuple[int, str]]:
    """Line of the docstring, and sentence, for every sentence in ``source``'s docstrings that has no subject."""
    if not any(word in source for word in BARE):
        return []  # to parse all takes seconds
    return [
        (line, " ".join(sentence.split()))
        for line, text in docstrings(source)
        for sentence in _SENTENCE_START.split(re.sub(r"(?<=\.)\n *(?=\S)", " ", text))
        if sentence.lstrip().startswith(BARE)
    ]


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('"""Of a module."""', [(1, "Of a module.")]),
        ('class A:\n    """Who acts."""', [(2, "Who acts.")]),
        ('def f():\n    """\n    Of a function.\n    """', [(2, "Of a function.")]),
        ('async def f():\n    """Runs. Of a later sentence."""', [(2, "Of a later sentence.")]),
        ('def f():\n    """Runs.\n    Who runs after a line break.\n    """', [(2, "Who runs after a line break.")]),
        ('def f():\n    """Returns x:\n\n    Of a paragraph.\n    """', [(2, "Of a paragraph.")]),
        ('X = 1\n"""Of an attribute."""', [(2, "Of an attribute.")]),
        ('class A:\n    x: int\n    """Of a field."""\n    y: int = 0\n    """Who."""', [(3, "Of a field.")]),
        ('if True:\n    X = 1\n    """Of a branch."""', [(3, "Of a branch.")]),
        ('"""The size of a row. Whole rows count. Often none does."""', []),
        ('"""Values; Of no sentence start, nor (Who)."""', []),
        ('x = f("Of a string.")\ny = "Who is no docstring."', []),
    ],
)
def test_a_sentence_without_a_subject_is_found(source: str, found: list[tuple[int, str]]) -> None:
    assert bare_sentences(source) == found


@pytest.mark.parametrize("room", ROOMS)
def test_every_sentence_of_a_docstring_has_a_subject(room: str) -> None:
    paths = [path for path in sorted((ROOT / room).rglob("*.py")) if not path.name.endswith("_pb2.py")]
    assert paths, f"no {room}/ here"
    faults = [
        f"{path.relative_to(ROOT)}:{line}: {sentence}"
        for path in paths
        for line, sentence in bare_sentences(path.read_text(encoding="utf-8"))
    ]
    assert not faults, "\n".join(faults)
