"""Reads a log: every message of an episode, as the dataclass that was sent.

python examples/03_read_a_log.py LOG.mcap
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

from clock.check import disagreements
from protocol.mcap_log import read_log, read_pictures


def main(path: Path) -> None:
    record = read_log(path)
    info, schedule = record.info, record.info.schedule
    print(f"task         {info.task}, seed {info.seed}: {info.instruction!r}")
    print(f"schedule     {schedule.mode.name.lower()}, {schedule.control_hz} Hz, {schedule.horizon} rows per chunk")
    print(f"messages     {len(record.queries)} queries, {len(record.stamps)} stamps, {len(record.chunks)} chunks")

    levels = Counter(tick.level.name.lower() for tick in record.ticks)
    print("ticks        " + ", ".join(f"{count} {level}" for level, count in levels.items()))
    for stamp in record.stamps:
        looked_ms, ready_ms = stamp.source_ns / 1e6, stamp.ready_ns / 1e6
        print(f"  {stamp.kind.name.lower():<9} {stamp.index}: about {looked_ms:.0f} ms, usable from {ready_ms:.0f} ms")

    pictures = Counter(f"{picture.camera} ({picture.format})" for picture in read_pictures(path))
    print("pictures     " + ", ".join(f"{count} from {camera}" for camera, count in pictures.items()))

    # What pp-check does: every reference, age, row and deadline again, from these messages and the pure rules.
    wrong = next(disagreements(record), None)
    print(f"check        {'agrees with itself' if wrong is None else wrong}")
    if record.result is not None:
        print(f"result       {record.result.status.name}: {record.result.reason}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
