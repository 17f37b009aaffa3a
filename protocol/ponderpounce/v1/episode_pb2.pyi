from protocol.ponderpounce.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Mode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MODE_UNSPECIFIED: _ClassVar[Mode]
    MODE_REALTIME: _ClassVar[Mode]
    MODE_LOCKSTEP: _ClassVar[Mode]

class DelayKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DELAY_KIND_UNSPECIFIED: _ClassVar[DelayKind]
    DELAY_KIND_MEASURED: _ClassVar[DelayKind]
    DELAY_KIND_FIXED: _ClassVar[DelayKind]
    DELAY_KIND_LOG_NORMAL: _ClassVar[DelayKind]

class DeliveryKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DELIVERY_KIND_UNSPECIFIED: _ClassVar[DeliveryKind]
    DELIVERY_KIND_EVERY: _ClassVar[DeliveryKind]
    DELIVERY_KIND_HELD_TRANSITION: _ClassVar[DeliveryKind]
    DELIVERY_KIND_NULL: _ClassVar[DeliveryKind]

class WaitKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    WAIT_KIND_UNSPECIFIED: _ClassVar[WaitKind]
    WAIT_KIND_STAND_STILL: _ClassVar[WaitKind]
    WAIT_KIND_HOLD: _ClassVar[WaitKind]

class SeamKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SEAM_KIND_UNSPECIFIED: _ClassVar[SeamKind]
    SEAM_KIND_SWITCH: _ClassVar[SeamKind]
    SEAM_KIND_OFFSET_FADE: _ClassVar[SeamKind]
    SEAM_KIND_ENSEMBLE: _ClassVar[SeamKind]

class DimensionKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DIMENSION_KIND_UNSPECIFIED: _ClassVar[DimensionKind]
    DIMENSION_KIND_POSITION: _ClassVar[DimensionKind]
    DIMENSION_KIND_VELOCITY: _ClassVar[DimensionKind]
    DIMENSION_KIND_DELTA: _ClassVar[DimensionKind]
    DIMENSION_KIND_GRIPPER: _ClassVar[DimensionKind]

