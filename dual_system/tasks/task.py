"""The base of tasks: a scene, a list of subtasks, and a registry of all tasks.

Physics has numbers by name, a task defines their meaning, the environment the order of calls. A task never steps,
physics never scores, and predicates only read. Task objects are stateless: an episode's goal is its layout, its past
events are its memory, and both are frozen values, so that an episode can be saved and restored.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.oracle import Motions
from dual_system.tasks.panda import PANDA_WRISTCAM, Robot
from dual_system.tasks.physics import Physics

FAMILIES = ("counting", "permanence", "reference", "imitation")

LayoutT = TypeVar("LayoutT")
MemoryT = TypeVar("MemoryT")
TaskT = TypeVar("TaskT", bound="type[Task[Any, Any]]")


class TaskError(ValueError):
    """A task or difficulty does not exist."""


def never(physics: Physics, memory: Any) -> str | None:
    """The failure predicate of a subtask that cannot fail."""
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Subtask:
    """One entry of an episode's list of subtasks."""

    text: str  # template, see `captions`
    is_done: Callable[[Physics, Any], bool]
    motion: Callable[[Motions], Iterator[NDArray[np.float32]]]  # what the oracle does for it
    failure: Callable[[Physics, Any], str | None] = never  # the reason, or None while there is none
    grounds: tuple[str, ...] = ()  # bodies whose pixels fill the template's coordinates, in order
    carries: tuple[str, ...] = ()  # the cube that must be in the hand for it, and others that will do


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """One part of a demonstration: the robot's motion and its text. It cannot fail."""

    text: str  # template, see `captions`
    motion: Callable[[Motions], Iterator[NDArray[np.float32]]]
    grounds: tuple[str, ...] = ()  # as in a subtask
    is_recorded: bool = True  # False: it happens, but the video leaves it out
    afterwards: Callable[[Physics], None] | None = None  # changes the scene when the part is over


@dataclass(frozen=True, slots=True, kw_only=True)
class Reasoning:
    """The text of what a subtask needs from the past (paper, Table 6)."""

    text: str  # template, see `captions`; the environment appends the current grounded subgoal
    grounds: tuple[str, ...] = ()  # bodies whose pixels, now, fill the template's coordinates, in order


