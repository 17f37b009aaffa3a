"""A process's own log lines: one per fact, for people or as JSON, on standard error or in files of limited size."""

from __future__ import annotations

import json
import logging
import re
import sys
import traceback
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path

from protocol.errors import TransportError
from protocol.options import OperationsOptions

KEPT_FILES = 4  # beside the one that is written
MB = 1_000_000
_FORMAT = "%(asctime)s %(levelname)s %(name)s %(message)s"
_PLACE = re.compile(r"(?:(\w+)=)?%(?!%)[-#0 +]*[\d*]*(?:\.\d+)?[a-zA-Z]")
"""A place of a logging template, with the key before it: ``infer_p50_ms=%.1f``."""


def set_up_logging(level: str = "INFO", options: OperationsOptions | None = None) -> None:
    """Logs as ``options`` say; None: to standard error, for people. Raises TransportError as ``handler_of``."""
    logging.basicConfig(level=level, handlers=[handler_of(options or OperationsOptions())])


def handler_of(options: OperationsOptions) -> logging.Handler:
    """Returns where log lines go, and in which form.

    Raises:
        TransportError: the log file cannot be written, or its limit is too small.
    """
    handler = logging.StreamHandler(sys.stderr) if options.log_file is None else _file(options.log_file, options.log_mb)
    handler.setFormatter(JsonFormatter() if options.log_json else logging.Formatter(_FORMAT))
    return handler


def _file(path: Path, limit_mb: int) -> RotatingFileHandler:
    if limit_mb < KEPT_FILES + 1:
        raise TransportError(f"--log-mb {limit_mb}: expected at least {KEPT_FILES + 1}, one for each file")
    max_bytes = limit_mb * MB // (KEPT_FILES + 1)
    try:
        return RotatingFileHandler(path, maxBytes=max_bytes, backupCount=KEPT_FILES, encoding="utf-8")
    except OSError as error:
        raise TransportError(f"--log-file {path}: {error.strerror}; name a file that this user may write") from None


class JsonFormatter(logging.Formatter):
    """One JSON object a line: ``at``, ``level``, ``logger``, ``message``, and each ``key=value`` of the message.

    Values keep their type: ``log.info("ready infer_p50_ms=%.1f", 78.12)`` gives ``"infer_p50_ms": 78.12``.
    """

    def format(self, record: logging.LogRecord) -> str:
        fact: dict[str, object] = dict(_values(record))
        fact |= {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            fact["traceback"] = "".join(traceback.format_exception(*record.exc_info))
        return json.dumps(fact, default=str)


def _values(record: logging.LogRecord) -> list[tuple[str, object]]:
    args = record.args if isinstance(record.args, tuple) else ()
    places = _PLACE.findall(str(record.msg).replace("%%", ""))
    return [(key, value) for key, value in zip(places, args, strict=False) if key]
