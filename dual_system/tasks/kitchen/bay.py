"""Building one bay from its plan: room, counter, fixtures, objects, light, and the place where the robot stands."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from dual_system.tasks.kitchen import looks, objects
from dual_system.tasks.kitchen.fixtures import cabinet, coffee_machine, counter, drawer, microwave, sink, stove
from dual_system.tasks.kitchen.handles import Bay, FixtureHandle
from dual_system.tasks.kitchen.omron import AIR
from dual_system.tasks.kitchen.parts import Workshop
from dual_system.tasks.kitchen.plan import BayPlan, FixturePlan
from dual_system.tasks.scene import PHYSICS_STEP_S

ROBOT_STAND = "robot_stand"

_BUILDERS: dict[str, Callable[[Workshop, FixturePlan], FixtureHandle]] = {
    "cabinet": cabinet.add_cabinet,
    "double_cabinet": cabinet.add_cabinet,
    "drawer": drawer.add_drawer,
    "sink": sink.add_sink,
    "stove": stove.add_stove,
    "microwave": microwave.add_microwave,
    "coffee_machine": coffee_machine.add_coffee_machine,
}
# Half of the wall, at the height of the wall cabinets, that a fixture takes or keeps free above it.
WALL_HALF_M = {
    "cabinet": cabinet.HALF_WIDTH_M["cabinet"],
    "double_cabinet": cabinet.HALF_WIDTH_M["double_cabinet"],
    "coffee_machine": 0.25,
    "stove": counter.STOVE_HALF_M,
    "sink": 0.36,
}
_LEAST_FILLER_M = 0.2


def build_bay(plan: BayPlan) -> tuple[mujoco.MjSpec, Bay]:
    """Returns the uncompiled bay without a robot, and its handles.

    A robot is attached at the site `robot_stand`, whose x axis is where it looks.
    """
    spec = mujoco.MjSpec()
    _set_options(spec)
    looks.add_materials(spec, plan.finish)
    workshop = Workshop(spec)
    counter.add_room(workshop)
    counter.add_counter(workshop, plan.length_m, plan.fixtures)
    fixtures: dict[str, FixtureHandle] = {each.name: _BUILDERS[each.kind](workshop, each) for each in plan.fixtures}
    for i, span in enumerate(_free_wall(plan)):
        cabinet.add_filler(workshop, f"filler_{i}", span)
    things = {each.name: objects.add_object(workshop, each) for each in plan.objects}
    workshop.finish()
    half_rad = plan.stand.yaw_rad / 2
    spec.worldbody.add_site(
        name=ROBOT_STAND,
        pos=[plan.stand.x_m, plan.stand.y_m, 0.0],
        quat=[np.cos(half_rad), 0.0, 0.0, np.sin(half_rad)],
        group=4,
    )
    return spec, Bay(plan=plan, fixtures=fixtures, objects=things)


def _free_wall(plan: BayPlan) -> list[tuple[float, float]]:
    """Returns the spans of the wall, above the counter, that shut cabinets fill."""
    taken = [_on_wall(each) for each in plan.fixtures if each.kind in WALL_HALF_M]
    spans = counter.without((-plan.length_m / 2, plan.length_m / 2), taken)
    return [span for span in spans if span[1] - span[0] >= _LEAST_FILLER_M]


def _on_wall(fixture: FixturePlan) -> tuple[float, float]:
    half = WALL_HALF_M[fixture.kind]
    return fixture.x_m - half, fixture.x_m + half


def _set_options(spec: mujoco.MjSpec) -> None:
    """Sets physics as in the table's scene, and a light that is even enough to do without shadows."""
    spec.compiler.degree = False
    spec.option.timestep = PHYSICS_STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.density, spec.option.viscosity = AIR
    spec.visual.quality.offsamples = 0
    spec.visual.quality.shadowsize = 0
    # A box of 4 x 4 quads a side costs five times one of single ones, and under directional lights looks the same.
    spec.visual.quality.numquads, spec.visual.quality.numslices, spec.visual.quality.numstacks = 1, 14, 8
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 50.0
    spec.stat.extent = 1.0
    spec.stat.center = [0.0, -0.6, 1.0]
    spec.visual.headlight.ambient = [0.42] * 3
    spec.visual.headlight.diffuse = [0.15] * 3
    spec.visual.headlight.specular = [0.0] * 3
    for direction, strength in (((0.4, 0.7, -1.0), 0.35), ((-0.6, 0.5, -0.5), 0.2)):
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=[0.0, -2.0, 3.0],
            dir=direction,
            castshadow=False,
            ambient=[0.0] * 3,
            diffuse=[strength] * 3,
            specular=[0.1] * 3,
        )
