"""Your own action model behind POUNCE's contract (`spec`, `invoke`, `warm_up`); here a few lines of NumPy.

python examples/04_your_own_policy.py                                 # a short lockstep episode, in this process
python examples/04_your_own_policy.py --serve                         # in the place of pounce-serve, on its socket
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pounce_server.contract import EngineSpec, Progress, Request, check_request, example_request, no_progress
from pounce_server.serve import PounceServer
from protocol.bus import Bus, LocalBus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.options import LinkOptions
from protocol.process import StopFlag, host_clock_id, run
from protocol.sockets import endpoint
from protocol.zenoh_bus import open_bus


class Wave:
    """Waves with the first joint around wherever the arm is, gripper open. Satisfies ``PounceEngine``."""

    spec = EngineSpec(
        horizon=20,
        action_dim=8,
        proprio_dim=8,
        num_carriers=0,  # takes no cognition; with K > 0, ``request.cognition`` is PONDER's (K, H) or None
        cognition_size=0,
        image_px=256,
        num_steps=1,
        num_cameras=2,
        model_hash="wave-1",
        is_random=True,  # a stand-in: the clock service will not let it move a real robot
        has_fresh_prefix=False,
        dtype="float32",
    )

    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        """Rows (20, 8): absolute joint targets in rad, gripper from -1 closed to 1 open."""
        check_request(request, self.spec)
        rows = np.tile(np.append(request.proprio[:7], 1.0), (self.spec.horizon, 1))
        rows[:, 0] += 0.1 * np.sin(2 * np.pi * np.arange(self.spec.horizon) / self.spec.horizon)
        progress()  # between pieces of work: the heartbeat comes from the loop that works
        return rows.astype(np.float32)

    def warm_up(self) -> list[int]:
        """Durations in ns; their p99 decides whether a schedule can be kept."""
        durations_ns = []
        for _ in range(20):
            start_ns = time.perf_counter_ns()
            self.invoke(example_request(self.spec))
            durations_ns.append(time.perf_counter_ns() - start_ns)
        return durations_ns


def server_on(bus: Bus) -> PounceServer:
    """A warm server that answers to the name of ``pounce``."""
    link = Link(bus, robot="r0", proc="pounce")
    server = PounceServer(link, Wave(), Heartbeat(link, "example", host_clock_id()), "example")
    server.warm_up()
    server.ready()
    return server


def serve(listen: str) -> None:
    """As ``pounce-serve`` does, until SIGTERM or Ctrl-C."""
    should_stop = StopFlag()
    bus = open_bus(LinkOptions(listen=(listen,)))
    try:
        run(bus, server_on(bus).step, should_stop)
    finally:
        bus.close()


def episode(out: Path) -> None:
    """PONDER, the clock service and the simulated robot around it, all on one in-process bus."""
    import dual_system.tasks.headless  # noqa: F401, I001 - before anything that imports mujoco

    from clock.service import ClockService, ServiceConfig
    from ponder_server import in_process as ponder
    from protocol.mcap_log import read_log
    from sim_client.config import ScheduleOptions, SimOptions
    from sim_client.suite import Suite

    bus = LocalBus()
    bus.add_participant(ponder.build(bus, "r0", checkpoint=None))
    bus.add_participant(server_on(bus).step)
    clock = ClockService(Link(bus, robot="r0", proc="clock"), ServiceConfig(watches=False))
    bus.add_participant(clock.step)
    options = SimOptions(in_process=True, schedule=ScheduleOptions(max_steps=40), out=out)
    suite = Suite(options, Link(bus, robot="r0", proc="sim"), clock, dead_server=lambda: "")
    (played,) = suite.run()["episodes"]
    first_joint = np.array([tick.state[0] for tick in read_log(out / played["mcap"]).ticks])
    print(f"{played['steps']} ticks; joint 1 went from {first_joint.min():+.3f} to {first_joint.max():+.3f} rad")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"] and len(sys.argv) <= 3:
        serve(sys.argv[2] if len(sys.argv) == 3 else endpoint("pounce"))
    elif len(sys.argv) == 1:
        with tempfile.TemporaryDirectory() as folder:
            episode(Path(folder))
    else:
        sys.exit(__doc__)
