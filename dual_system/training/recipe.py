"""The definition of a training run, apart from its data and the machine."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Any

from dual_system.data.video import FPS
from dual_system.models.action_space import ActionSpace
from dual_system.models.pi05.pounce import Freeze, PounceConfig
from dual_system.models.ponder.configs import PonderConfig
from dual_system.models.pounce.family import AnyPounceConfig
from dual_system.training.example import ExampleConfig
from dual_system.training.joint import Trains
from dual_system.training.trainer import TrainConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """A training run, apart from its data and the machine."""

    name: str
    ponder: PonderConfig
    pounce: AnyPounceConfig
    freeze: Freeze
    """POUNCE's pretrained parts to freeze."""
    example: ExampleConfig
    train: TrainConfig
    num_steps: int
    batch_episodes: int
    w1: float = 1.0
    """Weight of flow matching."""
    w2: float = 0.1
    """Weight of grounding: the cross-entropy of PONDER's LM head, or of what ``grounds_...`` names. It is 0 if and only
    if the examples are not grounded."""
    trains: Trains = "both"
    """The systems to train."""
    freezes_ponder_vision: bool = False
    """Leave PONDER's vision tower as it came."""
    remembers: bool = True
    """False: PONDER is trained and served without memory (`ContextFormat.remembers`)."""
    grounds_memory: bool = False
    """POUNCE's frame memory is taught PONDER's texts, with weight ``w2`` (`memory_words`)."""
    grounds_pointer: bool = False
    """POUNCE's pointer is taught the places in texts and in lessons (`pointed_places`), with weight ``w2``."""
    demo_hz: int = 1
    """Frames per second of demonstrations (paper: 1); stored in PONDER's checkpoint and contract."""
    space: ActionSpace = "joint_delta"
    """POUNCE's action space. native: the data's numbers, of any robot."""
    statistics_by_row: bool = False
    """Normalise every row of a chunk by its own spread (`RobotStatistics.reach`)."""
    has_own_tokenizers: bool = False
    """Train both tokenizers on the data's texts, which then take fewer tokens; for networks from scratch."""
    from_scratch: bool = False
    """True: random initial weights. False: both systems start from pretrained checkpoints."""

    def __post_init__(self) -> None:
        if self.trains != "pounce" and self.example.is_grounded != (self.w2 > 0):
            raise ValueError(f"recipe {self.name}: is_grounded is {self.example.is_grounded}, but w2 is {self.w2}")
        if not self.remembers and self.pounce.reads_subgoal:
            raise ValueError(
                f"recipe {self.name}: POUNCE would learn from recorded subgoals and be given those of a PONDER without "
                "memory; expected cognition as its channel"
            )
        has_memory = isinstance(self.pounce, PounceConfig) and self.pounce.frame_memory is not None
        if self.grounds_memory and not (has_memory and self.trains == "pounce" and self.example.is_grounded):
            raise ValueError(
                f"recipe {self.name}: grounds_memory is for a POUNCE with a frame memory that is trained alone on "
                "grounded examples"
            )
        points_as_told = (
            isinstance(self.pounce, PounceConfig) and self.pounce.num_pointed > 0 and self.pounce.reads_subgoal
        )
        if self.grounds_pointer and not (
            points_as_told and self.trains == "pounce" and self.example.is_grounded and self.space != "native"
        ):
            raise ValueError(
                f"recipe {self.name}: grounds_pointer is for a POUNCE that has a pointer and reads subgoals, trained "
                "alone on grounded examples of the Panda"
            )
        if self.grounds_pointer and self.grounds_memory:
            raise ValueError(f"recipe {self.name}: one of grounds_memory and grounds_pointer: both have weight w2")
        if self.statistics_by_row and self.space == "native":
            raise ValueError(
                f"recipe {self.name}: statistics_by_row scales offsets from the state, and a native chunk has the "
                "data's numbers; expected statistics_by_row=False or another space"
            )
        if self.demo_hz < 1 or FPS % self.demo_hz:
            raise ValueError(f"recipe {self.name}: demo_hz must divide {FPS}, came {self.demo_hz}")


def defaults(config: Any) -> dict[str, Any]:
    """A configuration's values where nothing was chosen, nested as `dataclasses.asdict` nests; fields without a default
    are left out."""
    found: dict[str, Any] = {}
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            found[field.name] = defaults(value)
        elif field.default is not MISSING:
            found[field.name] = field.default
        elif field.default_factory is not MISSING:
            found[field.name] = field.default_factory()
    return found
