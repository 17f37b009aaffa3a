"""Options of ``sim-client``, and the schedule that they describe."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import tyro

from clock import schedules
from clock.policies import SERVERS, PonderChoice, policy_of
from clock.timebase import NS_PER_MS
from dual_system.tasks.difficulty import Difficulty
from protocol.command_line import On
from protocol.errors import TransportError
from protocol.messages import Delay, DelayKind, Delivery, DeliveryKind, Schedule, Seam, SeamKind, WaitKind
from protocol.options import LinkOptions
from protocol.sockets import endpoint
from protocol.topics import SHADOW_OF

ModeName = Literal["lockstep", "realtime"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleOptions:
    """When models are asked, and what the robot does with their answers."""

    query_period_ms: int = 1000
    """Period of PONDER's queries in ms (paper: 1 Hz). 0: one query an episode, whose cognition is never too old."""
    invoke_every_ticks: int | None = None
    """Period of POUNCE's invocations in 50 ms ticks. None: as many as its chunks have rows in lockstep (20 rows: the
    paper's 1 Hz), half of that in real time."""
    delay: Literal["default", "measured", "fixed", "log-normal"] = "default"
    """PONDER's delay. default: fixed in lockstep, measured in real time."""
    delay_ms: int = 300
    """Mean of a modelled delay in ms (paper: 300)."""
    deliver: Literal["every", "held-transition", "null"] = "every"
    """Cognition that POUNCE is conditioned on (paper, 5.2)."""
    held_age_ms: int = 0
    """Age in ms that POUNCE is told, whatever the true one; 0 is the true age. The paper fixes that of held transitions
    at 300."""
    seam: Literal["switch", "offset-fade", "ensemble"] = "switch"
    """Transition from one action chunk to the next."""
    wait: Literal["stand-still", "hold"] = "stand-still"
    """Behaviour until the first chunk: simulated time stands still, or runs while the arm holds."""
    max_age_ms: int = 2000
    """Age in ms from which a cognition is called stale (an alarm; its rows are still played)."""
    stale_limit_ms: int = 10_000
    """Age in ms from which a cognition's rows are not played: the robot holds, then stops."""
    allow_starved: bool = False
    """Start although the schedule leaves ticks without a row."""
    max_steps: int = 1300
    """Limit of control steps per episode (paper: 1300)."""

    def of_episode(self, mode: ModeName, seed: int, horizon: int = schedules.HORIZON) -> Schedule:
        """Returns the schedule of the episode with this seed, for chunks of ``horizon`` rows."""
        named = schedules.realtime if mode == "realtime" else schedules.paper
        base = named(horizon=horizon)
        schedule = replace(
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
        return schedule if self.query_period_ms else schedules.once_an_episode(schedule)

    def _delay(self, default: Delay) -> Delay:
        mean_ns = self.delay_ms * NS_PER_MS
        if self.delay == "measured":
            return schedules.MEASURED
        if self.delay == "log-normal":
            return replace(schedules.TRAINING_DELAY, mean_ns=mean_ns)
        if self.delay == "fixed" or default.kind == DelayKind.FIXED:
            return Delay(kind=DelayKind.FIXED, mean_ns=mean_ns)
        return default


@dataclass(frozen=True, slots=True, kw_only=True)
class ServersOptions:
    """Where the clock service runs, and how long servers may take."""

    clock: Literal["auto", "embedded", "daemon"] = "auto"
    """Place of the clock service. auto: its own process in real time, this process in lockstep."""
    patience_s: float = 120.0
    """Longest wait in seconds for servers to be ready, and in lockstep for any answer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelsOptions:
    """How the models are run, where their servers are started here."""

    device: str = "cpu"
    """Device of both models: cpu, cuda or cuda:N."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Number format of both models' weights and activations."""
    path: Literal["eager", "compile", "max-autotune", "fused"] = "eager"
    """How POUNCE computes an invocation; see pounce-serve --help."""

    def of_ponder(self) -> dict[str, str]:
        """Options of ponder-serve that differ from its defaults, by name."""
        return self._changed("device", "dtype")

    def of_pounce(self) -> dict[str, str]:
        """Options of pounce-serve that differ from its defaults, by name."""
        return self._changed("device", "dtype", "path")

    def _changed(self, *names: str) -> dict[str, str]:
        defaults = ModelsOptions()
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(defaults, name)}


