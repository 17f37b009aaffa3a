"""The interface between the daemon and a PONDER engine, without tensors or torch.

The node and the shell need only this file, so a fake engine can test them in milliseconds.

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
"""The robot's state at the observation, (8,): 7 joint angles [rad], finger opening [m]. Most models ignore it."""

Result = TypeVar("Result")

WeightsName: TypeAlias = Literal["float", "int8", "fp8"]
PolicyName: TypeAlias = Literal["refuse", "pin-and-slide", "carriers-only"]

Progress: TypeAlias = Callable[[], None]
"""Called between pieces of work, so that the heartbeat comes from the working loop and not from a timer."""


def no_progress() -> None:
    """The default :data:`Progress`."""


class SessionError(ValueError):
    """A session does not exist, exists already, or there is no room for one more."""


class ContextFull(ValueError):
    """A session's context has no room for an append; the session is unchanged."""

    def __init__(self, *, session: str, used: int, wanted: int, limit: int) -> None:
        super().__init__(
            f"session {session!r} holds {used} tokens and needs {wanted} more, the limit is {limit}. "
            "Close it and open a new one with a shorter history, raise max_context_tokens, or let it forget "
            "(when_full)."
        )
        self.session, self.used, self.wanted, self.limit = session, used, wanted, limit


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineSpec:
    """An engine's inputs, outputs and limits; fixed for its lifetime."""

    num_carriers: int
    """K"""
    hidden_size: int
    """H"""
    image_px: tuple[int, int]
    """(h, w) of every image that the network reads."""
    num_cameras: int | None
    """Frames per fire, always the same cameras in the same order. None: as many as the robot has."""
    max_context_tokens: int
    model_hash: str
    """12 hex digits over the weights, with a suffix for narrow ones."""
    is_random: bool
    """True if the carriers were never trained: every cognition is noise, and reports must say so."""
    dtype: str
    """Number format of weights and activations, e.g. "float32"; cognition is always float32."""
    reader: ObservationReader = WHOLE_VIEWS
    """Maps the frames and the robot's state to images and tokens."""
    demonstrations: DemoSampling = PAPER_SAMPLING
    """Sampling of demonstrations."""
    session_bytes: int = 0
    """Memory of one session at full length; it is allocated for all sessions at start."""
    answers_newest: bool = False
    """True if in real time a query that a newer one overtakes is left out, as it leaves no gap in any context; and if a
    context that is lost begins anew."""
    introduction: str = ""
    """What an episode's log is to say of the model, besides its hash."""
    gives_text: bool = True
    """False if it never writes a subgoal, so that POUNCE's prompt cannot come from it."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras in training, in order; () if they are not known."""
    remembers: bool = True
    """False if every query is answered from the instruction and its own observation alone."""
    weights: WeightsName = "float"
    cognition_error: float = 0.0
    """Relative L2 change of C by narrow ``weights``, measured in the warm-up's short context."""
    kernels: str = ""
    """Which kernels captured forwards run and why not others, known after the warm-up; "" if it tried none."""

    @property
    def is_fake(self) -> bool:
        """True if untrained weights decide the answers."""
        return self.is_random


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Opening:
    """Instruction and demonstration at the start of an episode."""

    instruction: str
    demo_frames: tuple[tuple[Frame, ...], ...] = field(default=())
    """Views of the demonstration at each instant, sampled as ``EngineSpec.demonstrations`` says."""

    @property
    def has_demo(self) -> bool:
        return bool(self.demo_frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class Text:
    """A text that PONDER generated into its own context."""

    kind: Literal["subgoal", "demo_reasoning"]
    text: str
    token_ids: tuple[int, ...]
    truncated: bool
    """True if it was cut at the token limit."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fire:
    """The answer to one query."""

    cognition: npt.NDArray[np.float32]
    """C_t, (K, H) float32: the carriers' final hidden states, neither decoded nor pooled."""
    is_transition: bool
    """T_t = T_yes."""
    texts: tuple[Text, ...]
    context_tokens: int
    """Tokens in the session after this fire."""
    gate_score: float | None = None
    """Probability of T_yes against T_no, or what a foreign gate reports of itself; None if no gate decided."""
    trouble: str = ""
    """Why it says nothing new although it was asked, for the log; "" if nothing went wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome(Generic[Result]):
    """Result of a query: an answer, or the error after which the session is unchanged."""

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
        """Starts an episode; returns its context tokens. Raises SessionError, ContextFull or ValueError."""

    def fire(
        self,
        session: str,
        frames: tuple[Frame, ...],
        progress: Progress = no_progress,
        *,
        proprio: Proprio | None = None,
    ) -> Fire:
        """Appends one observation and answers it, or raises SessionError, ContextFull or ValueError.

        Atomic: after an error the session is unchanged.
        """

    def close(self, session: str) -> None:
        """Ends an episode and frees its memory. Raises SessionError if it is not open."""

    def warm_up(self) -> list[int]:
        """Runs throwaway fires; returns the durations in ns of at least 20, without the first few."""


class BatchingEngine(PonderEngine, Protocol):
    """Runs queries of several sessions at once; ``fire`` requires that none is in progress."""

    def open(
        self,
        session: str,
        opening: Opening,
        progress: Progress = no_progress,
        between: Callable[[], None] = no_progress,
    ) -> int:
        """As ``PonderEngine.open``; ``between`` is called between two forwards, and may ``step`` other sessions."""

    def begin(self, session: str, frames: tuple[Frame, ...], *, proprio: Proprio | None = None) -> None:
        """Accepts one query of a session that has none. Raises as ``fire`` does, and then changes nothing."""

    def warm_up_full(self) -> list[int]:
        """Runs throwaway queries in a full context; returns the durations in ns of at least 10."""

    def step(self, progress: Progress = no_progress) -> list[Outcome[Fire]]:
        """Runs about one forward; returns the queries that it answered or that failed in it.

        Sessions take turns; a query begun between two steps joins the next one. Without queries it returns [].
        """
