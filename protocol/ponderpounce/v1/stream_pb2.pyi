from protocol.ponderpounce.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class RobotState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ROBOT_STATE_UNSPECIFIED: _ClassVar[RobotState]
    ROBOT_STATE_OK: _ClassVar[RobotState]
    ROBOT_STATE_USER_STOP: _ClassVar[RobotState]
    ROBOT_STATE_PROTECTIVE_STOP: _ClassVar[RobotState]
    ROBOT_STATE_FAULT: _ClassVar[RobotState]
    ROBOT_STATE_TORQUE_OFF: _ClassVar[RobotState]

class StampKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STAMP_KIND_UNSPECIFIED: _ClassVar[StampKind]
    STAMP_KIND_COGNITION: _ClassVar[StampKind]
    STAMP_KIND_CHUNK: _ClassVar[StampKind]

class ActionSpace(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ACTION_SPACE_UNSPECIFIED: _ClassVar[ActionSpace]
    ACTION_SPACE_JOINT_TARGET: _ClassVar[ActionSpace]
    ACTION_SPACE_EE_POSE: _ClassVar[ActionSpace]

class Level(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LEVEL_UNSPECIFIED: _ClassVar[Level]
    LEVEL_PLAY: _ClassVar[Level]
    LEVEL_STALE: _ClassVar[Level]
    LEVEL_HOLD: _ClassVar[Level]
    LEVEL_DECELERATE: _ClassVar[Level]
    LEVEL_STOPPED: _ClassVar[Level]
    LEVEL_SKIPPED: _ClassVar[Level]

class SubgoalKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SUBGOAL_KIND_UNSPECIFIED: _ClassVar[SubgoalKind]
    SUBGOAL_KIND_SUBGOAL: _ClassVar[SubgoalKind]
    SUBGOAL_KIND_DEMO_REASONING: _ClassVar[SubgoalKind]
    SUBGOAL_KIND_TASK_SIMPLE: _ClassVar[SubgoalKind]
    SUBGOAL_KIND_TASK_GROUNDED: _ClassVar[SubgoalKind]

class Severity(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SEVERITY_UNSPECIFIED: _ClassVar[Severity]
    SEVERITY_INFO: _ClassVar[Severity]
    SEVERITY_WARNING: _ClassVar[Severity]
    SEVERITY_ERROR: _ClassVar[Severity]

class ServingState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SERVING_STATE_UNSPECIFIED: _ClassVar[ServingState]
    SERVING_STATE_LOADING: _ClassVar[ServingState]
    SERVING_STATE_WARMING: _ClassVar[ServingState]
    SERVING_STATE_READY: _ClassVar[ServingState]
    SERVING_STATE_FAILED: _ClassVar[ServingState]
    SERVING_STATE_CLOSING: _ClassVar[ServingState]
ROBOT_STATE_UNSPECIFIED: RobotState
ROBOT_STATE_OK: RobotState
ROBOT_STATE_USER_STOP: RobotState
ROBOT_STATE_PROTECTIVE_STOP: RobotState
ROBOT_STATE_FAULT: RobotState
ROBOT_STATE_TORQUE_OFF: RobotState
STAMP_KIND_UNSPECIFIED: StampKind
STAMP_KIND_COGNITION: StampKind
STAMP_KIND_CHUNK: StampKind
ACTION_SPACE_UNSPECIFIED: ActionSpace
ACTION_SPACE_JOINT_TARGET: ActionSpace
ACTION_SPACE_EE_POSE: ActionSpace
LEVEL_UNSPECIFIED: Level
LEVEL_PLAY: Level
LEVEL_STALE: Level
LEVEL_HOLD: Level
LEVEL_DECELERATE: Level
LEVEL_STOPPED: Level
LEVEL_SKIPPED: Level
SUBGOAL_KIND_UNSPECIFIED: SubgoalKind
SUBGOAL_KIND_SUBGOAL: SubgoalKind
SUBGOAL_KIND_DEMO_REASONING: SubgoalKind
SUBGOAL_KIND_TASK_SIMPLE: SubgoalKind
SUBGOAL_KIND_TASK_GROUNDED: SubgoalKind
SEVERITY_UNSPECIFIED: Severity
SEVERITY_INFO: Severity
SEVERITY_WARNING: Severity
SEVERITY_ERROR: Severity
SERVING_STATE_UNSPECIFIED: ServingState
SERVING_STATE_LOADING: ServingState
SERVING_STATE_WARMING: ServingState
SERVING_STATE_READY: ServingState
SERVING_STATE_FAILED: ServingState
SERVING_STATE_CLOSING: ServingState

class Observation(_message.Message):
    __slots__ = ("header", "tick", "source_ns", "proprio", "images", "status", "reason", "robot_state", "robot_text", "captured_ns")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    PROPRIO_FIELD_NUMBER: _ClassVar[int]
    IMAGES_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    ROBOT_STATE_FIELD_NUMBER: _ClassVar[int]
    ROBOT_TEXT_FIELD_NUMBER: _ClassVar[int]
    CAPTURED_NS_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    tick: int
    source_ns: int
    proprio: _containers.RepeatedScalarFieldContainer[float]
    images: _containers.RepeatedCompositeFieldContainer[_common_pb2.Image]
    status: _common_pb2.TaskStatus
    reason: str
    robot_state: RobotState
    robot_text: str
    captured_ns: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., tick: _Optional[int] = ..., source_ns: _Optional[int] = ..., proprio: _Optional[_Iterable[float]] = ..., images: _Optional[_Iterable[_Union[_common_pb2.Image, _Mapping]]] = ..., status: _Optional[_Union[_common_pb2.TaskStatus, str]] = ..., reason: _Optional[str] = ..., robot_state: _Optional[_Union[RobotState, str]] = ..., robot_text: _Optional[str] = ..., captured_ns: _Optional[_Iterable[int]] = ...) -> None: ...

class Query(_message.Message):
    __slots__ = ("header", "query", "tick", "source_ns")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    QUERY_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    query: int
    tick: int
    source_ns: int
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., query: _Optional[int] = ..., tick: _Optional[int] = ..., source_ns: _Optional[int] = ...) -> None: ...

class Cognition(_message.Message):
    __slots__ = ("header", "query", "tick", "source_ns", "ready_ns", "vector", "is_transition", "context_tokens", "infer_ns", "norm", "model_hash", "is_fake", "text", "text_source_ns", "gate_score")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    QUERY_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    READY_NS_FIELD_NUMBER: _ClassVar[int]
    VECTOR_FIELD_NUMBER: _ClassVar[int]
    IS_TRANSITION_FIELD_NUMBER: _ClassVar[int]
    CONTEXT_TOKENS_FIELD_NUMBER: _ClassVar[int]
    INFER_NS_FIELD_NUMBER: _ClassVar[int]
    NORM_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    IS_FAKE_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    TEXT_SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    GATE_SCORE_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    query: int
    tick: int
    source_ns: int
    ready_ns: int
    vector: _common_pb2.Tensor
    is_transition: bool
    context_tokens: int
    infer_ns: int
    norm: float
    model_hash: str
    is_fake: bool
    text: str
    text_source_ns: int
    gate_score: float
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., query: _Optional[int] = ..., tick: _Optional[int] = ..., source_ns: _Optional[int] = ..., ready_ns: _Optional[int] = ..., vector: _Optional[_Union[_common_pb2.Tensor, _Mapping]] = ..., is_transition: _Optional[bool] = ..., context_tokens: _Optional[int] = ..., infer_ns: _Optional[int] = ..., norm: _Optional[float] = ..., model_hash: _Optional[str] = ..., is_fake: _Optional[bool] = ..., text: _Optional[str] = ..., text_source_ns: _Optional[int] = ..., gate_score: _Optional[float] = ...) -> None: ...

