"""What a training run is, apart from its data."""

from __future__ import annotations

from dataclasses import dataclass

from dual_system.data.video import FPS
from dual_system.models.action_space import ActionSpace
from dual_system.models.pi05.pounce import Freeze
from dual_system.models.ponder.configs import PonderConfig
from dual_system.models.pounce.family import AnyPounceConfig
from dual_system.models.reader_file import Narrowing
from dual_system.models.specialty import Specialty
from dual_system.training.example import ExampleConfig
from dual_system.training.joint import Trains
from dual_system.training.trainer import TrainConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """A training run, apart from its data."""

    name: str
    ponder: PonderConfig
    pounce: AnyPounceConfig
    freeze: Freeze
    """Which of POUNCE's pretrained parts stay as they are."""
    example: ExampleConfig
    train: TrainConfig
    num_steps: int
    batch_episodes: int
    w1: float = 1.0
    w2: float = 0.1
    w3: float = 0.0
    """Of the auxiliary alignment with the stand-ins (`stand_in`); the paper has no such loss."""
    moved_weight: float = 1.0
    """How much alignment counts at queries whose words tell another place than the stand-in (`stand_in_weights`)."""
    aligns_evenly: bool = False
    """Numbers of C that tell a place slowly count for more (`number_weights`)."""
    w4: float = 0.0
    """Of the auxiliary lessons in places to have in mind (`place_lessons`); the paper has no such loss."""
    trains: Trains = "both"
    """Which systems; the other is not run."""
    demo_hz: int = 1
    """How often PONDER looks at a demonstration (paper: once a second). Things that change places pass each other in
    less, and from one look to the next the nearest thing is then another one. Serve it so (`sim-client --demo-hz`)."""
    keeps_eyes: bool = False
    """PONDER's vision tower stays as it is: a language model that needs few of the things in a picture lets the eyes
    forget the others."""
    reads_apart: bool = False
    """Of PONDER only a `Reader` of demonstrations learns; whatever is done without one stays as it is, to the bit."""
    specialty: Specialty | None = None
    """Of PONDER only this specialist learns; the data are for episodes of its kind."""
    narrowing: Narrowing | None = None
    """Who learns so alone does as one that is stored so; None: as one whose weights are all stored whole."""
    space: ActionSpace = "joint_delta"
    """What POUNCE's actions are."""
    statistics_by_row: bool = False
    """Every row of a chunk in its own measure (`RobotStatistics.reach`)."""
    has_own_tokenizers: bool = False
    """From scratch: both tokenizers are trained on the data's texts, which then take fewer tokens."""
    from_scratch: bool = False
    """True: weights are drawn. False: both systems start from pretrained checkpoints, given to the program."""

    def __post_init__(self) -> None:
        if self.trains != "pounce" and self.example.is_grounded != (self.w2 > 0):
            raise ValueError(f"recipe {self.name}: is_grounded is {self.example.is_grounded}, but w2 is {self.w2}")
        learners = [self.reads_apart, self.specialty is not None]
        if any(learners) and (all(learners) or self.trains != "ponder"):
            raise ValueError(
                f"recipe {self.name}: a reader (reads_apart) or a specialist (specialty) learns alone, but it trains "
                f"{'both of them' if all(learners) else self.trains}"
            )
        if self.narrowing is not None and not any(learners):
            raise ValueError(f"recipe {self.name}: narrowing is of a reader (reads_apart) or a specialist that learns")
        if self.demo_hz < 1 or FPS % self.demo_hz:
            raise ValueError(f"recipe {self.name}: demo_hz must divide {FPS}, came {self.demo_hz}")
        if self.trains == "both" and self.example.augmentation.moves and self.example.augments == "all":
            raise ValueError(f"recipe {self.name}: views are moved and actions are not; augment watched episodes only")


@dataclass(frozen=True, slots=True, kw_only=True)
class Curriculum:
    """Stages, each a run of its own; a later one starts from what earlier ones have left of either system."""

    name: str
    stages: tuple[Recipe, ...]
    """Named ``curriculum/stage``."""
    eyes_steps: int = 0
    """So long PONDER's eyes are opened first, with an album (`seeing`); 0: it comes with eyes that see."""

    def __post_init__(self) -> None:
        first, *others = self.stages
        for other in others:
            if (other.ponder, other.pounce, other.space) != (first.ponder, first.pounce, first.space):
                raise ValueError(f"{other.name} trains other networks than {first.name}; stages share them")


def stages_of(chosen: Recipe | Curriculum) -> tuple[Recipe, ...]:
    """The runs that it takes."""
    return (chosen,) if isinstance(chosen, Recipe) else chosen.stages
