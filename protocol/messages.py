"""The messages as frozen dataclasses with numpy arrays, for all code behind the codec.

Fields have the same names as in ``protocol/ponderpounce/v1/*.proto``, where each is explained; ``codec`` converts.
Arrays are read-only views after decoding. Instants are int nanoseconds; "episode time" is the clock service's, 0 at
reset.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

EPISODE_CLOCK = "episode"  # clock_id of episode time


class ImageCodec(IntEnum):
    UNSPECIFIED = 0
    RAW = 1
    JPEG = 2
    PNG = 3
    ELSEWHERE = 4


class TaskStatus(IntEnum):
    UNSPECIFIED = 0
    ONGOING = 1
    SUCCESS = 2
    FAIL = 3
    TIMEOUT = 4
    ABORTED = 5


class StampKind(IntEnum):
    UNSPECIFIED = 0
    COGNITION = 1
    CHUNK = 2


class ActionSpace(IntEnum):
    UNSPECIFIED = 0
    JOINT_TARGET = 1
    EE_POSE = 2


class Level(IntEnum):
    """Rungs of the ladder, from best to worst."""

    UNSPECIFIED = 0
    PLAY = 1
    STALE = 2
    HOLD = 3
    DECELERATE = 4
    STOPPED = 5
    SKIPPED = 6


class RobotState(IntEnum):
    """What the robot says of itself."""

    UNSPECIFIED = 0
    OK = 1
    USER_STOP = 2
    PROTECTIVE_STOP = 3
    FAULT = 4
    TORQUE_OFF = 5

    @property
    def obeys(self) -> bool:
        """Whether commands are carried out, as far as the robot says."""
        return self in (RobotState.UNSPECIFIED, RobotState.OK)

    @classmethod
    def _missing_(cls, value: object) -> RobotState:
        return cls.FAULT  # a newer robot's word for something: no leave to move


class SubgoalKind(IntEnum):
    UNSPECIFIED = 0
    SUBGOAL = 1
    DEMO_REASONING = 2
    TASK_SIMPLE = 3
    TASK_GROUNDED = 4


class Severity(IntEnum):
    UNSPECIFIED = 0
    INFO = 1
    WARNING = 2
    ERROR = 3


class ServingState(IntEnum):
    UNSPECIFIED = 0
    LOADING = 1
    WARMING = 2
    READY = 3
    FAILED = 4
    CLOSING = 5


class Mode(IntEnum):
    UNSPECIFIED = 0
    REALTIME = 1
    LOCKSTEP = 2


class DelayKind(IntEnum):
    UNSPECIFIED = 0
    MEASURED = 1
    FIXED = 2
    LOG_NORMAL = 3


class DeliveryKind(IntEnum):
    UNSPECIFIED = 0
    EVERY = 1
    HELD_TRANSITION = 2
    NULL = 3


class WaitKind(IntEnum):
    UNSPECIFIED = 0
    STAND_STILL = 1
    HOLD = 2


class SeamKind(IntEnum):
    UNSPECIFIED = 0
    SWITCH = 1
    OFFSET_FADE = 2
    ENSEMBLE = 3


class PayloadKind(IntEnum):
    UNSPECIFIED = 0
    VECTORS = 1
    TEXT = 2
    FRAMES = 3


class ConsumerKind(IntEnum):
    UNSPECIFIED = 0
    PREFIX = 1
    PROMPT = 2
    MODULATION = 3


class NullKind(IntEnum):
    UNSPECIFIED = 0
    LEARNED = 1
    ABSENT = 2


class DimensionKind(IntEnum):
    UNSPECIFIED = 0
    POSITION = 1
    VELOCITY = 2
    DELTA = 3
    GRIPPER = 4


class AtStop(IntEnum):
    UNSPECIFIED = 0
    HOLD = 1
    MEASURED = 2
    ZERO = 3
    KEEP = 4


class AtExit(IntEnum):
    UNSPECIFIED = 0
    HOLD = 1
    PARK = 2
    RELEASE = 3


class Refusal(IntEnum):
    """Why an episode was not opened, for programs."""

    UNSPECIFIED = 0
    NOT_READY = 1
    BUSY = 2
    CAMERAS = 3
    ROBOT = 4
    MODELS = 5
    SCHEDULE = 6
    REQUEST = 7


def _no_floats() -> Floats:
    return np.zeros(0, np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Header:
    robot: str = ""
    session: str = ""
    episode: str = ""
    epoch: int = 0
    proc: str = ""
    boot_id: int = 0
    seq: int = 0
    clock_id: str = ""
    at_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Image:
    camera: str
    codec: ImageCodec
    height: int
    width: int
    crc32: int = 0
    data: bytes | memoryview = b""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observation:
    header: Header = Header()
    tick: int
    source_ns: int
    proprio: Floats
    images: tuple[Image, ...] = ()
    status: TaskStatus = TaskStatus.ONGOING
    reason: str = ""
    robot_state: RobotState = RobotState.UNSPECIFIED
    robot_text: str = ""
    captured_ns: tuple[int, ...] = ()  # of each image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    header: Header = Header()
    query: int
    tick: int
    source_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cognition:
    header: Header = Header()
    query: int
    tick: int
    source_ns: int
    ready_ns: int
    vector: Floats  # (K, H)
    is_transition: bool = False
    context_tokens: int = 0
    infer_ns: int = 0
    norm: float = 0.0
    model_hash: str = ""
    is_fake: bool = False
    text: str | None = None
    text_source_ns: int = 0
    gate_score: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stamp:
    header: Header = Header()
    kind: StampKind
    index: int
    source_ns: int
    ready_ns: int
    arrived_ns: int
    is_transition: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Invocation:
    header: Header = Header()
    invocation: int
    tick: int
    now_ns: int
    ref_query: int | None
    age_ns: int
    cognition: Floats  # (K, H); (0, 0) for null
    seed: int = 0
    previous_rows: Floats = field(default_factory=_no_floats)
    committed_rows: int = 0
    num_samples: int = 0
    text: str | None = None
    text_age_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActionChunk:
    header: Header = Header()
    invocation: int
    t_row0: int
    horizon: int
    action_dim: int
    dt_ns: int
    rows: Floats  # (horizon * action_dim,), row-major; ``rows_NA`` reshapes
    source_ns: int
    ref_query: int | None
    age_ns: int
    infer_ns: int = 0
    action_space: ActionSpace = ActionSpace.JOINT_TARGET
    reference_state: Floats = field(default_factory=_no_floats)
    seed: int = 0
    model_hash: str = ""
    is_fake: bool = False
    previous_rows: Floats = field(default_factory=_no_floats)
    committed_rows: int = 0
    features: bytes = b""
    padded_video_ticks: tuple[int, ...] = ()
    padded_state_ticks: tuple[int, ...] = ()

    @property
    def rows_NA(self) -> Floats:
        """The rows as (horizon, action_dim)."""
        return self.rows.reshape(self.horizon, self.action_dim)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Action:
    header: Header = Header()
    tick: int
    deadline_ns: int
    level: Level
    values: Floats  # (action_dim,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tick:
    header: Header = Header()
    tick: int
    deadline_ns: int
    decided_ns: int
    late_ns: int
    level: Level
    invocation: int | None = None
    t_row0: int = 0
    row: int = 0
    ref_query: int | None = None
    age_ns: int = 0
    observation_tick: int = 0
    state: Floats = field(default_factory=_no_floats)
    action: Floats = field(default_factory=_no_floats)
    raw_row: Floats = field(default_factory=_no_floats)
    limits_hit: int = 0
    seam_jump: float = 0.0
    age_ms: float = 0.0
    late_ms: float = 0.0
    robot_state: RobotState = RobotState.UNSPECIFIED
    picture_age_ns: tuple[int, ...] = ()
    picture_still_ns: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Subgoal:
    header: Header = Header()
    kind: SubgoalKind
    text: str
    tick: int = 0
    query: int | None = None
    token_ids: tuple[int, ...] = ()
    is_truncated: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Event:
    header: Header = Header()
    severity: Severity
    name: str
    text: str
    tick: int = 0
    attributes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Phase:
    header: Header = Header()
    state: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Health:
    header: Header = Header()
    state: ServingState
    progress: float = 0.0
    detail: str = ""
    is_inferring: bool = False
    open_episode: str = ""
    next_index: int = 0
    infer_p50_ns: int = 0
    infer_p99_ns: int = 0
    num_answered: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    version: str = ""
    model_hash: str = ""
    is_fake: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Delay:
    kind: DelayKind
    mean_ns: int = 0
    sigma: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    kind: DeliveryKind = DeliveryKind.EVERY
    reported_age_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Seam:
    kind: SeamKind = SeamKind.SWITCH
    fade_ticks: int = 0
    ensemble_decay: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    mode: Mode
    control_hz: int
    horizon: int
    query_period_ns: int
    invoke_period_ticks: int
    query_delay: Delay
    invoke_delay: Delay
    delivery: Delivery = Delivery()
    wait: WaitKind = WaitKind.STAND_STILL
    seam: Seam = Seam()
    max_age_ns: int
    stale_limit_ns: int
    hold_limit_ticks: int
    decelerate_ticks: int
    max_ticks: int
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Dimension:
    name: str
    kind: DimensionKind
    unit: str = ""
    state_index: int | None = None
    at_stop: AtStop


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Robot:
    name: str
    command_low: Floats
    command_high: Floats
    max_step: Floats
    initial_command: Floats
    cameras: tuple[str, ...]
    image_height: int
    image_width: int
    num_proprio: int
    is_simulated: bool
    max_lead: Floats = field(default_factory=_no_floats)
    state_low: Floats = field(default_factory=_no_floats)
    state_high: Floats = field(default_factory=_no_floats)
    dimensions: tuple[Dimension, ...] = ()
    control_hz: int = 0
    stop_ticks: int = 0
    max_picture_age_ns: int = 0
    max_picture_skew_ns: int = 0
    max_picture_still_ns: int = 0
    at_exit: AtExit = AtExit.UNSPECIFIED
    home: Floats = field(default_factory=_no_floats)

    @property
    def action_dim(self) -> int:
        return len(self.command_low)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EpisodeInfo:
    header: Header = Header()
    task: str
    suite: str
    seed: int
    difficulty: str
    instruction: str
    schedule: Schedule
    robot: Robot
    t0_unix_ns: int
    versions: dict[str, str] = field(default_factory=dict)
    policy: str = "servers"
    has_demo: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EpisodeResult:
    header: Header = Header()
    status: TaskStatus
    is_success: bool
    reason: str
    num_ticks: int
    stream_sha256: str = ""
    statistics: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DemoFrame:
    images: tuple[Image, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Member:
    proc: str
    boot_id: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenRequest:
    info: EpisodeInfo
    demo: tuple[DemoFrame, ...] = ()
    members: tuple[Member, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoSampling:
    hz: int = 1
    to_its_end: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelSpec:
    payload: PayloadKind
    consumer: ConsumerKind = ConsumerKind.UNSPECIFIED
    reads_age: bool = False
    null: NullKind = NullKind.UNSPECIFIED


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationWindow:
    video_ticks: tuple[int, ...] = (0,)
    state_ticks: tuple[int, ...] = (0,)
    stride_ticks: int = 0

    @property
    def reach_ticks(self) -> int:
        """How many ticks before the present its oldest observation is."""
        return -min(*self.video_ticks, *self.state_ticks)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contract:
    proc: str
    num_carriers: int = 0
    hidden_size: int = 0
    horizon: int = 0
    action_dim: int = 0
    preferred_codec: ImageCodec = ImageCodec.RAW
    infer_p50_ns: int = 0
    infer_p99_ns: int = 0
    model_hash: str = ""
    is_fake: bool = False
    version: str = ""
    context_tokens: int = 0
    max_context_tokens: int = 0
    demonstrations: DemoSampling | None = None
    boot_id: int = 0
    channels: tuple[ChannelSpec, ...] = ()
    control_hz: int = 0
    window: ObservationWindow | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContractRequest:
    header: Header = Header()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContractReply:
    error: str = ""
    contract: Contract | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenReply:
    error: str = ""
    contract: Contract | None = None
    contracts: tuple[Contract, ...] = ()
    warnings: tuple[str, ...] = ()
    try_again: bool = False
    refusal: Refusal = Refusal.UNSPECIFIED
    members: tuple[Member, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloseRequest:
    header: Header = Header()
    result: EpisodeResult | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloseReply:
    error: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActiveRequest:
    header: Header = Header()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActiveReply:
    error: str = ""
    open: OpenRequest | None = None
    num_queries: int = 0
    owed_query: int | None = None
    owed_invocation: bytes = b""
    observation: bytes = b""
    recent: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JournalRequest:
    header: Header = Header()
    first_query: int
    max_queries: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JournalEntry:
    query: int
    tick: int
    source_ns: int
    observation: bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JournalReply:
    error: str = ""
    entries: tuple[JournalEntry, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimeRequest:
    header: Header = Header()
    t0_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimeReply:
    error: str = ""
    clock_id: str = ""
    t1_ns: int = 0
    t2_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EngageRequest:
    header: Header = Header()
    operator: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EngageReply:
    error: str = ""
    level: str = ""


Message = (
    Observation
    | Query
    | Cognition
    | Stamp
    | Invocation
    | ActionChunk
    | Action
    | Tick
    | Subgoal
    | Event
    | Phase
    | Health
    | EpisodeInfo
    | EpisodeResult
)
"""Messages of topics; every one has a ``header``. The other classes are requests and replies."""