class Stamp(_message.Message):
    __slots__ = ("header", "kind", "index", "source_ns", "ready_ns", "arrived_ns", "is_transition")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    READY_NS_FIELD_NUMBER: _ClassVar[int]
    ARRIVED_NS_FIELD_NUMBER: _ClassVar[int]
    IS_TRANSITION_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    kind: StampKind
    index: int
    source_ns: int
    ready_ns: int
    arrived_ns: int
    is_transition: bool
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., kind: _Optional[_Union[StampKind, str]] = ..., index: _Optional[int] = ..., source_ns: _Optional[int] = ..., ready_ns: _Optional[int] = ..., arrived_ns: _Optional[int] = ..., is_transition: _Optional[bool] = ...) -> None: ...

class Invocation(_message.Message):
    __slots__ = ("header", "invocation", "tick", "now_ns", "ref_query", "age_ns", "cognition", "seed", "previous_rows", "committed_rows", "num_samples", "text", "text_age_ns")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    INVOCATION_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    NOW_NS_FIELD_NUMBER: _ClassVar[int]
    REF_QUERY_FIELD_NUMBER: _ClassVar[int]
    AGE_NS_FIELD_NUMBER: _ClassVar[int]
    COGNITION_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_ROWS_FIELD_NUMBER: _ClassVar[int]
    COMMITTED_ROWS_FIELD_NUMBER: _ClassVar[int]
    NUM_SAMPLES_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    TEXT_AGE_NS_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    invocation: int
    tick: int
    now_ns: int
    ref_query: int
    age_ns: int
    cognition: _common_pb2.Tensor
    seed: int
    previous_rows: _containers.RepeatedScalarFieldContainer[float]
    committed_rows: int
    num_samples: int
    text: str
    text_age_ns: int
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., invocation: _Optional[int] = ..., tick: _Optional[int] = ..., now_ns: _Optional[int] = ..., ref_query: _Optional[int] = ..., age_ns: _Optional[int] = ..., cognition: _Optional[_Union[_common_pb2.Tensor, _Mapping]] = ..., seed: _Optional[int] = ..., previous_rows: _Optional[_Iterable[float]] = ..., committed_rows: _Optional[int] = ..., num_samples: _Optional[int] = ..., text: _Optional[str] = ..., text_age_ns: _Optional[int] = ...) -> None: ...

