"""Where things go: a bay around its reference fixture, other fixtures beside it, and free spots for objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dual_system.tasks.kitchen import looks, objects
from dual_system.tasks.kitchen.bay import WALL_HALF_M
from dual_system.tasks.kitchen.fixtures import coffee_machine, counter, microwave, sink
from dual_system.tasks.kitchen.plan import (
    COUNTER_DEPTH_M,
    COUNTER_TOP_M,
    BayPlan,
    Finish,
    FixtureKind,
    FixturePlan,
    Instances,
    ObjectPlan,
    Stand,
)
from dual_system.tasks.scene import SceneFullError

TO_COUNTER_M = 0.20  # from the robot's base to the counter's front edge
_LENGTH_M, _REFERENCE_X_M = (2.4, 3.0), 0.2
_FREE_M, _FREE_BESIDE_M = 0.5, 0.4  # of the counter, on either side of the robot and of what stands on the counter
_EDGE_M = 0.02
_CLEAR_M = 0.0005  # objects start this much above what they stand on

# Half of the counter, or of what is under it, that a fixture takes.
COUNTER_HALF_M: dict[FixtureKind, float] = {
    "sink": sink.HALF_WIDTH_M,
    "stove": counter.STOVE_HALF_M,
    "drawer": counter.DRAWER_HALF_M,
    "microwave": microwave.HALF_WIDTH_M,
    "coffee_machine": coffee_machine.HALF_WIDTH_M,
}
_BESIDE: tuple[FixtureKind, ...] = ("sink", "stove", "drawer", "microwave", "coffee_machine")

Span = tuple[float, float]


@dataclass(slots=True, kw_only=True)
class Draft:
    """A bay while it is drawn."""

    rng: np.random.Generator
    instances: Instances
    length_m: float
    x_m: float  # of the robot, and of the reference fixture if that is in front of it
    finish: Finish
    fixtures: list[FixturePlan]
    objects: list[ObjectPlan] = field(default_factory=list)
    joints: dict[str, float] = field(default_factory=dict)
    back_m: float = 0.0  # how much further back than usual the robot stands
    is_microwave_on: bool = False

    def plan(self) -> BayPlan:
        """Returns what has been drawn, frozen."""
        stand = Stand(x_m=self.x_m, y_m=-COUNTER_DEPTH_M - TO_COUNTER_M - self.back_m, yaw_rad=np.pi / 2)
        return BayPlan(
            length_m=self.length_m,
            stand=stand,
            fixtures=tuple(self.fixtures),
            objects=tuple(self.objects),
            joints=tuple(self.joints.items()),
            finish=self.finish,
            is_microwave_on=self.is_microwave_on,
        )

    def put(self, name: str, kind: str, xyz_m: Sequence[float], *, yaw_rad: float, instance: int | None = None) -> None:
        """Puts an object with its bottom at a point; the instance is drawn unless it is given."""
        instance = self.draw_instance() if instance is None else instance
        x_m, y_m, z_m = (float(each) for each in xyz_m)
        up_m = z_m + objects.half_of(kind, instance)[2] + _CLEAR_M
        self.objects.append(
            ObjectPlan(name=name, kind=kind, instance=instance, position_m=(x_m, y_m, up_m), yaw_rad=yaw_rad)
        )

    def put_somewhere(
        self,
        name: str,
        kind: str,
        x_m: Span,
        y_m: Span,
        *,
        z_m: float = COUNTER_TOP_M,
        yaw_rad: float | None = None,
        gap_m: float = 0.03,
    ) -> None:
        """Puts an object where nothing else stands within a rectangle; raises SceneFullError if there is no room."""
        instance = self.draw_instance()
        half = objects.half_of(kind, instance)
        radius = float(np.hypot(*half[:2])) if half[0] != half[1] else half[0]
        yaw = float(self.rng.uniform(-np.pi, np.pi)) if yaw_rad is None else yaw_rad
        for _ in range(64):
            at = (float(self.rng.uniform(*x_m)), float(self.rng.uniform(*y_m)))
            if all(self._distance(at, each) > radius + self._radius(each) + gap_m for each in self.objects):
                self.put(name, kind, (*at, z_m), yaw_rad=yaw, instance=instance)
                return
        raise SceneFullError(f"no room for a {kind} within x {x_m} m and y {y_m} m beside {len(self.objects)} objects")

    def draw_instance(self) -> int:
        """Draws an instance of the split."""
        return int(self.rng.choice(objects.instances_of(self.instances)))

    def draw_kind(self, kinds: Sequence[str]) -> str:
        """Draws a kind that is not yet in the bay, so that a name says which object is meant."""
        free = [kind for kind in kinds if all(kind != each.kind for each in self.objects)]
        return str(self.rng.choice(free))

    def distract(self, num: int, x_spans: Sequence[Span], y_m: Span) -> None:
        """Puts distractors on the counter, each in one of some spans if it finds room there."""
        for i in range(num):
            span = x_spans[int(self.rng.integers(len(x_spans)))]
            try:
                self.put_somewhere(f"distractor_{i}", self.draw_kind(objects.GRASPABLES), span, y_m)
            except SceneFullError:
                return

    @staticmethod
    def _distance(at: Sequence[float], other: ObjectPlan) -> float:
        return float(np.hypot(at[0] - other.position_m[0], at[1] - other.position_m[1]))

    @staticmethod
    def _radius(other: ObjectPlan) -> float:
        half = objects.half_of(other.kind, other.instance)
        return half[0] if half[0] == half[1] else float(np.hypot(*half[:2]))


def draft(
    rng: np.random.Generator,
    instances: Instances,
    kinds: Sequence[FixtureKind],
    *,
    names: Sequence[str] = (),
    offsets_m: Sequence[float] | None = None,
    back_m: float = 0.0,
) -> Draft:
    """Draws a bay with reference fixtures at offsets from the robot, by default 0, and up to two others beside them."""
    length = float(rng.uniform(*_LENGTH_M))
    x = float(rng.uniform(-_REFERENCE_X_M, _REFERENCE_X_M))
    finish = Finish(
        wall=str(rng.choice(looks.WALLS)),
        floor=str(rng.choice(looks.FLOORS)),
        top=str(rng.choice(looks.TOPS)),
        wood=str(rng.choice(looks.WOODS)),
    )
    fixtures = [
        FixturePlan(kind=kind, name=name, x_m=x + offset, opens_right=bool(rng.integers(2)))
        for kind, name, offset in zip(kinds, names or kinds, offsets_m or [0.0] * len(kinds), strict=True)
    ]
    drawn = Draft(rng=rng, instances=instances, length_m=length, x_m=x, finish=finish, fixtures=fixtures, back_m=back_m)
    _add_neighbours(drawn)
    return drawn


def _add_neighbours(drawn: Draft) -> None:
    """Puts another fixture on either side if there is room for one; kinds do not repeat."""
    taken = [_work(each) for each in drawn.fixtures]
    work = (
        min([drawn.x_m - _FREE_M, *(low for low, _ in taken)]),
        max([drawn.x_m + _FREE_M, *(high for _, high in taken)]),
    )
    for side in drawn.rng.permutation([-1, 1]).tolist():
        free = (-drawn.length_m / 2 + _EDGE_M, work[0]) if side < 0 else (work[1], drawn.length_m / 2 - _EDGE_M)
        present = {each.kind for each in drawn.fixtures}
        fitting = [kind for kind in _BESIDE if kind not in present and 2 * COUNTER_HALF_M[kind] <= free[1] - free[0]]
        if fitting:
            kind: FixtureKind = fitting[int(drawn.rng.integers(len(fitting)))]
            half = COUNTER_HALF_M[kind]
            x = float(drawn.rng.uniform(free[0] + half, free[1] - half))
            drawn.fixtures.append(FixturePlan(kind=kind, name=f"other_{kind}", x_m=x))


def _work(fixture: FixturePlan) -> Span:
    """Returns the span of the counter that work on a reference fixture may need."""
    on_counter, on_wall = COUNTER_HALF_M.get(fixture.kind), WALL_HALF_M.get(fixture.kind, 0.0)
    half = max(on_wall + _EDGE_M, 0.0 if on_counter is None else on_counter + _FREE_BESIDE_M)
    return fixture.x_m - half, fixture.x_m + half
