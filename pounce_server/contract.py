"""The interface between the daemon and an action engine: arrays and numbers, without tensors or torch.

The node and the shell need only this file, so a fake engine can test them in milliseconds.
"""

# N horizon, K carriers, H carrier size, T instants of a window, P measured numbers

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dual_system.models.action_space import ActionSpace
from dual_system.models.arm import JOINT_HIGH_RAD, JOINT_LOW_RAD, NUM_ARM_JOINTS
from dual_system.models.frame_sampling import FrameSampling, PastFrame
from model_server import cameras
from protocol.errors import EpisodeRefused
from protocol.messages import EpisodeInfo, ObservationWindow, Refusal, Robot

DTypeName: TypeAlias = Literal["float32", "bfloat16"]
WeightsName: TypeAlias = Literal["float", "int8"]

Continuity: TypeAlias = Literal["none", "rtc", "trained"]
"""How a chunk continues the rows being played: not at all, guided to them (`rtc`), or conditioned (`committed`)."""

_LIMIT_SLACK_RAD = 1e-3  # limits travel as float32

Progress: TypeAlias = Callable[[], None]
"""Called between flow steps, so that the heartbeat comes from the working loop and not from a timer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineSpec:
    """An engine's inputs, outputs and limits: a process announces them, and requests are checked against them."""

    horizon: int
    """Rows per chunk."""
    action_dim: int
    """Dims of a row in robot units. The Panda's: 7 joint targets (rad) and the gripper, -1 closed to 1 open."""
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
    """Engines with equal hashes give equal rows for equal requests (same dtype and machine)."""
    is_random: bool
    """True if the weights are random, not trained."""
    has_fresh_prefix: bool
    """True if the cognition prefix is untrained: cognition affects the actions, but not meaningfully."""
    dtype: DTypeName
    space: ActionSpace = "joint_delta"
    """The network's action space. Rows are in the robot's units in any case; see `check_robot`."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras in training, in order; () if they are not known."""
    continuity: Continuity = "none"
    max_committed_rows: int = 0
    """Largest number of committed rows in the network's training; for continuity "trained" only."""
    weights: WeightsName = "float"
    action_error: float = 0.0
    """Mean absolute error of the normalised actions due to narrow ``weights``, on example requests."""
    control_hz: int = 0
    """Rows a second; 0: not known."""
    reads_subgoal: bool = False
    """True if the engine reads PONDER's newest subgoal in place of cognition (then K = 0)."""
    window: ObservationWindow | None = None
    """The ticks at which it looks; None: the present alone, and requests have no ``window``."""
    past: FrameSampling | None = None
    """The past front pictures that it reads as a memory; None: requests have no ``past``."""
    kernels: str = ""
    """Which kernels of the fused path it runs and why not others, known after the warm-up; "" if it tried none."""

    @property
    def is_fake(self) -> bool:
        """True if untrained weights decide the answers."""
        return self.is_random or self.has_fresh_prefix


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Window:
    """What was seen at the ticks of a policy's window, the oldest first and the present last."""

    frames: tuple[tuple[NDArray[np.uint8], ...], ...]
    """For each camera T frames (h, w, 3) uint8; () if the engine reads none."""
    states_TP: NDArray[np.float32]
    is_video_padded_T: NDArray[np.bool_]
    """Where the frames are another tick's."""
    is_state_padded_T: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Request:
    """One invocation's inputs, at one instant."""

    instruction: str
    frames: tuple[NDArray[np.uint8] | None, ...]
    """(h, w, 3) uint8 per camera, in the robot's order; None for a missing camera."""
    proprio: NDArray[np.float32]
    """(proprio_dim,) float32. The Panda's: 7 joint positions (rad), finger opening (m)."""
    cognition: NDArray[np.float32] | None
    """(K, H) float32; None means the learned null."""
    age_ns: int
    """Age of the cognition's source observation; 0 with null."""
    seed: int
    """Seed of the initial noise, at least 0: on one machine equal seeds and inputs give equal rows, bit for bit."""
    previous_rows: NDArray[np.float32] | None = None
    """(n, action_dim) float32 in robot units: unplayed rows of the chunk being played; None if there are none."""
    previous_row0: int = 0
    """Index in the new chunk of the row for the first previous row's tick."""
    committed_rows: int = 0
    """Number of previous rows that will be played whatever the new chunk contains."""
    subgoal: str = ""
    """PONDER's newest subgoal, for engines that read it; empty before there is one."""
    window: Window | None = None
    """What was seen at the ticks of ``EngineSpec.window``; None if it has none."""
    past: tuple[PastFrame, ...] = ()
    """The pictures that ``EngineSpec.past`` chooses, oldest first; () means the learned null."""