class AtStop(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    AT_STOP_UNSPECIFIED: _ClassVar[AtStop]
    AT_STOP_HOLD: _ClassVar[AtStop]
    AT_STOP_MEASURED: _ClassVar[AtStop]
    AT_STOP_ZERO: _ClassVar[AtStop]
    AT_STOP_KEEP: _ClassVar[AtStop]

class AtExit(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    AT_EXIT_UNSPECIFIED: _ClassVar[AtExit]
    AT_EXIT_HOLD: _ClassVar[AtExit]
    AT_EXIT_PARK: _ClassVar[AtExit]
    AT_EXIT_RELEASE: _ClassVar[AtExit]

class PayloadKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PAYLOAD_KIND_UNSPECIFIED: _ClassVar[PayloadKind]
    PAYLOAD_KIND_VECTORS: _ClassVar[PayloadKind]
    PAYLOAD_KIND_TEXT: _ClassVar[PayloadKind]
    PAYLOAD_KIND_FRAMES: _ClassVar[PayloadKind]

class ConsumerKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CONSUMER_KIND_UNSPECIFIED: _ClassVar[ConsumerKind]
    CONSUMER_KIND_PREFIX: _ClassVar[ConsumerKind]
    CONSUMER_KIND_PROMPT: _ClassVar[ConsumerKind]
    CONSUMER_KIND_MODULATION: _ClassVar[ConsumerKind]

class NullKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    NULL_KIND_UNSPECIFIED: _ClassVar[NullKind]
    NULL_KIND_LEARNED: _ClassVar[NullKind]
    NULL_KIND_ABSENT: _ClassVar[NullKind]

class Refusal(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    REFUSAL_UNSPECIFIED: _ClassVar[Refusal]
    REFUSAL_NOT_READY: _ClassVar[Refusal]
    REFUSAL_BUSY: _ClassVar[Refusal]
    REFUSAL_CAMERAS: _ClassVar[Refusal]
    REFUSAL_ROBOT: _ClassVar[Refusal]
    REFUSAL_MODELS: _ClassVar[Refusal]
    REFUSAL_SCHEDULE: _ClassVar[Refusal]
    REFUSAL_REQUEST: _ClassVar[Refusal]
MODE_UNSPECIFIED: Mode
MODE_REALTIME: Mode
MODE_LOCKSTEP: Mode
DELAY_KIND_UNSPECIFIED: DelayKind
DELAY_KIND_MEASURED: DelayKind
DELAY_KIND_FIXED: DelayKind
DELAY_KIND_LOG_NORMAL: DelayKind
DELIVERY_KIND_UNSPECIFIED: DeliveryKind
DELIVERY_KIND_EVERY: DeliveryKind
DELIVERY_KIND_HELD_TRANSITION: DeliveryKind
DELIVERY_KIND_NULL: DeliveryKind
WAIT_KIND_UNSPECIFIED: WaitKind
WAIT_KIND_STAND_STILL: WaitKind
WAIT_KIND_HOLD: WaitKind
SEAM_KIND_UNSPECIFIED: SeamKind
SEAM_KIND_SWITCH: SeamKind
SEAM_KIND_OFFSET_FADE: SeamKind
SEAM_KIND_ENSEMBLE: SeamKind
DIMENSION_KIND_UNSPECIFIED: DimensionKind
DIMENSION_KIND_POSITION: DimensionKind
DIMENSION_KIND_VELOCITY: DimensionKind
DIMENSION_KIND_DELTA: DimensionKind
DIMENSION_KIND_GRIPPER: DimensionKind
AT_STOP_UNSPECIFIED: AtStop
AT_STOP_HOLD: AtStop
AT_STOP_MEASURED: AtStop
AT_STOP_ZERO: AtStop
AT_STOP_KEEP: AtStop
AT_EXIT_UNSPECIFIED: AtExit
AT_EXIT_HOLD: AtExit
AT_EXIT_PARK: AtExit
AT_EXIT_RELEASE: AtExit
PAYLOAD_KIND_UNSPECIFIED: PayloadKind
PAYLOAD_KIND_VECTORS: PayloadKind
PAYLOAD_KIND_TEXT: PayloadKind
PAYLOAD_KIND_FRAMES: PayloadKind
CONSUMER_KIND_UNSPECIFIED: ConsumerKind
CONSUMER_KIND_PREFIX: ConsumerKind
CONSUMER_KIND_PROMPT: ConsumerKind
CONSUMER_KIND_MODULATION: ConsumerKind
NULL_KIND_UNSPECIFIED: NullKind
NULL_KIND_LEARNED: NullKind
NULL_KIND_ABSENT: NullKind
REFUSAL_UNSPECIFIED: Refusal
REFUSAL_NOT_READY: Refusal
REFUSAL_BUSY: Refusal
REFUSAL_CAMERAS: Refusal
REFUSAL_ROBOT: Refusal
REFUSAL_MODELS: Refusal
REFUSAL_SCHEDULE: Refusal
REFUSAL_REQUEST: Refusal

class Delay(_message.Message):
    __slots__ = ("kind", "mean_ns", "sigma")
    KIND_FIELD_NUMBER: _ClassVar[int]
    MEAN_NS_FIELD_NUMBER: _ClassVar[int]
    SIGMA_FIELD_NUMBER: _ClassVar[int]
    kind: DelayKind
    mean_ns: int
    sigma: float
    def __init__(self, kind: _Optional[_Union[DelayKind, str]] = ..., mean_ns: _Optional[int] = ..., sigma: _Optional[float] = ...) -> None: ...

class Delivery(_message.Message):
    __slots__ = ("kind", "reported_age_ns")
    KIND_FIELD_NUMBER: _ClassVar[int]
    REPORTED_AGE_NS_FIELD_NUMBER: _ClassVar[int]
    kind: DeliveryKind
    reported_age_ns: int
    def __init__(self, kind: _Optional[_Union[DeliveryKind, str]] = ..., reported_age_ns: _Optional[int] = ...) -> None: ...

class Seam(_message.Message):
    __slots__ = ("kind", "fade_ticks", "ensemble_decay")
    KIND_FIELD_NUMBER: _ClassVar[int]
    FADE_TICKS_FIELD_NUMBER: _ClassVar[int]
    ENSEMBLE_DECAY_FIELD_NUMBER: _ClassVar[int]
    kind: SeamKind
    fade_ticks: int
    ensemble_decay: float
    def __init__(self, kind: _Optional[_Union[SeamKind, str]] = ..., fade_ticks: _Optional[int] = ..., ensemble_decay: _Optional[float] = ...) -> None: ...

class Schedule(_message.Message):
    __slots__ = ("mode", "control_hz", "horizon", "query_period_ns", "invoke_period_ticks", "query_delay", "invoke_delay", "delivery", "wait", "seam", "max_age_ns", "stale_limit_ns", "hold_limit_ticks", "decelerate_ticks", "max_ticks", "seed")
    MODE_FIELD_NUMBER: _ClassVar[int]
    CONTROL_HZ_FIELD_NUMBER: _ClassVar[int]
    HORIZON_FIELD_NUMBER: _ClassVar[int]
    QUERY_PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    INVOKE_PERIOD_TICKS_FIELD_NUMBER: _ClassVar[int]
    QUERY_DELAY_FIELD_NUMBER: _ClassVar[int]
    INVOKE_DELAY_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    WAIT_FIELD_NUMBER: _ClassVar[int]
    SEAM_FIELD_NUMBER: _ClassVar[int]
    MAX_AGE_NS_FIELD_NUMBER: _ClassVar[int]
    STALE_LIMIT_NS_FIELD_NUMBER: _ClassVar[int]
    HOLD_LIMIT_TICKS_FIELD_NUMBER: _ClassVar[int]
    DECELERATE_TICKS_FIELD_NUMBER: _ClassVar[int]
    MAX_TICKS_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    mode: Mode
    control_hz: int
    horizon: int
    query_period_ns: int
    invoke_period_ticks: int
    query_delay: Delay
    invoke_delay: Delay
    delivery: Delivery
    wait: WaitKind
    seam: Seam
    max_age_ns: int
    stale_limit_ns: int
    hold_limit_ticks: int
    decelerate_ticks: int
    max_ticks: int
    seed: int
    def __init__(self, mode: _Optional[_Union[Mode, str]] = ..., control_hz: _Optional[int] = ..., horizon: _Optional[int] = ..., query_period_ns: _Optional[int] = ..., invoke_period_ticks: _Optional[int] = ..., query_delay: _Optional[_Union[Delay, _Mapping]] = ..., invoke_delay: _Optional[_Union[Delay, _Mapping]] = ..., delivery: _Optional[_Union[Delivery, _Mapping]] = ..., wait: _Optional[_Union[WaitKind, str]] = ..., seam: _Optional[_Union[Seam, _Mapping]] = ..., max_age_ns: _Optional[int] = ..., stale_limit_ns: _Optional[int] = ..., hold_limit_ticks: _Optional[int] = ..., decelerate_ticks: _Optional[int] = ..., max_ticks: _Optional[int] = ..., seed: _Optional[int] = ...) -> None: ...

class Dimension(_message.Message):
    __slots__ = ("name", "kind", "unit", "state_index", "at_stop")
    NAME_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    STATE_INDEX_FIELD_NUMBER: _ClassVar[int]
    AT_STOP_FIELD_NUMBER: _ClassVar[int]
    name: str
    kind: DimensionKind
    unit: str
    state_index: int
    at_stop: AtStop
    def __init__(self, name: _Optional[str] = ..., kind: _Optional[_Union[DimensionKind, str]] = ..., unit: _Optional[str] = ..., state_index: _Optional[int] = ..., at_stop: _Optional[_Union[AtStop, str]] = ...) -> None: ...

class Robot(_message.Message):
    __slots__ = ("name", "command_low", "command_high", "max_step", "initial_command", "cameras", "image_height", "image_width", "num_proprio", "is_simulated", "max_lead", "state_low", "state_high", "dimensions", "control_hz", "stop_ticks", "max_picture_age_ns", "max_picture_skew_ns", "max_picture_still_ns", "at_exit", "home")
    NAME_FIELD_NUMBER: _ClassVar[int]
    COMMAND_LOW_FIELD_NUMBER: _ClassVar[int]
    COMMAND_HIGH_FIELD_NUMBER: _ClassVar[int]
    MAX_STEP_FIELD_NUMBER: _ClassVar[int]
    INITIAL_COMMAND_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    IMAGE_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    NUM_PROPRIO_FIELD_NUMBER: _ClassVar[int]
    IS_SIMULATED_FIELD_NUMBER: _ClassVar[int]
    MAX_LEAD_FIELD_NUMBER: _ClassVar[int]
    STATE_LOW_FIELD_NUMBER: _ClassVar[int]
    STATE_HIGH_FIELD_NUMBER: _ClassVar[int]
    DIMENSIONS_FIELD_NUMBER: _ClassVar[int]
    CONTROL_HZ_FIELD_NUMBER: _ClassVar[int]
    STOP_TICKS_FIELD_NUMBER: _ClassVar[int]
    MAX_PICTURE_AGE_NS_FIELD_NUMBER: _ClassVar[int]
    MAX_PICTURE_SKEW_NS_FIELD_NUMBER: _ClassVar[int]
    MAX_PICTURE_STILL_NS_FIELD_NUMBER: _ClassVar[int]
    AT_EXIT_FIELD_NUMBER: _ClassVar[int]
    HOME_FIELD_NUMBER: _ClassVar[int]
    name: str
    command_low: _containers.RepeatedScalarFieldContainer[float]
    command_high: _containers.RepeatedScalarFieldContainer[float]
    max_step: _containers.RepeatedScalarFieldContainer[float]
    initial_command: _containers.RepeatedScalarFieldContainer[float]
    cameras: _containers.RepeatedScalarFieldContainer[str]
    image_height: int
    image_width: int
    num_proprio: int
    is_simulated: bool
    max_lead: _containers.RepeatedScalarFieldContainer[float]
    state_low: _containers.RepeatedScalarFieldContainer[float]
    state_high: _containers.RepeatedScalarFieldContainer[float]
    dimensions: _containers.RepeatedCompositeFieldContainer[Dimension]
    control_hz: int
    stop_ticks: int
    max_picture_age_ns: int
    max_picture_skew_ns: int
    max_picture_still_ns: int
    at_exit: AtExit
    home: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, name: _Optional[str] = ..., command_low: _Optional[_Iterable[float]] = ..., command_high: _Optional[_Iterable[float]] = ..., max_step: _Optional[_Iterable[float]] = ..., initial_command: _Optional[_Iterable[float]] = ..., cameras: _Optional[_Iterable[str]] = ..., image_height: _Optional[int] = ..., image_width: _Optional[int] = ..., num_proprio: _Optional[int] = ..., is_simulated: _Optional[bool] = ..., max_lead: _Optional[_Iterable[float]] = ..., state_low: _Optional[_Iterable[float]] = ..., state_high: _Optional[_Iterable[float]] = ..., dimensions: _Optional[_Iterable[_Union[Dimension, _Mapping]]] = ..., control_hz: _Optional[int] = ..., stop_ticks: _Optional[int] = ..., max_picture_age_ns: _Optional[int] = ..., max_picture_skew_ns: _Optional[int] = ..., max_picture_still_ns: _Optional[int] = ..., at_exit: _Optional[_Union[AtExit, str]] = ..., home: _Optional[_Iterable[float]] = ...) -> None: ...

class EpisodeInfo(_message.Message):
    __slots__ = ("header", "task", "suite", "seed", "difficulty", "instruction", "schedule", "robot", "t0_unix_ns", "versions", "policy", "has_demo")
    class VersionsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    HEADER_FIELD_NUMBER: _ClassVar[int]
    TASK_FIELD_NUMBER: _ClassVar[int]
    SUITE_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    DIFFICULTY_FIELD_NUMBER: _ClassVar[int]
    INSTRUCTION_FIELD_NUMBER: _ClassVar[int]
    SCHEDULE_FIELD_NUMBER: _ClassVar[int]
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    T0_UNIX_NS_FIELD_NUMBER: _ClassVar[int]
    VERSIONS_FIELD_NUMBER: _ClassVar[int]
    POLICY_FIELD_NUMBER: _ClassVar[int]
    HAS_DEMO_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    task: str
    suite: str
    seed: int
    difficulty: str
    instruction: str
    schedule: Schedule
    robot: Robot
    t0_unix_ns: int
    versions: _containers.ScalarMap[str, str]
    policy: str
    has_demo: bool
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., task: _Optional[str] = ..., suite: _Optional[str] = ..., seed: _Optional[int] = ..., difficulty: _Optional[str] = ..., instruction: _Optional[str] = ..., schedule: _Optional[_Union[Schedule, _Mapping]] = ..., robot: _Optional[_Union[Robot, _Mapping]] = ..., t0_unix_ns: _Optional[int] = ..., versions: _Optional[_Mapping[str, str]] = ..., policy: _Optional[str] = ..., has_demo: _Optional[bool] = ...) -> None: ...

class EpisodeResult(_message.Message):
    __slots__ = ("header", "status", "is_success", "reason", "num_ticks", "stream_sha256", "statistics")
    class StatisticsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    IS_SUCCESS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    NUM_TICKS_FIELD_NUMBER: _ClassVar[int]
    STREAM_SHA256_FIELD_NUMBER: _ClassVar[int]
    STATISTICS_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    status: _common_pb2.TaskStatus
    is_success: bool
    reason: str
    num_ticks: int
    stream_sha256: str
    statistics: _containers.ScalarMap[str, float]
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., status: _Optional[_Union[_common_pb2.TaskStatus, str]] = ..., is_success: _Optional[bool] = ..., reason: _Optional[str] = ..., num_ticks: _Optional[int] = ..., stream_sha256: _Optional[str] = ..., statistics: _Optional[_Mapping[str, float]] = ...) -> None: ...

