"""What a seed draws: fixtures, objects and start of one kitchen bay, and the goals that are judged in it. Pure data.

World frame: x to the right along the wall, y into the wall (its face is at y = 0), z up. Fixtures face -y, so that a
fixture's frame is a translation. Lengths are in metres, angles in radians.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Point = tuple[float, float, float]
FixtureKind = Literal["cabinet", "double_cabinet", "drawer", "sink", "stove", "microwave", "coffee_machine"]
Instances = Literal["A", "B"]
"""Split of the objects' instances: A in training, B held out."""

COUNTER_TOP_M = 0.92
COUNTER_DEPTH_M = 0.65


@dataclass(frozen=True, slots=True, kw_only=True)
class Stand:
    """Where the robot's base stands on the floor, and which way it looks: pi/2 is towards the wall."""

    x_m: float
    y_m: float
    yaw_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FixturePlan:
    """One fixture: its centre along the wall, and for a single cabinet whether its hinge is on the right."""

    kind: FixtureKind
    name: str
    x_m: float
    opens_right: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectPlan:
    """One free object. Its position is its body's origin, the centre of its bounding box."""

    name: str
    kind: str
    instance: int
    position_m: Point
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Finish:
    """Textures of wall, floor, counter top and cupboards, by the names of robosuite's files."""

    wall: str
    floor: str
    top: str
    wood: str


@dataclass(frozen=True, slots=True, kw_only=True)
class BayPlan:
    """One kitchen bay as it stands at the start of an episode."""

    length_m: float
    stand: Stand
    fixtures: tuple[FixturePlan, ...]
    objects: tuple[ObjectPlan, ...] = ()
    joints: tuple[tuple[str, float], ...] = ()  # joints that do not start at 0
    finish: Finish
    is_microwave_on: bool = False

    def fixture(self, name: str) -> FixturePlan:
        """Returns a fixture's plan by name."""
        return next(each for each in self.fixtures if each.name == name)

    def thing(self, name: str) -> ObjectPlan:
        """Returns an object's plan by name."""
        return next(each for each in self.objects if each.name == name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """What of the bay a goal is about: names of a fixture, of its part (knob, side) and of two objects."""

    fixture: str = ""
    part: str = ""
    obj: str = ""
    container: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One condition of success: what `kind` measures of ``of`` (against ``to``) lies within [low, high].

    The kinds and their units stand in `predicates.KINDS`. Names may hold a target's fields in braces, see `about`.
    """

    kind: str
    of: str
    to: str = ""
    low: float = float("-inf")
    high: float = float("inf")

    def about(self, target: Target) -> Check:
        """Returns the check with the target's names filled in."""
        names = {field: getattr(target, field) for field in ("fixture", "part", "obj", "container")}
        return replace(self, of=self.of.format(**names), to=self.to.format(**names))


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """What is to be done: one of the twenty-four tasks, applied to things of the bay. All checks must hold at once."""

    task: str
    target: Target
    instruction: str
    checks: tuple[Check, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """One episode: the bay, the goals that can be reached from its start, and which of them is asked for."""

    task: str  # or the goal set
    seed: int
    horizon: int  # control steps of 50 ms
    plan: BayPlan
    goals: tuple[Goal, ...]
    goal: int = 0

    @property
    def instruction(self) -> str:
        """The instruction of the goal that is asked for."""
        return self.goals[self.goal].instruction