def no_progress() -> None:
    """The default `Progress`."""


class PounceEngine(Protocol):
    """The node's view of an action model: pi0.5, GR00T or a fake."""

    @property
    def spec(self) -> EngineSpec: ...

    def invoke(self, request: Request, progress: Progress = no_progress) -> NDArray[np.float32]:
        """Returns rows (horizon, action_dim) float32 in robot units; calls ``progress`` every flow step."""
        ...

    def warm_up(self) -> list[int]:
        """Runs invocations; returns the durations in ns of at least 20, without the first ones."""
        ...


@runtime_checkable
class Episodic(Protocol):
    """An engine that is told when an episode opens."""

    def begin(self, info: EpisodeInfo) -> None:
        """Raises EpisodeRefused if it cannot play this one."""
        ...


class BatchingEngine(PounceEngine, Protocol):
    """Answers several robots at once."""

    def invoke_many(self, requests: Sequence[Request], progress: Progress = no_progress) -> list[NDArray[np.float32]]:
        """Returns rows for each request, in order: those of ``invoke`` up to float32 rounding, alone bit for bit.

        Raises ValueError if a request does not fit ``spec``; then there are rows for none.
        """
        ...


def check_robot(robot: Robot, spec: EngineSpec) -> None:
    """Raises EpisodeRefused if the engine cannot read this robot or cannot command it.

    The clock compares horizon and row size, because it knows the schedule.
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
    cameras.check_names("POUNCE", spec.cameras, robot)
    if spec.space != "ee_delta":
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
    """Raises ValueError, with the expected and the actual value, unless ``request`` fits ``spec``."""
    if not request.instruction.strip():
        raise ValueError("instruction is empty; POUNCE needs the task's text")
    if len(request.frames) != spec.num_cameras:
        raise ValueError(f"expected {spec.num_cameras} frames, one for each camera, came {len(request.frames)}")
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
    _check_past(request, spec)
    _check_previous(request, spec)


def _check_past(request: Request, spec: EngineSpec) -> None:
    most = 0 if spec.past is None else spec.past.num_frames
    if len(request.past) > most:
        raise ValueError(f"this engine reads at most {most} pictures of the past, came {len(request.past)}")
    for each in request.past:
        if each.frame.dtype != np.uint8 or each.frame.ndim != 3 or each.frame.shape[2] != 3 or not each.frame.size:
            came = f"{each.frame.shape} {each.frame.dtype}"
            raise ValueError(f"picture of step {each.step}: expected (h, w, 3) uint8, came {came}")


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
    """Makes a request that fits ``spec``: noise for pictures, joints at zero, cognition 300 ms old."""
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
        past=() if spec.past is None else _example_past(spec.past, generator, shape),
    )


def _example_past(
    sampling: FrameSampling, generator: np.random.Generator, shape: tuple[int, int, int]
) -> tuple[PastFrame, ...]:
    """As many pictures of noise as the memory has slots."""
    frames = [generator.integers(0, 256, shape, dtype=np.uint8) for _ in range(sampling.num_frames)]
    return sampling.read(dict(enumerate(frames)), len(frames))