class DemoFrame(_message.Message):
    __slots__ = ("images",)
    IMAGES_FIELD_NUMBER: _ClassVar[int]
    images: _containers.RepeatedCompositeFieldContainer[_common_pb2.Image]
    def __init__(self, images: _Optional[_Iterable[_Union[_common_pb2.Image, _Mapping]]] = ...) -> None: ...

class Member(_message.Message):
    __slots__ = ("proc", "boot_id")
    PROC_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    proc: str
    boot_id: int
    def __init__(self, proc: _Optional[str] = ..., boot_id: _Optional[int] = ...) -> None: ...

class OpenRequest(_message.Message):
    __slots__ = ("info", "demo", "members")
    INFO_FIELD_NUMBER: _ClassVar[int]
    DEMO_FIELD_NUMBER: _ClassVar[int]
    MEMBERS_FIELD_NUMBER: _ClassVar[int]
    info: EpisodeInfo
    demo: _containers.RepeatedCompositeFieldContainer[DemoFrame]
    members: _containers.RepeatedCompositeFieldContainer[Member]
    def __init__(self, info: _Optional[_Union[EpisodeInfo, _Mapping]] = ..., demo: _Optional[_Iterable[_Union[DemoFrame, _Mapping]]] = ..., members: _Optional[_Iterable[_Union[Member, _Mapping]]] = ...) -> None: ...

