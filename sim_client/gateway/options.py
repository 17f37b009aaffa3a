"""Options of ``pp-gateway``, and the plan of episodes that they describe."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import tyro

from clock import schedules
from clock.policies import SERVERS, PonderChoice, policy_of
from clock.timebase import NS_PER_MS
from protocol import files
from protocol.checks import MAX_HORIZON, MAX_IMAGE_SIDE_PX, MAX_INDEX
from protocol.command_line import On
from protocol.errors import TransportError
from protocol.messages import Delay, DelayKind, Delivery, DeliveryKind, Mode, Schedule, WaitKind
from protocol.options import DaemonOptions, LinkOptions
from protocol.peers.mapping import PolicyMapping, read_mapping
from protocol.sockets import endpoint
from protocol.topics import SHADOW_OF
from protocol.version import version
from sim_client.gateway import body, challenge, groot, lerobot, mme_vla, openpi, ponderpounce, vla_eval
from sim_client.gateway.exchange import Dialect, Terms
from sim_client.gateway.machine import Plan

MAX_SEATS = 64
"""Each is a thread, a bus and, in real time, a clock of its own: more robots want another gateway on another host."""

_MAX_MB = 1 << 20

DialectName = Literal[
    "ponderpounce", "openpi", "challenge", "challenge-http", "mme-vla", "vla-eval", "groot", "groot-n1.5", "lerobot"
]
_MAPPED: tuple[DialectName, ...] = ("groot", "groot-n1.5", "lerobot")
_LIVE: tuple[DialectName, ...] = ("ponderpounce", "lerobot")
"""Dialects of real robots: real time unless --mode says otherwise, and a stopped episode waits for a person."""
_OF_ROBOMME: tuple[DialectName, ...] = ("challenge", "challenge-http", "mme-vla", "vla-eval")
_SPOKEN: dict[DialectName, tuple[type[Dialect] | None, Mapping[str, str], str, int]] = {
    # by name: who speaks it (None: a side of its own), where it has the cameras (if empty: by their names) and the
    # state, and how many rows an answer usually has
    "ponderpounce": (ponderpounce.PonderpounceDialect, {}, ponderpounce.STATE_KEY, 1),
    "openpi": (openpi.OpenpiDialect, openpi.CAMERAS, openpi.STATE_KEY, 1),
    "challenge": (challenge.ChallengeDialect, challenge.CAMERAS, challenge.JOINTS_KEY, challenge.ROWS),
    "challenge-http": (challenge.ChallengeDialect, challenge.CAMERAS, challenge.JOINTS_KEY, challenge.ROWS),
    "mme-vla": (mme_vla.MmeVlaDialect, openpi.CAMERAS, openpi.STATE_KEY, mme_vla.ROWS),
    "vla-eval": (vla_eval.VlaEvalDialect, vla_eval.CAMERAS, "states", 1),
    "groot": (groot.GrootDialect, {}, "", 0),  # these three have all of it in a mapping file
    "groot-n1.5": (groot.GrootN15Dialect, {}, "", 0),
    "lerobot": (None, {}, "", 0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleOptions:
    """When models are asked, and what the robot does with their answers."""

    query_period_ms: int = 1000
    """Period of PONDER's queries in ms (paper: 1 Hz). 0: one query an episode, whose cognition is never too old."""
    invoke_every_ticks: int | None = None
    """Period of POUNCE's invocations in ticks of the robot. None: --rows in lockstep if several; else as many as its
    chunks have rows in lockstep, half of that in real time."""
    delay_ms: int = 300
    """PONDER's modelled delay in ms, in lockstep (paper: 300)."""
    cognition: Literal["real", "null"] = "real"
    """Cognition that POUNCE is conditioned on. real: PONDER's; null: the learned null. PONDER is queried in both."""
    wait: Literal["stand-still", "hold"] = "stand-still"
    """Behaviour until the first chunk. stand-still: the first answer waits for it. hold: ticks count from the first
    observation and the arm is held, for 6 ticks in the paper's schedule, as by the official server."""
    max_age_ms: int = 2000
    """Age in ms from which a cognition is called stale (an alarm; its rows are still played)."""
    stale_limit_ms: int = 10_000
    """Age in ms from which a cognition's rows are not played: the robot holds, then stops."""
    allow_starved: bool = False
    """Start although the schedule leaves ticks without a row."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientsOptions:
    """Access of clients, and limits of their requests."""

    api_key_file: Path | None = None
    """File with a word that clients must send: as "Authorization: Api-Key WORD", which openpi-client's api_key does, or
    as GR00T's api_token."""
    open_to_anyone: bool = False
    """Listen beyond loopback without a key: any host that reaches the port drives the robot."""
    idle_s: float = 300.0
    """Time in seconds without a request after which a client loses the robot to the next one that asks."""
    max_message_mb: int = 1024
    """Size in MB above which messages are refused. Two raw 256 px views of a 48 s video are 380 MB."""
    max_memory_mb: int = 2048
    """Memory in MB for the requests of all clients together. Beyond it the one that holds most is disconnected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServersOptions:
    """Where the clock service runs, and how long servers may take."""

    clock: Literal["auto", "embedded", "daemon"] = "auto"
    """Place of the clock service. auto: its own process in real time, this process in lockstep."""
    patience_s: float = 120.0
    """Longest wait in seconds for servers to be ready, and in lockstep for any command."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogOptions:
    """Logs of episodes."""

    record: On = True
    """Do not write an MCAP per episode."""
    pixels: Literal["jpeg", "exact"] = "jpeg"
    """Form of logged raw frames. jpeg: as JPEG; exact: also bit for bit as the models saw them."""
    task: str = "gateway"
    """Name of the task in logs if the client does not give one."""
    seed: int = 0
    """Seed of a seat's first episode; each further one uses the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayOptions:
    """Lets a robot's own program drive PONDER and POUNCE, and clients of other protocols: openpi, RoboMME's two
    evaluators, vla-eval, GR00T, LeRobot."""

    dialect: DialectName
    """Protocol of the clients."""
    listen: str = "127.0.0.1:8000"
    """HOST:PORT for the clients. Beyond loopback it needs --api-key-file or --open-to-anyone."""
    mode: Literal["lockstep", "realtime"] | None = None
    """Clock. lockstep: a request is --rows ticks of virtual time, and models may take their time. realtime: the
    schedule runs by itself, and a request is answered immediately with the action commanded at that moment. None:
    realtime for the dialects ponderpounce and lerobot, lockstep for the others."""
    rows: int | None = None
    """Number of rows in an answer, played by the client before its next request. None: 1, 20 for the challenge, 16 for
    mme-vla, and the mapping file's horizon for GR00T and LeRobot."""
    robot_file: Path | None = None
    """TOML description of the robot, see docs/robots.md. None: the Panda of our tasks and of RoboMME."""
    cameras: tuple[str, ...] = ()
    """Pairs NAME=KEY, one per camera of ours, e.g. front=observation/image wrist=observation/wrist_image. Empty: the
    dialect's usual keys; in vla-eval our cameras' names, or else the first picture is the front camera's, the second
    the wrist's, and a third is refused."""
    mapping: Path | None = None
    """TOML file with the client's names and units for cameras, state and actions, for the dialects of GR00T and
    LeRobot; see docs/policies.md."""
    state_key: str | None = None
    """Key of the measured joints. None: the dialect's usual key."""
    image_px: int | None = None
    """Side in pixels of the squares that pictures are resized to. None: no resizing; PONDER refuses a wrong size."""
    ponder: PonderChoice = "serve"
    """Whether there is a PONDER. none: POUNCE plays alone, on its learned null or the task alone."""
    local: bool = False
    """Start ponder-serve, pounce-serve (and in real time clock-serve) on this machine, and stop them at the end."""
    ponder_checkpoint: Path | None = None
    """PONDER's checkpoint, with --local. None: random weights."""
    pounce_checkpoint: Path | None = None
    """POUNCE's checkpoint, with --local. None: random weights."""
    seats: int = 1
    """Number of robots, hence of clients at a time. Their names are --link.robot, and that with -1, -2 and so on."""
    watch: str | None = None
    """HOST:PORT of a page with the live status of --link.robot, by a process of its own. None: no page."""
    out: Path = Path("out")
    """Folder for one MCAP per episode."""
    clients: tyro.conf.OmitArgPrefixes[ClientsOptions] = field(default_factory=ClientsOptions)
    timing: tyro.conf.OmitArgPrefixes[ScheduleOptions] = field(default_factory=ScheduleOptions)
    servers: tyro.conf.OmitArgPrefixes[ServersOptions] = field(default_factory=ServersOptions)
    log: tyro.conf.OmitArgPrefixes[LogOptions] = field(default_factory=LogOptions)
    operations: tyro.conf.OmitArgPrefixes[DaemonOptions] = field(default_factory=DaemonOptions)
    link: LinkOptions = field(
        default_factory=lambda: LinkOptions(connect=tuple(map(endpoint, ("clock", *SERVERS, *SHADOW_OF))))
    )

    def check(self) -> None:
        """Raises TransportError for what cannot work together."""
        if self.ponder == "none" and self.ponder_checkpoint is not None:
            raise TransportError("--ponder none starts no PONDER: leave --ponder-checkpoint out")
        host, _ = self.address
        self._check_limits()
        self._check_ports()
        if self.dialect in _MAPPED and self.mapping is None:
            raise TransportError(f"--dialect {self.dialect} needs a --mapping file: its clients name every number")
        rows = self.terms().rows
        if not 1 <= self.seats <= MAX_SEATS:
            raise TransportError(f"--seats {self.seats}: expected 1 to {MAX_SEATS}")
        if (mapping := self.policy_mapping()) is not None:
            self._check_mapping(mapping)
        if not 1 <= rows <= MAX_HORIZON:
            raise TransportError(f"--rows {rows}: expected 1 to as many as POUNCE's chunks have")
        if self.dialect == "ponderpounce" and (rows != 1 or not self.is_realtime):
            raise TransportError(
                "--dialect ponderpounce: a robot's own program gets each tick's command in real time; "
                "leave --rows and --mode out"
            )
        if self.dialect == "vla-eval" and rows != 1:
            raise TransportError(f"--rows {rows}: vla-eval asks at every step and plays one row; leave --rows out")
        every_ticks = self.timing.invoke_every_ticks
        if not self.is_realtime and every_ticks is not None and every_ticks % rows:
            raise TransportError(
                f"--invoke-every-ticks {every_ticks} is no multiple of --rows {rows}: a new chunk would break the "
                "promise of rows that the client is still playing"
            )
        if not self.is_realtime and self.timing.wait == "hold" and rows != 1:
            raise TransportError(
                f"--wait hold ends within --rows {rows}, whose last rows it would change; take --rows 1"
            )
        if not self.clients.api_key_file and not self.clients.open_to_anyone and not _is_loopback(host):
            raise TransportError(
                f"--listen {self.listen} can be reached from other hosts: give --api-key-file, or say --open-to-anyone"
            )
        if self.clients.api_key_file and self.dialect == "vla-eval":
            raise TransportError("--api-key-file: vla-eval sends no key; use --open-to-anyone, or a tunnel")
        if self.dialect == "lerobot" and not _is_loopback(host):
            raise TransportError(f"--listen {self.listen}: LeRobot's clients have neither key nor TLS; use a tunnel")

    def _check_limits(self) -> None:
        """Raises TransportError for a number that nothing could be done with."""
        for option, value, most in (
            ("--image-px", self.image_px, MAX_IMAGE_SIDE_PX),
            ("--max-message-mb", self.clients.max_message_mb, _MAX_MB),
            ("--max-memory-mb", self.clients.max_memory_mb, _MAX_MB),
            ("--invoke-every-ticks", self.timing.invoke_every_ticks, MAX_INDEX),
        ):
            if value is not None and not 1 <= value <= most:
                raise TransportError(f"{option} {value}: expected 1 to {most}")

    def _check_ports(self) -> None:
        """Raises TransportError for a port that is taken twice, and for a page that other hosts could reach."""
        if self.watch is not None and not _is_loopback(_address("--watch", self.watch)[0]):
            raise TransportError(
                f"--watch {self.watch} can be reached from other hosts: use 127.0.0.1, or start "
                "pp-replay watch --open-to-anyone beside the gateway"
            )
        given = {"--listen": self.listen, "--watch": self.watch, "--metrics": self.operations.metrics}
        taken: dict[int, str] = {}
        for option, where in given.items():
            port = _address(option, where)[1] if where is not None else 0
            if port in taken:
                raise TransportError(f"{option} {where}: expected another port than that of {taken[port]}")
            if port:  # 0 is whichever is free
                taken[port] = f"{option} {where}"

    def _check_mapping(self, mapping: PolicyMapping) -> None:
        """Raises TransportError or FileError for a client that this robot could not be."""
        assert self.mapping is not None, "it was read"
        if self.dialect not in _MAPPED:
            raise TransportError(f"--mapping: --dialect {self.dialect} has names of its own; see --cameras")
        with files.reading(self.mapping, "mapping file for this robot"):
            if self.dialect == "lerobot":
                lerobot.check_mapping(mapping, self.body().example().cameras)
            else:
                groot.check_mapping(mapping)
            num_proprio, control_hz = self.body().num_proprio, self.body().control_hz
            if mapping.num_proprio != num_proprio:
                raise ValueError(f"num_proprio is {mapping.num_proprio}, the robot's {num_proprio}; see --robot-file")
            if mapping.play_hz != control_hz:
                raise ValueError(f"play_hz is {mapping.play_hz}, the robot's {control_hz}; see --robot-file")

    @property
    def is_realtime(self) -> bool:
        return (self.mode or ("realtime" if self.dialect in _LIVE else "lockstep")) == "realtime"

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of ``listen``. Raises TransportError if it is not HOST:PORT."""
        return _address("--listen", self.listen)

    @property
    def runs_clock_daemon(self) -> bool:
        place = self.servers.clock
        return place == "daemon" or (place == "auto" and self.is_realtime)

    def api_key(self) -> str:
        """The word that clients must know; "" if none. Raises OSError or FileError unless the file has one."""
        file = self.clients.api_key_file
        return files.read_word(file, "word for --api-key-file") if file else ""

    def dialect_class(self) -> type[Dialect]:
        found = _SPOKEN[self.dialect][0]
        assert found is not None, f"{self.dialect} has a side of its own"
        return found

    def terms(self) -> Terms:
        """The terms for the dialect. Raises TransportError for a camera that is not NAME=KEY."""
        _, cameras, state_key, rows = _SPOKEN[self.dialect]
        mapping, robot = self.policy_mapping(), self.body()
        described = robot.example()
        pairs = [each.partition("=") for each in self.cameras]
        if any(not name or not key for name, _, key in pairs):
            raise TransportError(f"--cameras {' '.join(self.cameras)}: expected NAME=KEY, e.g. front=observation/image")
        return Terms(
            mode=Mode.REALTIME if self.is_realtime else Mode.LOCKSTEP,
            rows=self.rows if self.rows is not None else rows or self._mapped_rows(),
            control_hz=robot.control_hz,
            cameras={name: key for name, _, key in pairs} or cameras or {name: name for name in described.cameras},
            state_key=self.state_key or state_key,
            robot=described,
            version=version(),
            mapping=mapping,
            has_ponder=self.ponder != "none",
        )

    def policy_mapping(self) -> PolicyMapping | None:
        """The client's names and units. Raises OSError, FileError unless the file has them."""
        return read_mapping(self.mapping) if self.mapping is not None else None

    def _mapped_rows(self) -> int:
        mapping = self.policy_mapping()
        return mapping.num_rows if mapping is not None else 1

    def schedule(
        self, seed: int, horizon: int = schedules.HORIZON, *, control_hz: int = schedules.CONTROL_HZ
    ) -> Schedule:
        """The schedule of the episode with this seed, for chunks of ``horizon`` rows and a robot of this rate."""
        named = schedules.realtime if self.is_realtime else schedules.paper
        base = named(control_hz, horizon)
        rows = self.rows or _SPOKEN[self.dialect][3] or self._mapped_rows()
        every_ticks = rows if not self.is_realtime and rows > 1 else base.invoke_period_ticks
        fixed = Delay(kind=DelayKind.FIXED, mean_ns=self.timing.delay_ms * NS_PER_MS)
        schedule = replace(
            base,
            query_period_ns=self.timing.query_period_ms * NS_PER_MS,
            invoke_period_ticks=self.timing.invoke_every_ticks or every_ticks,
            query_delay=base.query_delay if self.is_realtime else fixed,
            delivery=Delivery(kind=DeliveryKind.NULL if self.timing.cognition == "null" else DeliveryKind.EVERY),
            wait=WaitKind.HOLD if self.timing.wait == "hold" else WaitKind.STAND_STILL,
            max_age_ns=self.timing.max_age_ms * NS_PER_MS,
            stale_limit_ns=self.timing.stale_limit_ms * NS_PER_MS,
            seed=seed,
        )
        return schedule if self.timing.query_period_ms else schedules.once_an_episode(schedule)

    def body(self) -> body.Body:
        """The robot that clients drive. Raises OSError or FileError if its file does not describe one."""
        if self.robot_file:
            return body.read_body(self.robot_file)
        return body.ROBOMME if self.dialect in _OF_ROBOMME else body.PANDA

    def plan(self) -> Plan:
        """The common plan of all episodes. Raises TransportError as ``body``."""
        robot = self.body()  # read once: a file that changes later changes no episode
        return Plan(
            schedule=partial(self.schedule, control_hz=robot.control_hz),
            num_rows=self.terms().rows,
            body=robot,
            suite=self.dialect,
            policy=policy_of(self.ponder),
            task=self.log.task,
            image_px=self.image_px,
            seed=self.log.seed,
            out=self.out if self.log.record else None,
            pixels=self.log.pixels,
            patience_ns=round(self.servers.patience_s * 1e9),
            idle_ns=round(self.clients.idle_s * 1e9),
            waits_for_person=self.dialect in _LIVE,
        )


def _address(option: str, where: str) -> tuple[str, int]:
    """Host and port. Raises TransportError for anything else."""
    host, _, port = where.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise TransportError(f"{option} {where!r}: expected HOST:PORT, e.g. 127.0.0.1:8000")
    return host.strip("[]"), int(port)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