class Task(ABC, Generic[LayoutT, MemoryT]):
    """One kind of episode. Subclasses carry `@task(family=...)`, one file each.

    All methods but `furnish`, `arrange` and `stage` are pure functions of their arguments. A demonstration changes the
    physics only by `Shown.afterwards`.
    """

    name: ClassVar[str]
    family: ClassVar[str]
    robot: ClassVar[Robot] = PANDA_WRISTCAM
    repeats_itself: ClassVar[bool] = False  # its episodes have rounds that look alike, see `forks`
    retells_video: ClassVar[bool] = False  # `retold` changes only the video, not the scene after it

    @abstractmethod
    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Adds all props that any difficulty may need; those a layout leaves out stay parked."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, difficulty: str) -> LayoutT:
        """Draws the scene and the goal of one episode."""

    @abstractmethod
    def arrange(self, physics: Physics, layout: LayoutT) -> None:
        """Places and paints the props of a freshly reset scene as the layout says."""

    @abstractmethod
    def instruction(self, layout: LayoutT) -> str:
        """Returns the instruction, in upstream's first wording."""

    @abstractmethod
    def subtasks(self, layout: LayoutT) -> tuple[Subtask, ...]:
        """Returns the ordered list of subtasks."""

    def subtasks_after(self, layout: LayoutT, memory: MemoryT) -> tuple[Subtask, ...]:
        """Returns the subtasks reordered by what has been done, for tasks that leave the order open.

        The list has the same length and, entry by entry, the same completion and failure, so success does not change.
        If either of two cubes may come first, the original list would name one that is already in the bin. The default
        is `subtasks`.
        """
        return self.subtasks(layout)

    def demonstration(self, layout: LayoutT) -> tuple[Shown, ...]:
        """Returns the parts of the conditioning video, performed before the robot may act. The default is none.

        The clock of `stage` runs through it; the memory begins anew when the episode proper begins.
        """
        return ()

    def reasoning(self, layout: LayoutT, index: int) -> Reasoning | None:
        """Returns what subtask ``index`` needs from the past, by its family's schema in the paper's Table 6.

        PONDER learns to generate it once, at the first transition after a demonstration.
        """
        return None

    def retold(self, layout: LayoutT) -> tuple[LayoutT, ...]:
        """Returns layouts whose episodes show something else at first and look the same later; see `forks`.

        The instruction is the same, and so is the physics under the same actions, bit for bit, except for bodies that
        are only shown. Once they are gone only memory tells the episodes apart, and the right next action of one is
        wrong in the others. If only the video differs (`retells_video`), the physics may differ by what a motion leaves
        behind. The default is none.
        """
        return ()

    def cues(self, layout: LayoutT) -> tuple[str, ...]:
        """Returns the bodies that are seen only for a while, and then decide. The default is none."""
        return ()

    @classmethod
    def can_be_forked(cls) -> bool:
        """Returns whether other pasts may lead to the same present."""
        return cls.repeats_itself or cls.retold is not Task.retold

    @abstractmethod
    def remember(self, memory: MemoryT | None, physics: Physics, layout: LayoutT) -> MemoryT:
        """Returns the memory after one more observation; ``memory`` is None at the first."""

    def stage(self, physics: Physics, layout: LayoutT, memory: MemoryT | None, step: int) -> None:
        """Moves scripted bodies to where the observation of ``step`` shall show them. The default moves nothing.

        It is called after every control step with the number of control steps since reset, and at reset with 0. The
        memory is that of the observation before: what is seen now can move bodies in the next one. It is None at reset.
        """
        return

    def first_choice(self, physics: Physics, memory: MemoryT, layout: LayoutT, index: int) -> bool | None:
        """Returns whether what this observation commits to is right; None if it commits to nothing.

        It asks for the one thing, manner or count that only the past tells, and for little skill: the first answer of
        an episode that is not None is its first choice. It decides no outcome.

        Args:
            index: of the subtask that was current before this observation.
        """
        return None

    def is_accomplished(self, memory: MemoryT, layout: LayoutT) -> bool:
        """Returns whether the whole task is done regardless of the list. The default leaves it to the list."""
        return False


_REGISTRY: dict[str, type[Task[Any, Any]]] = {}


def task(*, family: str) -> Callable[[TaskT], TaskT]:
    """Registers a task under its class name. Raises TaskError for an unknown family or a name taken twice."""
    if family not in FAMILIES:
        raise TaskError(f"unknown task family {family!r}; expected one of {', '.join(FAMILIES)}")

    def register(cls: TaskT) -> TaskT:
        name = cls.__name__
        if name in _REGISTRY:
            raise TaskError(f"task {name!r} is defined in both {_REGISTRY[name].__module__} and {cls.__module__}")
        cls.name, cls.family = name, family
        _REGISTRY[name] = cls
        return cls

    return register


def task_names() -> tuple[str, ...]:
    """Returns the names of all tasks that can be made, sorted."""
    _import_all_tasks()
    return tuple(sorted(_REGISTRY))


def chosen_tasks(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the tasks of a program's ``--tasks``, sorted, each once; "all" stands for all. Raises TaskError."""
    if "all" in names:
        return task_names()
    for name in names:
        make_task(name)
    return tuple(sorted(set(names)))


def make_task(name: str) -> Task[Any, Any]:
    """Returns a new task object. Raises TaskError for an unknown name."""
    known = task_names()
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"Did you mean {close[0]!r}? " if close else ""
        raise TaskError(f"unknown task {name!r}. {hint}sim-client --list-tasks shows all.")
    return _REGISTRY[name]()


def _import_all_tasks() -> None:
    """Imports every module of the family packages: a task registers itself where it is defined, and nowhere else."""
    for family in FAMILIES:
        package_name = f"{__package__}.{family}"
        if importlib.util.find_spec(package_name) is None:
            continue
        package = importlib.import_module(package_name)
        for module in pkgutil.iter_modules(package.__path__):
            importlib.import_module(f"{package_name}.{module.name}")