class DemoSampling(_message.Message):
    __slots__ = ("hz", "to_its_end")
    HZ_FIELD_NUMBER: _ClassVar[int]
    TO_ITS_END_FIELD_NUMBER: _ClassVar[int]
    hz: int
    to_its_end: bool
    def __init__(self, hz: _Optional[int] = ..., to_its_end: _Optional[bool] = ...) -> None: ...

class ChannelSpec(_message.Message):
    __slots__ = ("payload", "consumer", "reads_age", "null")
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    CONSUMER_FIELD_NUMBER: _ClassVar[int]
    READS_AGE_FIELD_NUMBER: _ClassVar[int]
    NULL_FIELD_NUMBER: _ClassVar[int]
    payload: PayloadKind
    consumer: ConsumerKind
    reads_age: bool
    null: NullKind
    def __init__(self, payload: _Optional[_Union[PayloadKind, str]] = ..., consumer: _Optional[_Union[ConsumerKind, str]] = ..., reads_age: _Optional[bool] = ..., null: _Optional[_Union[NullKind, str]] = ...) -> None: ...

class ObservationWindow(_message.Message):
    __slots__ = ("video_ticks", "state_ticks", "stride_ticks")
    VIDEO_TICKS_FIELD_NUMBER: _ClassVar[int]
    STATE_TICKS_FIELD_NUMBER: _ClassVar[int]
    STRIDE_TICKS_FIELD_NUMBER: _ClassVar[int]
    video_ticks: _containers.RepeatedScalarFieldContainer[int]
    state_ticks: _containers.RepeatedScalarFieldContainer[int]
    stride_ticks: int
    def __init__(self, video_ticks: _Optional[_Iterable[int]] = ..., state_ticks: _Optional[_Iterable[int]] = ..., stride_ticks: _Optional[int] = ...) -> None: ...

