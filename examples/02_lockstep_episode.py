"""A whole episode in one process and thread: tiny random models, the paper's schedule, time that waits for answers.

    python examples/02_lockstep_episode.py [OUT]

The models have the real architectures at a tiny size and were never trained: the arm moves and does not do the task.
"""

from __future__ import annotations

import sys
from pathlib import Path

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco
from clock.service import ClockService, ServiceConfig
from ponder_server import in_process as ponder
from pounce_server import in_process as pounce
from protocol.bus import LocalBus
from protocol.link import Link
from protocol.mcap_log import read_log
from sim_client.config import ScheduleOptions, SimOptions
from sim_client.suite import Suite


def main(out: Path) -> None:
    options = SimOptions(in_process=True, schedule=ScheduleOptions(max_steps=60), out=out)

    # Four participants on one bus. Each has a step function; whoever waits for an answer lets the others take steps.
    bus = LocalBus()
    bus.add_participant(ponder.build(bus, "r0", checkpoint=None))
    bus.add_participant(pounce.build(bus, "r0", checkpoint=None))
    clock = ClockService(Link(bus, robot="r0", proc="clock"), ServiceConfig(watches=False))
    bus.add_participant(clock.step)
    suite = Suite(options, Link(bus, robot="r0", proc="sim"), clock, dead_server=lambda: "")

    (episode,) = suite.run()["episodes"]
    log = out / episode["mcap"]
    for invocation in read_log(log).invocations:
        seen = "null" if invocation.ref_query is None else f"C_{invocation.ref_query}"
        print(
            f"invocation {invocation.invocation} at {invocation.now_ns / 1e6:6.0f} ms "
            f"sees {seen}, {invocation.age_ns / 1e6:.0f} ms old"
        )
    print(f"{episode['status']} after {episode['steps']} ticks; stream {episode['stream_sha256'][:12]}")
    print(log)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/example"))
