"""Options of ``sim-client``, and the schedule that they describe."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from clock import schedules
from clock.timebase import NS_PER_MS
from dual_system.models.ponder.showing import Showing
from dual_system.tasks.difficulty import Difficulty
from protocol.messages import Delay, DelayKind, Delivery, DeliveryKind, Schedule, Seam, SeamKind, WaitKind
from protocol.options import LinkOptions
from sim_client.shown import how_shown


@dataclass(frozen=True, slots=True, kw_only=True)
class SimOptions:
    """Drives MuJoCo episodes with the PONDER and POUNCE servers, and logs every tick."""

    task: str = "PickHighlight"
    """--list-tasks shows all."""
    list_tasks: bool = False
    """Print the tasks and leave."""
    episodes: int = 1
    seed: int = 0
    """Of the first episode; the i-th one (from 0) uses seed + i."""
    difficulty: Difficulty | None = None
    """None: by seed, as the benchmark does."""
    mode: Literal["lockstep", "realtime"] = "lockstep"
    """lockstep: simulated time waits for results, delays are modelled, bit-reproducible. realtime: nobody waits."""
    policy: Literal["servers", "oracle"] = "servers"
    """oracle: the task's own script instead of the servers."""
    out: Path = Path("out")
    """Folder for results.json and one MCAP per episode."""

    local: bool = False
    """Start ponder-serve, pounce-serve (and in real time clock-serve) on this machine, and stop them at the end."""
    in_process: bool = False
    """Lockstep only: everything in this one process and thread, without zenoh."""
    clock: Literal["auto", "embedded", "daemon"] = "auto"
    """Where the clock service runs. auto: its own process in real time, inside this one in lockstep."""
    link: LinkOptions = field(
        default_factory=lambda: LinkOptions(connect=("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7448", "tcp/127.0.0.1:7449"))
    )
    ponder_checkpoint: Path | None = None
    """With --local or --in-process: weights of PONDER; none are random."""
    pounce_checkpoint: Path | None = None
    patience_s: float = 120.0
    """How long to wait for servers to be ready, and in lockstep for any answer."""

    query_period_ms: int = 1000
    """Between PONDER's looks (paper: 1 Hz)."""
    invoke_every_ticks: int | None = None
    """Between POUNCE's invocations, in 50 ms ticks. None: 20 in lockstep (the paper's 1 Hz), 10 in real time."""
    delay: Literal["default", "measured", "fixed", "log-normal"] = "default"
    """PONDER's delay. default: fixed in lockstep, measured in real time."""
    delay_ms: int = 300
    """Mean of a modelled delay (paper: 300 ms)."""
    deliver: Literal["every", "held-transition", "null"] = "every"
    """Which cognition POUNCE gets (paper, 5.2)."""
    held_age_ms: int = 0
    """With held-transition: the age POUNCE is told; 0 is the true one. The paper froze it at 300."""
    seam: Literal["switch", "offset-fade", "ensemble"] = "switch"
    """How chunks are joined."""
    wait: Literal["stand-still", "hold"] = "stand-still"
    """Until the first chunk: simulated time stands still, or runs while the arm holds."""
    max_age_ms: int = 2000
    """Cognition older than this is called stale (an alarm; its rows are still played)."""
    stale_limit_ms: int = 10_000
    """Rows made with a cognition older than this are not played: hold, then stop."""
    allow_starved: bool = False
    """Start although the schedule leaves ticks without a row."""
    max_steps: int = 1300
    demo_hz: Literal[1, 2, 4, 5, 10, 20] | None = None
    """How many frames of a demonstration are shown a second. None: as many as the --ponder-checkpoint says that it has
    learned from; without one, the paper's 1."""
    video_end: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show a demonstration's last frame, too, although the --ponder-checkpoint does not say that it has learned so."""

    record: bool = True
    """Write one MCAP per episode."""
    record_hz: Literal[1, 2, 4, 5, 10, 20] = 20
    """In lockstep: how often the log has pictures, beside those that the models look at."""
    pixels: Literal["jpeg", "exact"] = "jpeg"
    """jpeg: raw frames are logged as JPEG; exact: also bit for bit as the models saw them (8 MB/s)."""
    progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True
    """Show a progress bar."""

    @property
    def showing(self) -> Showing:
        """How demonstrations are shown. Raises TransportError as `how_shown`."""
        return how_shown(self.demo_hz, self.video_end, self.ponder_checkpoint)

    @property
    def runs_clock_daemon(self) -> bool:
        return self.clock == "daemon" or (self.clock == "auto" and self.mode == "realtime" and not self.in_process)

    def schedule(self, seed: int) -> Schedule:
        """The schedule of the episode with this seed."""
        base = schedules.realtime() if self.mode == "realtime" else schedules.paper()
        return replace(
            base,
            query_period_ns=self.query_period_ms * NS_PER_MS,
            invoke_period_ticks=self.invoke_every_ticks or base.invoke_period_ticks,
            query_delay=self._delay(base.query_delay),
            delivery=Delivery(kind=_DELIVERIES[self.deliver], reported_age_ns=self.held_age_ms * NS_PER_MS),
            wait=WaitKind.HOLD if self.wait == "hold" else WaitKind.STAND_STILL,
            seam=_SEAMS[self.seam],
            max_age_ns=self.max_age_ms * NS_PER_MS,
            stale_limit_ns=self.stale_limit_ms * NS_PER_MS,
            max_ticks=self.max_steps,
            seed=seed,
        )

    def _delay(self, default: Delay) -> Delay:
        mean_ns = self.delay_ms * NS_PER_MS
        if self.delay == "measured":
            return schedules.MEASURED
        if self.delay == "log-normal":
            return replace(schedules.TRAINING_DELAY, mean_ns=mean_ns)
        if self.delay == "fixed" or default.kind == DelayKind.FIXED:
            return Delay(kind=DelayKind.FIXED, mean_ns=mean_ns)
        return default


_DELIVERIES = {
    "every": DeliveryKind.EVERY,
    "held-transition": DeliveryKind.HELD_TRANSITION,
    "null": DeliveryKind.NULL,
}
_SEAMS = {
    "switch": Seam(),
    "offset-fade": Seam(kind=SeamKind.OFFSET_FADE, fade_ticks=6),
    "ensemble": Seam(kind=SeamKind.ENSEMBLE, ensemble_decay=0.01),
}