class Contract(_message.Message):
    __slots__ = ("proc", "num_carriers", "hidden_size", "horizon", "action_dim", "preferred_codec", "infer_p50_ns", "infer_p99_ns", "model_hash", "is_fake", "version", "context_tokens", "max_context_tokens", "demonstrations", "boot_id", "channels", "control_hz", "window")
    PROC_FIELD_NUMBER: _ClassVar[int]
    NUM_CARRIERS_FIELD_NUMBER: _ClassVar[int]
    HIDDEN_SIZE_FIELD_NUMBER: _ClassVar[int]
    HORIZON_FIELD_NUMBER: _ClassVar[int]
    ACTION_DIM_FIELD_NUMBER: _ClassVar[int]
    PREFERRED_CODEC_FIELD_NUMBER: _ClassVar[int]
    INFER_P50_NS_FIELD_NUMBER: _ClassVar[int]
    INFER_P99_NS_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    IS_FAKE_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    CONTEXT_TOKENS_FIELD_NUMBER: _ClassVar[int]
    MAX_CONTEXT_TOKENS_FIELD_NUMBER: _ClassVar[int]
    DEMONSTRATIONS_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    CONTROL_HZ_FIELD_NUMBER: _ClassVar[int]
    WINDOW_FIELD_NUMBER: _ClassVar[int]
    proc: str
    num_carriers: int
    hidden_size: int
    horizon: int
    action_dim: int
    preferred_codec: _common_pb2.ImageCodec
    infer_p50_ns: int
    infer_p99_ns: int
    model_hash: str
    is_fake: bool
    version: str
    context_tokens: int
    max_context_tokens: int
    demonstrations: DemoSampling
    boot_id: int
    channels: _containers.RepeatedCompositeFieldContainer[ChannelSpec]
    control_hz: int
    window: ObservationWindow
    def __init__(self, proc: _Optional[str] = ..., num_carriers: _Optional[int] = ..., hidden_size: _Optional[int] = ..., horizon: _Optional[int] = ..., action_dim: _Optional[int] = ..., preferred_codec: _Optional[_Union[_common_pb2.ImageCodec, str]] = ..., infer_p50_ns: _Optional[int] = ..., infer_p99_ns: _Optional[int] = ..., model_hash: _Optional[str] = ..., is_fake: _Optional[bool] = ..., version: _Optional[str] = ..., context_tokens: _Optional[int] = ..., max_context_tokens: _Optional[int] = ..., demonstrations: _Optional[_Union[DemoSampling, _Mapping]] = ..., boot_id: _Optional[int] = ..., channels: _Optional[_Iterable[_Union[ChannelSpec, _Mapping]]] = ..., control_hz: _Optional[int] = ..., window: _Optional[_Union[ObservationWindow, _Mapping]] = ...) -> None: ...