class ActionChunk(_message.Message):
    __slots__ = ("header", "invocation", "t_row0", "horizon", "action_dim", "dt_ns", "rows", "source_ns", "ref_query", "age_ns", "infer_ns", "action_space", "reference_state", "seed", "model_hash", "is_fake", "previous_rows", "committed_rows", "features", "padded_video_ticks", "padded_state_ticks")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    INVOCATION_FIELD_NUMBER: _ClassVar[int]
    T_ROW0_FIELD_NUMBER: _ClassVar[int]
    HORIZON_FIELD_NUMBER: _ClassVar[int]
    ACTION_DIM_FIELD_NUMBER: _ClassVar[int]
    DT_NS_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    REF_QUERY_FIELD_NUMBER: _ClassVar[int]
    AGE_NS_FIELD_NUMBER: _ClassVar[int]
    INFER_NS_FIELD_NUMBER: _ClassVar[int]
    ACTION_SPACE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_STATE_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    IS_FAKE_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_ROWS_FIELD_NUMBER: _ClassVar[int]
    COMMITTED_ROWS_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    PADDED_VIDEO_TICKS_FIELD_NUMBER: _ClassVar[int]
    PADDED_STATE_TICKS_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    invocation: int
    t_row0: int
    horizon: int
    action_dim: int
    dt_ns: int
    rows: _containers.RepeatedScalarFieldContainer[float]
    source_ns: int
    ref_query: int
    age_ns: int
    infer_ns: int
    action_space: ActionSpace
    reference_state: _containers.RepeatedScalarFieldContainer[float]
    seed: int
    model_hash: str
    is_fake: bool
    previous_rows: _containers.RepeatedScalarFieldContainer[float]
    committed_rows: int
    features: bytes
    padded_video_ticks: _containers.RepeatedScalarFieldContainer[int]
    padded_state_ticks: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., invocation: _Optional[int] = ..., t_row0: _Optional[int] = ..., horizon: _Optional[int] = ..., action_dim: _Optional[int] = ..., dt_ns: _Optional[int] = ..., rows: _Optional[_Iterable[float]] = ..., source_ns: _Optional[int] = ..., ref_query: _Optional[int] = ..., age_ns: _Optional[int] = ..., infer_ns: _Optional[int] = ..., action_space: _Optional[_Union[ActionSpace, str]] = ..., reference_state: _Optional[_Iterable[float]] = ..., seed: _Optional[int] = ..., model_hash: _Optional[str] = ..., is_fake: _Optional[bool] = ..., previous_rows: _Optional[_Iterable[float]] = ..., committed_rows: _Optional[int] = ..., features: _Optional[bytes] = ..., padded_video_ticks: _Optional[_Iterable[int]] = ..., padded_state_ticks: _Optional[_Iterable[int]] = ...) -> None: ...