@dataclass(frozen=True, slots=True, kw_only=True)
class LogOptions:
    """Logs and progress."""

    record: On = True
    """Do not write an MCAP per episode."""
    record_hz: Literal[1, 2, 4, 5, 10, 20] = 20
    """Rate of logged pictures in Hz in lockstep; those that the models observe are logged as well."""
    pixels: Literal["jpeg", "exact"] = "jpeg"
    """Form of logged raw frames. jpeg: as JPEG; exact: also bit for bit as the models saw them (8 MB/s)."""
    progress: On = True
    """Do not show a progress bar."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimOptions:
    """Drives MuJoCo episodes with the PONDER and POUNCE servers, and logs every tick."""

    task: str = "PickHighlight"
    """Name of the task; --list-tasks shows all."""
    episodes: int = 1
    """Number of episodes."""
    seed: int = 0
    """Seed of the first episode; the i-th one (from 0) uses seed + i."""
    difficulty: Difficulty | None = None
    """Difficulty of every scene. None: by seed, as the benchmark does."""
    mode: ModeName = "lockstep"
    """Clock. lockstep: simulated time waits for results, delays are modelled, bit-reproducible. realtime: no wait."""
    policy: Literal["servers", "oracle"] = "servers"
    """Source of actions: the servers, or the task's own script (oracle)."""
    ponder: PonderChoice = "serve"
    """Whether there is a PONDER. none: POUNCE plays alone, on its learned null or the task alone."""
    local: bool = False
    """Start ponder-serve, pounce-serve (and in real time clock-serve) on this machine, and stop them at the end."""
    in_process: bool = False
    """Run everything in this process and thread, without zenoh; lockstep only."""
    ponder_checkpoint: Path | None = None
    """PONDER's checkpoint, with --local or --in-process. None: random weights."""
    pounce_checkpoint: Path | None = None
    """POUNCE's checkpoint, with --local or --in-process. None: random weights."""
    out: Path = Path("out")
    """Folder for results.json and one MCAP per episode."""
    list_tasks: bool = False
    """Print the names of the tasks and exit."""
    schedule: tyro.conf.OmitArgPrefixes[ScheduleOptions] = field(default_factory=ScheduleOptions)
    servers: tyro.conf.OmitArgPrefixes[ServersOptions] = field(default_factory=ServersOptions)
    models: tyro.conf.OmitArgPrefixes[ModelsOptions] = field(default_factory=ModelsOptions)
    log: tyro.conf.OmitArgPrefixes[LogOptions] = field(default_factory=LogOptions)
    link: LinkOptions = field(
        default_factory=lambda: LinkOptions(connect=tuple(map(endpoint, ("clock", *SERVERS, *SHADOW_OF))))
    )

    @property
    def played_by(self) -> str:
        """``EpisodeInfo.policy``."""
        return policy_of(self.ponder) if self.policy == "servers" else self.policy

    def check(self) -> None:
        """Raises TransportError for what cannot work together, and for no episode at all."""
        if self.episodes < 1:
            raise TransportError(f"--episodes: expected at least 1, came {self.episodes}")
        if self.ponder == "none" and self.policy == "oracle":
            raise TransportError("--policy oracle plays without servers: leave --ponder none out")
        if self.ponder == "none" and self.ponder_checkpoint is not None:
            raise TransportError("--ponder none starts no PONDER: leave --ponder-checkpoint out")

    @property
    def runs_clock_daemon(self) -> bool:
        place = self.servers.clock
        return place == "daemon" or (place == "auto" and self.mode == "realtime" and not self.in_process)


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