class ContractRequest(_message.Message):
    __slots__ = ("header",)
    HEADER_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ...) -> None: ...

class ContractReply(_message.Message):
    __slots__ = ("error", "contract")
    ERROR_FIELD_NUMBER: _ClassVar[int]
    CONTRACT_FIELD_NUMBER: _ClassVar[int]
    error: str
    contract: Contract
    def __init__(self, error: _Optional[str] = ..., contract: _Optional[_Union[Contract, _Mapping]] = ...) -> None: ...

class OpenReply(_message.Message):
    __slots__ = ("error", "contract", "contracts", "warnings", "try_again", "refusal", "members")
    ERROR_FIELD_NUMBER: _ClassVar[int]
    CONTRACT_FIELD_NUMBER: _ClassVar[int]
    CONTRACTS_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    TRY_AGAIN_FIELD_NUMBER: _ClassVar[int]
    REFUSAL_FIELD_NUMBER: _ClassVar[int]
    MEMBERS_FIELD_NUMBER: _ClassVar[int]
    error: str
    contract: Contract
    contracts: _containers.RepeatedCompositeFieldContainer[Contract]
    warnings: _containers.RepeatedScalarFieldContainer[str]
    try_again: bool
    refusal: Refusal
    members: _containers.RepeatedCompositeFieldContainer[Member]
    def __init__(self, error: _Optional[str] = ..., contract: _Optional[_Union[Contract, _Mapping]] = ..., contracts: _Optional[_Iterable[_Union[Contract, _Mapping]]] = ..., warnings: _Optional[_Iterable[str]] = ..., try_again: _Optional[bool] = ..., refusal: _Optional[_Union[Refusal, str]] = ..., members: _Optional[_Iterable[_Union[Member, _Mapping]]] = ...) -> None: ...

