"""What the daemon and an action engine say to each other: arrays and numbers, no tensors, no torch.

The node and the shell need this file only, so they are tested with a fake engine in milliseconds.
"""

# N horizon, K carriers, H carrier size

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dual_system.models.action_space import ActionSpace
from dual_system.models.arm import JOINT_HIGH_RAD, JOINT_LOW_RAD, NUM_ARM_JOINTS
from protocol.errors import EpisodeRefused
from protocol.messages import Refusal, Robot

DTypeName: TypeAlias = Literal["float32", "bfloat16"]
WeightsName: TypeAlias = Literal["float", "int8"]

Continuity: TypeAlias = Literal["none", "rtc", "trained"]
"""Whether a chunk continues the rows being played: not, pulled to them (`rtc`), or given them (`committed`)."""

_LIMIT_SLACK_RAD = 1e-3  # limits travel as float32

Progress: TypeAlias = Callable[[], None]
"""Called between flow steps, so that a heartbeat comes from the loop that works and not from a timer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineSpec:
    """What a process announces about its engine, and what requests are checked against."""

    horizon: int
    """Rows per chunk, played at 20 Hz."""
    action_dim: int
    """Dims of a row in robot units: 7 joint targets (rad) and the gripper, -1 closed to 1 open."""
    proprio_dim: int
    num_carriers: int
    """K; 0 means the engine takes no cognition."""
    cognition_size: int
    """H of one carrier."""
    image_px: int
    """Side to which frames are resized; any frame size is accepted."""
    num_steps: int
    """Flow steps per invocation, hence calls of ``progress``."""
    num_cameras: int
    model_hash: str
    """Equal hashes act equally on equal requests (same dtype and machine)."""
    is_random: bool
    """Weights drawn, not trained."""
    has_fresh_prefix: bool
    """The cognition prefix is drawn, not trained: cognition moves the actions, but not with sense."""
    dtype: DTypeName
    space: ActionSpace = "joint_delta"
    """What the network answers in. Rows are absolute joint targets all the same; see `check_robot`."""
    continuity: Continuity = "none"
    max_committed_rows: int = 0
    """The most committed rows that the network was trained to be given; matters to continuity "trained" only."""
    weights: WeightsName = "float"
    action_error: float = 0.0
    """Mean absolute error of the network's normalised actions that ``weights`` cost, on made-up requests."""
    reads_subgoal: bool = False
    """The engine reads PONDER's newest subgoal in place of cognition (then K = 0)."""

    @property
    def is_fake(self) -> bool:
        """Something that was drawn, not trained, decides the answers."""
        return self.is_random or self.has_fresh_prefix


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Request:
    """One invocation's inputs, at one instant."""

    instruction: str
    frames: tuple[NDArray[np.uint8] | None, ...]
    """(h, w, 3) uint8 per camera, front then wrist; None for a camera that did not deliver."""
    proprio: NDArray[np.float32]
    """(8,) float32: 7 joint positions (rad), finger opening (m)."""
    cognition: NDArray[np.float32] | None
    """(K, H) float32; None means the learned null."""
    age_ns: int
    """Age of the cognition's source observation; 0 with null."""
    seed: int
    """Of the starting noise, at least 0: same seed and inputs, same rows, bit for bit on one machine."""
    previous_rows: NDArray[np.float32] | None = None
    """(n, action_dim) float32 in robot units: what is left of the chunk being played; None if there is none."""
    previous_row0: int = 0
    """The row of the new chunk that belongs to the tick of the first previous one."""
    committed_rows: int = 0
    """How many of the previous rows will be played whatever the new chunk says."""
    subgoal: str = ""
    """PONDER's newest subgoal, for engines that read it; empty before there is one."""


def no_progress() -> None:
    """The default `Progress`."""


class PounceEngine(Protocol):
    """What the node drives; pi0.5 here, other action models behind the same three names."""

    @property
    def spec(self) -> EngineSpec: ...

    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        """Returns rows (horizon, action_dim) float32 in robot units; calls ``progress`` every flow step."""
        ...

    def warm_up(self) -> list[int]:
        """Runs until times are steady, then returns the durations of at least 20 invocations, in ns."""
        ...


