"""``pp-check``: derives every decision of an episode's log again, and names the first that differs.

Causes are checked before consequences: queries, stamps, invocations, chunks, deadlines, rows, the robot's laws,
result. An "oracle" episode has no servers, so only deadlines and result are checked; one of POUNCE alone has
no queries.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from clock.check_answers import answers_of, check_invocations, check_queries, check_stamps
from clock.check_findings import Disagreement, compare
from clock.check_gaps import before_gaps
from clock.check_robot import check_robot
from clock.check_shadow import check_shadows
from clock.check_ticks import check_deadlines, check_rows
from clock.report import CLOCK_LOST_EVENT, statistics, stream_sha256
from clock.residual import DEFAULT_LOADER, RESIDUAL_EVENT, ResidualHead, load_head
from protocol import files
from protocol.command_line import command, parse, sentence
from protocol.errors import FileError
from protocol.mcap_log import EpisodeRecord, read_log, recover
from protocol.messages import Mode

AGREES, DISAGREES, UNREADABLE = 0, 1, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckConfig:
    """Derives every decision of recorded episodes again. Exit code 0: all agree, 1: one does not, 2: unreadable."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Episode logs (.mcap, or .mcap.partial of a killed process)."""
    recover: Path | None = None
    """Write the readable part of the only FILE into this finished log, and check that."""
    json: bool = False
    """Print one JSON object per file instead of a sentence."""
    residual_head: Path | None = None
    """File of the residual head that corrected the rows, if there was one."""
    residual_loader: str = DEFAULT_LOADER
    """Loader of --residual-head, as package.module:callable."""


def disagreements(record: EpisodeRecord, residual: ResidualHead | None = None) -> Iterator[Disagreement]:
    """Yields all disagreements, causes before consequences; only the first is surely a cause. Lazy: use ``next``.

    ``residual``: the head that corrected the rows, if there was one.
    """
    if record.info.policy != "oracle":
        answers = answers_of(record)
        yield from check_queries(record)
        yield from check_stamps(record, answers)
        yield from check_invocations(record, answers)
        yield from check_deadlines(record)
        yield from check_residual(record, residual)
        yield from check_rows(record, answers, residual)
        yield from check_robot(record)
    else:
        yield from check_deadlines(record)
    yield from check_shadows(record)
    yield from check_result(record)


def check_residual(record: EpisodeRecord, residual: ResidualHead | None) -> Iterator[Disagreement]:
    """Checks that ``residual`` is the head of the episode; without it no row can be derived."""
    logged = [event.attributes["digest"] for event in record.events if event.name == RESIDUAL_EVENT]
    given = "none (--residual-head)" if residual is None else residual.digest
    yield from compare("Event", 0, residual_head=(given, logged[0] if logged else "none (--residual-head)"))


def check_result(record: EpisodeRecord) -> Iterator[Disagreement]:
    """Checks the result's count and hash, if the log has a result with a hash.

    In real time the clock service may play on until it is notified of the end; the result counts only the actions that
    the robot executed. A tick's record follows its action, so a clock service that was killed in between never sends
    it: after a lost clock, one record may be missing.
    """
    result = record.result
    if result is None:
        return
    counted = record.ticks[: result.num_ticks]
    num_unsaid = int(any(event.name == CLOCK_LOST_EVENT for event in record.events))
    if record.info.schedule.mode == Mode.LOCKSTEP or len(counted) + num_unsaid < result.num_ticks:
        yield from compare("EpisodeResult", 0, num_ticks=(len(record.ticks), result.num_ticks))
    if result.stream_sha256:
        yield from compare("EpisodeResult", 0, stream_sha256=(stream_sha256(counted), result.stream_sha256))


@command("pp-check")
def main(argv: list[str] | None = None) -> int:
    config = parse(CheckConfig, argv, prog="pp-check")
    if not config.files or (config.recover is not None and len(config.files) != 1):
        sys.stderr.write("pp-check: name at least one log, and exactly one with --recover\n")
        return UNREADABLE
    head = None if config.residual_head is None else load_head(config.residual_head, config.residual_loader)
    return max(_check(path, config, head) for path in config.files)


def _check(path: Path, config: CheckConfig, head: ResidualHead | None) -> int:
    try:
        if config.recover is not None:
            recover(path, config.recover)
            path = config.recover
        record, gaps = before_gaps(read_log(path))
        if gaps and not record.ticks:
            raise FileError(f"nothing of it can be checked: {gaps}")
        with files.reading(path, "log of an episode"):  # an odd number may fail anywhere in the derivation
            found = next(disagreements(record, head), None)
            dropped = int(record.metadata.get("ponderpounce.result", {}).get("dropped_messages", "0"))
            fields: dict[str, object] = {
                "file": str(path),
                "agrees": found is None,
                "disagreement": None if found is None else _fields(found),
                "unfinished": record.why if record.recovered else None,
                "dropped_messages": dropped,
                "stream_sha256": stream_sha256(record.ticks),
                "statistics": statistics(record.ticks, record.stamps, record.invocations),
            }
    except (OSError, FileError) as error:
        if isinstance(error, OSError) and config.recover is not None and error.filename != str(path):
            raise  # it is about the file of --recover
        _tell(config, {"file": str(path), "error": sentence(error)}, f"{path}: unreadable: {sentence(error)}")
        return UNREADABLE
    text = f"{path}: " + ("agrees" if found is None else f"DISAGREES: {found}")
    text += f" ({len(record.ticks)} ticks, {len(record.queries)} queries, {len(record.invocations)} invocations)"
    if shadows := len(record.shadow_cognitions) + len(record.shadow_chunks):
        text += f"; {shadows} answers of shadows, never used"
    if record.recovered:
        text += f"; {record.why}"
    if dropped and not gaps:
        text += f"; the recorder dropped {dropped} messages, which may be all that is missing"
    _tell(config, fields, text)
    return AGREES if found is None else DISAGREES


def _fields(found: Disagreement) -> dict[str, object]:
    return {name: getattr(found, name) for name in ("message", "index", "field", "expected", "found")}


def _tell(config: CheckConfig, fields: dict[str, object], text: str) -> None:
    sys.stdout.write((json.dumps(fields) if config.json else text) + "\n")


if __name__ == "__main__":
    sys.exit(main())