class Action(_message.Message):
    __slots__ = ("header", "tick", "deadline_ns", "level", "values")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_NS_FIELD_NUMBER: _ClassVar[int]
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    tick: int
    deadline_ns: int
    level: Level
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., tick: _Optional[int] = ..., deadline_ns: _Optional[int] = ..., level: _Optional[_Union[Level, str]] = ..., values: _Optional[_Iterable[float]] = ...) -> None: ...

class Tick(_message.Message):
    __slots__ = ("header", "tick", "deadline_ns", "decided_ns", "late_ns", "level", "invocation", "t_row0", "row", "ref_query", "age_ns", "observation_tick", "state", "action", "raw_row", "limits_hit", "seam_jump", "age_ms", "late_ms", "robot_state", "picture_age_ns", "picture_still_ns")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_NS_FIELD_NUMBER: _ClassVar[int]
    DECIDED_NS_FIELD_NUMBER: _ClassVar[int]
    LATE_NS_FIELD_NUMBER: _ClassVar[int]
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    INVOCATION_FIELD_NUMBER: _ClassVar[int]
    T_ROW0_FIELD_NUMBER: _ClassVar[int]
    ROW_FIELD_NUMBER: _ClassVar[int]
    REF_QUERY_FIELD_NUMBER: _ClassVar[int]
    AGE_NS_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_TICK_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    RAW_ROW_FIELD_NUMBER: _ClassVar[int]
    LIMITS_HIT_FIELD_NUMBER: _ClassVar[int]
    SEAM_JUMP_FIELD_NUMBER: _ClassVar[int]
    AGE_MS_FIELD_NUMBER: _ClassVar[int]
    LATE_MS_FIELD_NUMBER: _ClassVar[int]
    ROBOT_STATE_FIELD_NUMBER: _ClassVar[int]
    PICTURE_AGE_NS_FIELD_NUMBER: _ClassVar[int]
    PICTURE_STILL_NS_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    tick: int
    deadline_ns: int
    decided_ns: int
    late_ns: int
    level: Level
    invocation: int
    t_row0: int
    row: int
    ref_query: int
    age_ns: int
    observation_tick: int
    state: _containers.RepeatedScalarFieldContainer[float]
    action: _containers.RepeatedScalarFieldContainer[float]
    raw_row: _containers.RepeatedScalarFieldContainer[float]
    limits_hit: int
    seam_jump: float
    age_ms: float
    late_ms: float
    robot_state: RobotState
    picture_age_ns: _containers.RepeatedScalarFieldContainer[int]
    picture_still_ns: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., tick: _Optional[int] = ..., deadline_ns: _Optional[int] = ..., decided_ns: _Optional[int] = ..., late_ns: _Optional[int] = ..., level: _Optional[_Union[Level, str]] = ..., invocation: _Optional[int] = ..., t_row0: _Optional[int] = ..., row: _Optional[int] = ..., ref_query: _Optional[int] = ..., age_ns: _Optional[int] = ..., observation_tick: _Optional[int] = ..., state: _Optional[_Iterable[float]] = ..., action: _Optional[_Iterable[float]] = ..., raw_row: _Optional[_Iterable[float]] = ..., limits_hit: _Optional[int] = ..., seam_jump: _Optional[float] = ..., age_ms: _Optional[float] = ..., late_ms: _Optional[float] = ..., robot_state: _Optional[_Union[RobotState, str]] = ..., picture_age_ns: _Optional[_Iterable[int]] = ..., picture_still_ns: _Optional[_Iterable[int]] = ...) -> None: ...