def check_robot(robot: Robot, spec: EngineSpec) -> None:
    """Raises EpisodeRefused if the engine cannot read this robot or its chunks are none for it.

    Horizon and row size are the clock's to compare: it knows the schedule.
    """
    if robot.num_proprio != spec.proprio_dim:
        raise EpisodeRefused(
            Refusal.ROBOT, f"POUNCE reads {spec.proprio_dim} joint values, the robot has {robot.num_proprio}"
        )
    if spec.num_cameras and len(robot.cameras) != spec.num_cameras:
        names = ", ".join(robot.cameras) or "none"
        raise EpisodeRefused(
            Refusal.CAMERAS,
            f"POUNCE reads {spec.num_cameras} cameras, the robot has {len(robot.cameras)}: {names}",
        )
    if spec.space == "joint_delta":
        return
    low, high = robot.command_low[:NUM_ARM_JOINTS], robot.command_high[:NUM_ARM_JOINTS]
    is_panda = len(low) == NUM_ARM_JOINTS and (low >= JOINT_LOW_RAD - _LIMIT_SLACK_RAD).all()
    if not (is_panda and (high <= JOINT_HIGH_RAD + _LIMIT_SLACK_RAD).all()):
        raise EpisodeRefused(
            Refusal.ROBOT,
            f"this checkpoint moves the tool ({spec.space}) and knows the Panda's arm only; {robot.name} has joint "
            f"limits {np.round(low, 2).tolist()} to {np.round(high, 2).tolist()} rad beyond it. Load a joint_delta "
            "checkpoint.",
        )


def check_request(request: Request, spec: EngineSpec) -> None:
    """Raises ValueError, saying what was expected and what came, unless ``request`` fits ``spec``."""
    if not request.instruction.strip():
        raise ValueError("instruction is empty; POUNCE needs the task's text")
    if len(request.frames) != spec.num_cameras:
        raise ValueError(f"expected {spec.num_cameras} frames (front, wrist order), came {len(request.frames)}")
    if spec.num_cameras and all(frame is None for frame in request.frames):
        raise ValueError(f"all {spec.num_cameras} cameras are missing; POUNCE does not act blind")
    for index, frame in enumerate(request.frames):
        if frame is not None and (frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size):
            raise ValueError(f"frame {index}: expected (h, w, 3) uint8, came {frame.shape} {frame.dtype}")
    if request.subgoal and not spec.reads_subgoal:
        raise ValueError(f"this engine reads no subgoals, came {request.subgoal[:60]!r}")
    _check_floats("proprio", request.proprio, (spec.proprio_dim,))
    if not 0 <= request.seed < 2**63:
        raise ValueError(f"seed: expected 0 <= seed < 2**63, came {request.seed}")
    if request.age_ns < 0:
        raise ValueError(f"age_ns must not be negative, came {request.age_ns}: cognition from the future")
    if request.cognition is None:
        if request.age_ns:
            raise ValueError(f"null cognition has age 0 (paper 3.1), came age_ns {request.age_ns}")
    elif spec.num_carriers == 0:
        raise ValueError(f"this engine takes no cognition (K = 0), came {request.cognition.shape}")
    else:
        _check_floats("cognition", request.cognition, (spec.num_carriers, spec.cognition_size))
    _check_previous(request, spec)


def _check_previous(request: Request, spec: EngineSpec) -> None:
    num_previous = 0
    if request.previous_rows is not None:
        num_previous = len(request.previous_rows)
        _check_floats("previous_rows", request.previous_rows, (num_previous, spec.action_dim))
    if request.previous_row0 < 0:
        raise ValueError(f"previous_row0 must not be negative, came {request.previous_row0}: rows of the future")
    if not 0 <= request.committed_rows <= num_previous:
        raise ValueError(
            f"committed_rows: expected 0..{num_previous}, as there are rows, came {request.committed_rows}"
        )


def _check_floats(name: str, values: NDArray[np.float32], shape: tuple[int, ...]) -> None:
    if values.shape != shape or values.dtype != np.float32:
        raise ValueError(f"{name}: expected {shape} float32, came {values.shape} {values.dtype}")
    if not np.isfinite(values).all():
        bad = np.flatnonzero(~np.isfinite(values))
        raise ValueError(f"{name}: expected finite numbers, came {len(bad)} that are not, first at {bad[0]}")


def example_request(spec: EngineSpec, *, frame_px: int = 256, seed: int = 0) -> Request:
    """Fabricates a request that fits ``spec``: noise for pictures, joints at zero, cognition 300 ms old."""
    generator = np.random.default_rng(seed)
    shape = (frame_px, frame_px, 3)
    cognition = generator.standard_normal((spec.num_carriers, spec.cognition_size)).astype(np.float32)
    return Request(
        instruction="press the button, pick all cubes that were highlighted, then press it again to stop",
        frames=tuple(generator.integers(0, 256, shape, dtype=np.uint8) for _ in range(spec.num_cameras)),
        proprio=np.zeros(spec.proprio_dim, dtype=np.float32),
        cognition=cognition if spec.num_carriers else None,
        age_ns=300_000_000 if spec.num_carriers else 0,
        seed=seed,
        previous_rows=np.zeros((spec.horizon // 2, spec.action_dim), dtype=np.float32),
        committed_rows=min(1, spec.horizon // 2),
    )
