"""What the daemon and a PONDER engine say to each other: no tensors, no torch.

The node and the shell need this file only, so they can be tested with a fake engine in milliseconds.

# K carriers, H hidden, h w height and width in pixels
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Literal, Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from dual_system.models.ponder.demo_sampling import PAPER_SAMPLING, DemoSampling
from dual_system.models.ponder.observation import WHOLE_VIEWS, ObservationReader

Frame: TypeAlias = npt.NDArray[np.uint8]
"""One camera image, (h, w, 3) uint8 RGB."""

Proprio: TypeAlias = npt.NDArray[np.float32]
"""The robot's state at the observation, (8,): 7 joint angles [rad], a finger [m]. Most models ignore it."""

Result = TypeVar("Result")

WeightsName: TypeAlias = Literal["float", "int8", "fp8"]

Progress: TypeAlias = Callable[[], None]
"""Called between pieces of work, so that a heartbeat comes from the loop that works and not from a timer."""


def no_progress() -> None:
    """The default :data:`Progress`."""


class SessionError(ValueError):
    """A session does not exist, exists already, or there is no room for one more."""


class ContextFull(ValueError):
    """A session's context has no room for what was asked; the session is left as it was."""

    def __init__(self, *, session: str, used: int, wanted: int, limit: int) -> None:
        super().__init__(
            f"session {session!r} holds {used} tokens and needs {wanted} more, the limit is {limit}. "
            "Close it and open a new one with a shorter history, raise max_context_tokens, or let it forget "
            "(when_full)."
        )
        self.session, self.used, self.wanted, self.limit = session, used, wanted, limit


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineSpec:
    """What an engine expects and what it gives; fixed for its lifetime."""

    num_carriers: int
    """K"""
    hidden_size: int
    """H"""
    image_px: tuple[int, int]
    """(h, w) of every image that the network reads."""
    num_cameras: int
    """Frames per fire, always the same cameras in the same order."""
    max_context_tokens: int
    model_hash: str
    """12 hex digits over the weights, and how they were narrowed."""
    is_random: bool
    """The carriers were never trained: every cognition is noise, and reports must say so."""
    dtype: str
    """Of weights and activations, e.g. "float32"; cognition is float32 always."""
    reader: ObservationReader = WHOLE_VIEWS
    """What is read of the frames and of the robot's state."""
    demonstrations: DemoSampling = PAPER_SAMPLING
    """How a demonstration is to be sampled."""
    session_bytes: int = 0
    """Memory of one session at its longest; that of all of them is allocated at start."""
    weights: WeightsName = "float"
    cognition_error: float = 0.0
    """Relative L2 change of C that ``weights`` cost, after one and the same short context (the warm-up's)."""

    @property
    def is_fake(self) -> bool:
        """Something that was drawn, not trained, decides the answers."""
        return self.is_random


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Opening:
    """What an episode starts from."""

    instruction: str
    demo_frames: tuple[tuple[Frame, ...], ...] = field(default=())
    """Demonstration, sampled as ``EngineSpec.demonstrations`` says: for each instant, its views."""

    @property
    def has_demo(self) -> bool:
        return bool(self.demo_frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class Text:
    """A text PONDER wrote into its own context. It never reaches POUNCE."""

    kind: Literal["subgoal", "demo_reasoning"]
    text: str
    token_ids: tuple[int, ...]
    truncated: bool
    """True if it was cut at the token limit and closed as it was."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fire:
    """The answer to one query."""

    cognition: npt.NDArray[np.float32]
    """C_t, (K, H): the carriers' final hidden states, neither decoded nor pooled."""
    is_transition: bool
    """T_t = T_yes."""
    texts: tuple[Text, ...]
    context_tokens: int
    """Tokens in the session after this fire."""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome(Generic[Result]):
    """How a query ended: with an answer, or with the error that kept it from leaving a trace."""

    session: str
    result: Result | None
    error: Exception | None = None

    def unwrap(self) -> Result:
        """The result; raises the error if there is one."""
        if self.error is not None:
            raise self.error
        assert self.result is not None
        return self.result


class PonderEngine(Protocol):
    """An engine answers one call at a time; it is not thread-safe."""

    @property
    def spec(self) -> EngineSpec: ...

    def open(self, session: str, opening: Opening, progress: Progress = no_progress) -> int:
        """Starts an episode; its context tokens. Raises SessionError, ContextFull or ValueError."""

    def fire(
        self,
        session: str,
        frames: tuple[Frame, ...],
        progress: Progress = no_progress,
        *,
        proprio: Proprio | None = None,
    ) -> Fire:
        """Appends one observation and answers it, or raises SessionError, ContextFull or ValueError.

        All or nothing: after an error the session is as it was.
        """

    def close(self, session: str) -> None:
        """Ends an episode and frees its memory. Raises SessionError if it is not open."""

    def warm_up(self) -> list[int]:
        """Runs throwaway fires; durations in ns of at least 20, the first few left unmeasured."""


class BatchingEngine(PonderEngine, Protocol):
    """Thinks about queries of several sessions at once; ``fire`` is for when it thinks about nothing else."""

    def begin(self, session: str, frames: tuple[Frame, ...], *, proprio: Proprio | None = None) -> None:
        """Takes on one query of a session that has none. Raises as ``fire`` does, and changes nothing then."""

    def warm_up_full(self) -> list[int]:
        """Runs throwaway forwards of a query in a context as long as one may get; durations in ns of at least 10."""

    def step(self, progress: Progress = no_progress) -> list[Outcome[Fire]]:
        """A piece of work, about as long as one forward; the queries that it answered or that failed in it.

        Sessions take turns; a query begun between two steps joins the next one. Empty and at once if none is begun.
        """
