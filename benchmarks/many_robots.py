"""How old is what robots play when 1, 2, 4, 8, 16 of them share one PONDER and one POUNCE?

Each row: servers of their own, one ``pp-gateway --mode realtime`` with as many seats as clients, and clients of
openpi's wire in this process, who show two pictures ``--request-hz`` times a second. All clients play at once; what is
counted is read from their logs. "In common batches" is how servers are started; "one at a time" allows one row per
forward (``--max-batch-rows 1``), in the same turns.

The answer of POUNCE is the time from an invocation to its chunk's arrival at the clock, that of PONDER from the
observation that a query names to its cognition's arrival; the age at use is the one that POUNCE was given.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from websockets.sync.client import connect

from benchmarks.report import Report, Row, show, spread
from protocol import messages as m
from protocol.command_line import parse
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.gateway.arrays import pack, unpack
from sim_client.gateway.seats import seat_names
from sim_client.launch import Daemons, free_ports, start_local

WAYS = {"in common batches": [], "one at a time": ["--max-batch-rows", "1"]}
READY_S = 300.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ManyRobotsOptions:
    """The curve over clients."""

    clients: tuple[int, ...] = (1, 2, 4, 8, 16)
    seconds: float = 32.0
    """Length of every row; the first 5 s are not counted."""
    request_hz: float = 5.0
    checkpoints: Path | None = Path("checkpoints/small")
    """Folder with ponder and pounce. None: the tiny pair with random weights."""
    name: str = "many_robots"
    """Name of the report."""


UNCOUNTED_NS = 5_000_000_000


def main(argv: list[str] | None = None) -> int:
    options = parse(ManyRobotsOptions, argv, prog="many-robots")
    report = Report(
        name=options.name,
        question="How long do answers take, and how old is a cognition in use, when robots share one pair of servers?",
        config=options,
        warm_up="the servers' own; the first 5 s of every row are not counted.",
    )
    answers: list[Row] = []
    ages: list[Row] = []
    for count in options.clients:
        for way, arguments in WAYS.items():
            records, ended = _row(options, count, arguments)
            refused = sum("refuse" in sentence for sentence in ended)
            head: Row = {"clients": count, "served": way, "admitted": count - refused, "stopped": len(ended) - refused}
            answers.append(head | {"of": "POUNCE"} | spread(_answers(records, m.StampKind.CHUNK), "ms"))
            answers.append(head | {"of": "PONDER"} | spread(_answers(records, m.StampKind.COGNITION), "ms"))
            played = [tick for record in records for tick in record.ticks if tick.decided_ns > UNCOUNTED_NS]
            not_played = sum(tick.level not in (m.Level.PLAY, m.Level.STALE) for tick in played)
            ages.append(
                head
                | spread([age for record in records for age in _ages(record)], "ms")
                | {"ticks": len(played), "without a row": not_played}
            )
            print(answers[-2], ages[-1], sep="\n", flush=True)
    report.add_table("From a request to its answer's arrival at the clock", answers)
    report.add_table("Age of the cognition that POUNCE was given", ages)
    report.notes += [
        "Clients, gateway, a clock for each client and both servers share this machine's cores.",
        "A client that is not admitted was refused by a server, whose sentence names the numbers; one that was stopped "
        "was admitted, and its ladder ended the episode: the machine was slower than when the servers measured it.",
    ]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _row(options: ManyRobotsOptions, count: int, arguments: list[str]) -> tuple[list[EpisodeRecord], list[str]]:
    """The logs of all clients that were admitted, and the sentences with which clients were refused or stopped."""
    robot, *others = seat_names("r0", count)
    with tempfile.TemporaryDirectory(prefix="many-robots-") as folder, Daemons(Path(folder)) as daemons:
        servers = {
            proc: ["--checkpoint", str(options.checkpoints / proc)] if options.checkpoints else []
            for proc in ("ponder", "pounce")
        }
        endpoints = start_local(
            daemons,
            robot=robot,
            other_robots=others,
            with_clock=True,
            ponder=[*servers["ponder"], *(arguments if others else [])],
            pounce=[*servers["pounce"], *(arguments if others else [])],
        )
        (port,) = free_ports(1)
        log = Path(folder) / "gateway.log"
        command = [sys.executable, "-m", "sim_client.gateway", "--dialect", "openpi", "--mode", "realtime"]
        command += [
            "--seats",
            str(count),
            "--listen",
            f"127.0.0.1:{port}",
            "--out",
            folder,
            "--link.connect",
            *endpoints,
        ]
        with log.open("wb") as out:
            gateway = subprocess.Popen(command, stdout=out, stderr=out)
        try:
            daemons.await_line(["ponder", "pounce"], " ready infer", READY_S, count)
            daemons.await_line(["gateway"], " ready dialect", READY_S)
            ended: list[str] = []
            clients = [
                threading.Thread(target=_play, args=(port, index, options, ended), daemon=True)
                for index in range(count)
            ]
            for client in clients:
                client.start()
            for client in clients:
                client.join(options.seconds + READY_S)
        finally:
            gateway.terminate()
            gateway.wait(30)
        for sentence in ended:
            print(f"ended: {sentence}")
        return [read_log(path) for path in Path(folder).rglob("*.mcap")], ended


def _play(port: int, index: int, options: ManyRobotsOptions, ended: list[str]) -> None:
    pictures = np.random.default_rng(index).integers(0, 256, (2, 256, 256, 3), dtype=np.uint8)
    state = np.array([0, 0, 0, -1.5, 0, 1.8, 0, 0.04], np.float32)
    with connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None) as client:
        client.recv(READY_S)
        start_s = due_s = time.monotonic()
        while due_s < start_s + options.seconds:
            request = {
                "observation/image": pictures[0],
                "observation/wrist_image": pictures[1],
                "observation/state": state,
                "prompt": "pick the cubes that were highlighted",
            }
            client.send(pack(request, "openpi"))
            answer = client.recv(READY_S)
            if isinstance(answer, str):
                ended.append(answer.strip().splitlines()[-1])
                return
            state = np.append(unpack(answer)["actions"][0][:7], 0.04).astype(np.float32)
            due_s += 1 / options.request_hz
            time.sleep(max(0.0, due_s - time.monotonic()))


def _answers(records: list[EpisodeRecord], kind: m.StampKind) -> list[float]:
    stamps = [stamp for record in records for stamp in record.stamps if stamp.kind == kind]
    return [(each.arrived_ns - each.source_ns) / 1e6 for each in stamps if each.source_ns > UNCOUNTED_NS]


def _ages(record: EpisodeRecord) -> list[float]:
    used = [each for each in record.invocations if each.ref_query is not None and each.now_ns > UNCOUNTED_NS]
    return [each.age_ns / 1e6 for each in used]


if __name__ == "__main__":
    sys.exit(main())
