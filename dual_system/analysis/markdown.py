"""Tables and intervals as text."""

from __future__ import annotations

from collections.abc import Sequence

from dual_system.analysis.statistics import Interval


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a table; all columns but the first are right-aligned."""
    lines = [head, ["---", *["--:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)


def percent(interval: Interval, sign: str = "") -> str:
    """Returns an interval of fractions in per cent."""
    value, low, high = (100 * part + 0.0 for part in (interval.value, interval.low, interval.high))
    return f"{value:{sign}.2f} [{low:{sign}.1f}, {high:{sign}.1f}]"