class Subgoal(_message.Message):
    __slots__ = ("header", "kind", "text", "tick", "query", "token_ids", "is_truncated")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    QUERY_FIELD_NUMBER: _ClassVar[int]
    TOKEN_IDS_FIELD_NUMBER: _ClassVar[int]
    IS_TRUNCATED_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    kind: SubgoalKind
    text: str
    tick: int
    query: int
    token_ids: _containers.RepeatedScalarFieldContainer[int]
    is_truncated: bool
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., kind: _Optional[_Union[SubgoalKind, str]] = ..., text: _Optional[str] = ..., tick: _Optional[int] = ..., query: _Optional[int] = ..., token_ids: _Optional[_Iterable[int]] = ..., is_truncated: _Optional[bool] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("header", "severity", "name", "text", "tick", "attributes")
    class AttributesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    HEADER_FIELD_NUMBER: _ClassVar[int]
    SEVERITY_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    TICK_FIELD_NUMBER: _ClassVar[int]
    ATTRIBUTES_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    severity: Severity
    name: str
    text: str
    tick: int
    attributes: _containers.ScalarMap[str, str]
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., severity: _Optional[_Union[Severity, str]] = ..., name: _Optional[str] = ..., text: _Optional[str] = ..., tick: _Optional[int] = ..., attributes: _Optional[_Mapping[str, str]] = ...) -> None: ...

class Phase(_message.Message):
    __slots__ = ("header", "state")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    state: str
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., state: _Optional[str] = ...) -> None: ...

class Health(_message.Message):
    __slots__ = ("header", "state", "progress", "detail", "is_inferring", "open_episode", "next_index", "infer_p50_ns", "infer_p99_ns", "num_answered", "dropped", "version", "model_hash", "is_fake")
    class DroppedEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    HEADER_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    IS_INFERRING_FIELD_NUMBER: _ClassVar[int]
    OPEN_EPISODE_FIELD_NUMBER: _ClassVar[int]
    NEXT_INDEX_FIELD_NUMBER: _ClassVar[int]
    INFER_P50_NS_FIELD_NUMBER: _ClassVar[int]
    INFER_P99_NS_FIELD_NUMBER: _ClassVar[int]
    NUM_ANSWERED_FIELD_NUMBER: _ClassVar[int]
    DROPPED_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    IS_FAKE_FIELD_NUMBER: _ClassVar[int]
    header: _common_pb2.Header
    state: ServingState
    progress: float
    detail: str
    is_inferring: bool
    open_episode: str
    next_index: int
    infer_p50_ns: int
    infer_p99_ns: int
    num_answered: int
    dropped: _containers.ScalarMap[str, int]
    version: str
    model_hash: str
    is_fake: bool
    def __init__(self, header: _Optional[_Union[_common_pb2.Header, _Mapping]] = ..., state: _Optional[_Union[ServingState, str]] = ..., progress: _Optional[float] = ..., detail: _Optional[str] = ..., is_inferring: _Optional[bool] = ..., open_episode: _Optional[str] = ..., next_index: _Optional[int] = ..., infer_p50_ns: _Optional[int] = ..., infer_p99_ns: _Optional[int] = ..., num_answered: _Optional[int] = ..., dropped: _Optional[_Mapping[str, int]] = ..., version: _Optional[str] = ..., model_hash: _Optional[str] = ..., is_fake: _Optional[bool] = ...) -> None: ...