class CloseRequest(_message.Message):
    __slots__ = ("header", "result")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    result: EpisodeResult
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., result: _Optional[_Union[EpisodeResult, _Mapping]] = ...) -> None: ...

class CloseReply(_message.Message):
    __slots__ = ("error",)
    ERROR_FIELD_NUMBER: _ClassVar[int]
    error: str
    def __init__(self, error: _Optional[str] = ...) -> None: ...

class ActiveRequest(_message.Message):
    __slots__ = ("header",)
    HEADER_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ...) -> None: ...

class ActiveReply(_message.Message):
    __slots__ = ("error", "open", "num_queries", "owed_query", "owed_invocation", "observation", "recent")
    ERROR_FIELD_NUMBER: _ClassVar[int]
    OPEN_FIELD_NUMBER: _ClassVar[int]
    NUM_QUERIES_FIELD_NUMBER: _ClassVar[int]
    OWED_QUERY_FIELD_NUMBER: _ClassVar[int]
    OWED_INVOCATION_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    RECENT_FIELD_NUMBER: _ClassVar[int]
    error: str
    open: OpenRequest
    num_queries: int
    owed_query: int
    owed_invocation: bytes
    observation: bytes
    recent: _containers.RepeatedScalarFieldContainer[bytes]
    def __init__(self, error: _Optional[str] = ..., open: _Optional[_Union[OpenRequest, _Mapping]] = ..., num_queries: _Optional[int] = ..., owed_query: _Optional[int] = ..., owed_invocation: _Optional[bytes] = ..., observation: _Optional[bytes] = ..., recent: _Optional[_Iterable[bytes]] = ...) -> None: ...

class JournalRequest(_message.Message):
    __slots__ = ("header", "first_query", "max_queries")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FIRST_QUERY_FIELD_NUMBER: _ClassVar[int]
    MAX_QUERIES_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    first_query: int
    max_queries: int
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., first_query: _Optional[int] = ..., max_queries: _Optional[int] = ...) -> None: ...

class JournalEntry(_message.Message):
    __slots__ = ("query", "tick", "source_ns", "observation")
    QUERY_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    query: int
    tick: int
    source_ns: int
    observation: bytes
    def __init__(self, query: _Optional[int] = ..., tick: _Optional[int] = ..., source_ns: _Optional[int] = ..., observation: _Optional[bytes] = ...) -> None: ...

class JournalReply(_message.Message):
    __slots__ = ("error", "entries")
    ERROR_FIELD_NUMBER: _ClassVar[int]
    ENTRIES_FIELD_NUMBER: _ClassVar[int]
    error: str
    entries: _containers.RepeatedCompositeFieldContainer[JournalEntry]
    def __init__(self, error: _Optional[str] = ..., entries: _Optional[_Iterable[_Union[JournalEntry, _Mapping]]] = ...) -> None: ...

class TimeRequest(_message.Message):
    __slots__ = ("header", "t0_ns")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    T0_NS_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    t0_ns: int
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., t0_ns: _Optional[int] = ...) -> None: ...

class TimeReply(_message.Message):
    __slots__ = ("error", "clock_id", "t1_ns", "t2_ns")
    ERROR_FIELD_NUMBER: _ClassVar[int]
    CLOCK_ID_FIELD_NUMBER: _ClassVar[int]
    T1_NS_FIELD_NUMBER: _ClassVar[int]
    T2_NS_FIELD_NUMBER: _ClassVar[int]
    error: str
    clock_id: str
    t1_ns: int
    t2_ns: int
    def __init__(self, error: _Optional[str] = ..., clock_id: _Optional[str] = ..., t1_ns: _Optional[int] = ..., t2_ns: _Optional[int] = ...) -> None: ...

class EngageRequest(_message.Message):
    __slots__ = ("header", "operator")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    OPERATOR_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    operator: str
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., operator: _Optional[str] = ...) -> None: ...

class EngageReply(_message.Message):
    __slots__ = ("error", "level")
    ERROR_FIELD_NUMBER: _ClassVar[int]
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    error: str
    level: str
    def __init__(self, error: _Optional[str] = ..., level: _Optional[str] = ...) -> None: ...
