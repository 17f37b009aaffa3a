"""The twenty-four tasks of RoboCasa-DC: instruction, start, success and horizon as one table, and the two splits.

Names, texts, thresholds and horizons are the benchmark's (RoboCasa v0.2 as RoboCasa-DC uses it).
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from dual_system.tasks.kitchen import starts
from dual_system.tasks.kitchen.fixtures.counter import COUNTER
from dual_system.tasks.kitchen.plan import Check, Goal, Instances, Scene, Target
from dual_system.tasks.kitchen.starts import Start
from dual_system.tasks.scene import SceneFullError
from dual_system.tasks.task import TaskError

Family = Literal["pnp", "doors", "drawers", "sink", "stove", "microwave", "coffee"]
PAPER_HORIZON = 1000
"""Control steps that the paper's evaluation gives every task; the table's are the tasks' own."""

_OBJECT_FAR = Check(kind="far", of="{obj}", low=0.25)
_ON_COUNTER = Check(kind="touches", of="{obj}", to=COUNTER, low=1.0)
_IN_CONTAINER = (
    Check(kind="touches", of="{obj}", to="{container}", low=1.0),
    Check(kind="radii", of="{obj}", to="{container}", high=0.7),
)
_OPEN = (Check(kind="door", of="{fixture}", low=0.90),)
_SHUT = (Check(kind="door", of="{fixture}", high=0.05),)
_JUST_OVER, _JUST_UNDER = float(np.nextafter(0.40, 1.0)), float(np.nextafter(0.35, 0.0))
WATER_RUNS = Check(kind="angle", of="{fixture}/handle", low=_JUST_OVER, high=np.pi)
BURNS = Check(kind="turned_by", of="{fixture}/{part}", low=0.35)
SPOUT_AT = {
    "left": Check(kind="turned", of="{fixture}/spout", high=-np.pi / 6),
    "right": Check(kind="turned", of="{fixture}/spout", low=np.pi / 6),
}
_START_FAR = Check(kind="far", of="{fixture}/start_button", low=0.15)


@dataclass(frozen=True, slots=True, kw_only=True)
class KitchenTask:
    """One task. ``instruction`` has the start's words in braces, ``checks`` the target's names."""

    family: Family
    instruction: str
    start: Callable[[np.random.Generator, Instances], Start]
    checks: tuple[Check, ...]
    horizon: int = 500


TASKS: Mapping[str, KitchenTask] = {
    "PnPCounterToCab": KitchenTask(
        family="pnp",
        instruction="pick the {obj} from the counter and place it in the cabinet",
        start=partial(starts.cabinet_pnp, is_in_cabinet=False),
        checks=(Check(kind="inside", of="{obj}", to="{fixture}", low=-0.05), _OBJECT_FAR),
    ),
    "PnPCabToCounter": KitchenTask(
        family="pnp",
        instruction="pick the {obj} from the cabinet and place it on the counter",
        start=partial(starts.cabinet_pnp, is_in_cabinet=True),
        checks=(_ON_COUNTER, _OBJECT_FAR),
    ),
    "PnPCounterToSink": KitchenTask(
        family="pnp",
        instruction="pick the {obj} from the counter and place it in the sink",
        start=partial(starts.sink_pnp, is_in_sink=False),
        checks=(Check(kind="centre_inside", of="{obj}", to="{fixture}", low=0.0), _OBJECT_FAR),
        horizon=700,
    ),
    "PnPSinkToCounter": KitchenTask(
        family="pnp",
        instruction="pick the {obj} from the sink and place it on the {container} located on the counter",
        start=partial(starts.sink_pnp, is_in_sink=True),
        checks=(*_IN_CONTAINER, Check(kind="touches", of="{container}", to=COUNTER, low=1.0), _OBJECT_FAR),
    ),
    "PnPCounterToMicrowave": KitchenTask(
        family="pnp",
        instruction="pick the {obj} from the counter and place it in the microwave",
        start=partial(starts.microwave_pnp, is_in_microwave=False),
        checks=(
            Check(kind="touches", of="{obj}", to="{container}", low=1.0),
            Check(kind="touches", of="{container}", to="{fixture}", low=1.0),
            _OBJECT_FAR,
        ),
        horizon=600,
    ),
    "PnPMicrowaveToCounter": KitchenTask(
        family="pnp",
        instruction="pick the {obj} from the microwave and place it on {container} located on the counter",
        start=partial(starts.microwave_pnp, is_in_microwave=True),
        checks=(*_IN_CONTAINER, _OBJECT_FAR),
    ),
    "PnPCounterToStove": KitchenTask(
        family="pnp",
        instruction="pick the {obj} from the plate and place it in the {pan}",
        start=partial(starts.stove_pnp, is_in_pan=False),
        checks=(
            Check(kind="touches", of="{obj}", to="{container}", low=1.0),
            Check(kind="apart_xy", of="{obj}", to="{container}", high=0.07),
            _OBJECT_FAR,
        ),
    ),
    "PnPStoveToCounter": KitchenTask(
        family="pnp",
        instruction="pick the {obj} from the {pan} and place it {on} the {container}",
        start=partial(starts.stove_pnp, is_in_pan=True),
        checks=(*_IN_CONTAINER, _OBJECT_FAR),
    ),
    "OpenSingleDoor": KitchenTask(
        family="doors",
        instruction="open the {fixture} door",
        start=partial(starts.doors, is_open=False, num=1),
        checks=_OPEN,
    ),
    "CloseSingleDoor": KitchenTask(
        family="doors",
        instruction="close the {fixture} door",
        start=partial(starts.doors, is_open=True, num=1),
        checks=_SHUT,
    ),
    "OpenDoubleDoor": KitchenTask(
        family="doors",
        instruction="open the cabinet doors",
        start=partial(starts.doors, is_open=False, num=2),
        checks=_OPEN,
        horizon=1000,
    ),
    "CloseDoubleDoor": KitchenTask(
        family="doors",
        instruction="close the cabinet doors",
        start=partial(starts.doors, is_open=True, num=2),
        checks=_SHUT,
        horizon=700,
    ),
    "OpenDrawer": KitchenTask(
        family="drawers",
        instruction="open the {side} drawer",
        start=partial(starts.drawers, is_open=False),
        checks=(Check(kind="drawer", of="{fixture}", low=0.95),),
    ),
    "CloseDrawer": KitchenTask(
        family="drawers",
        instruction="close the {side} drawer",
        start=partial(starts.drawers, is_open=True),
        checks=(Check(kind="drawer", of="{fixture}", high=0.05),),
    ),
    "TurnOnSinkFaucet": KitchenTask(
        family="sink",
        instruction="turn on the sink faucet",
        start=partial(starts.faucet, is_on=False),
        checks=(WATER_RUNS,),
    ),
    "TurnOffSinkFaucet": KitchenTask(
        family="sink",
        instruction="turn off the sink faucet",
        start=partial(starts.faucet, is_on=True),
        checks=(Check(kind="angle", of="{fixture}/handle", high=0.40),),
    ),
    "TurnSinkSpout": KitchenTask(
        family="sink",
        instruction="turn the sink spout to the {side}",
        start=starts.spout,
        checks=(),  # those of the side, see `goal_of`
    ),
    "TurnOnStove": KitchenTask(
        family="stove",
        instruction="turn on the {burner} burner of the stove",
        start=partial(starts.knob, is_on=False),
        checks=(BURNS,),
    ),
    "TurnOffStove": KitchenTask(
        family="stove",
        instruction="turn off the {burner} burner of the stove",
        start=partial(starts.knob, is_on=True),
        checks=(Check(kind="turned_by", of="{fixture}/{part}", high=_JUST_UNDER),),
    ),
    "TurnOnMicrowave": KitchenTask(
        family="microwave",
        instruction="press the start button on the microwave",
        start=partial(starts.microwave_buttons, is_on=False),
        checks=(Check(kind="runs", of="{fixture}", low=1.0), _START_FAR),
    ),
    "TurnOffMicrowave": KitchenTask(
        family="microwave",
        instruction="press the stop button on the microwave",
        start=partial(starts.microwave_buttons, is_on=True),
        checks=(
            Check(kind="runs", of="{fixture}", high=0.0),
            Check(kind="far", of="{fixture}/stop_button", low=0.15),
        ),
    ),
    "CoffeePressButton": KitchenTask(
        family="coffee",
        instruction="press the button on the coffee machine to serve coffee",
        start=starts.coffee_button,
        checks=(Check(kind="runs", of="{fixture}", low=1.0), _START_FAR),
        horizon=300,
    ),
    "CoffeeSetupMug": KitchenTask(
        family="coffee",
        instruction="pick the mug from the counter and place it under the coffee machine dispenser",
        start=starts.coffee_setup,
        checks=(
            Check(kind="apart_xy", of="{obj}", to="{fixture}", high=0.04),
            Check(kind="apart_z", of="{obj}", to="{fixture}", high=0.10),
            _OBJECT_FAR,
        ),
        horizon=600,
    ),
    "CoffeeServeMug": KitchenTask(
        family="coffee",
        instruction="pick the mug from under the coffee machine dispenser and place it on the counter",
        start=starts.coffee_serve,
        checks=(_ON_COUNTER, _OBJECT_FAR),
        horizon=600,
    ),
}

UNSEEN_BY_CATEGORY = ("CloseDrawer", "TurnOffSinkFaucet", "OpenDoubleDoor", "CoffeeServeMug", "PnPCounterToMicrowave")
"""Held-out tasks of the category-balanced split (19 seen, 5 unseen)."""
UNSEEN_BY_PRECISION = (
    "TurnOffStove",
    "CoffeePressButton",
    "TurnOffSinkFaucet",
    "PnPCounterToSink",
    "PnPStoveToCounter",
)
"""Held-out tasks of the precision-sensitive split."""


def kitchen_task(name: str) -> KitchenTask:
    """Returns a task. Raises TaskError for an unknown name."""
    if name not in TASKS:
        close = difflib.get_close_matches(name, TASKS, n=1)
        hint = f"Did you mean {close[0]!r}? " if close else ""
        raise TaskError(f"unknown kitchen task {name!r}. {hint}Expected one of {', '.join(TASKS)}.")
    return TASKS[name]


def goal_of(name: str, target: Target, words: Mapping[str, str], *, instruction: str = "") -> Goal:
    """Returns a task's goal for a target; another ``instruction`` replaces the task's own."""
    task = kitchen_task(name)
    checks = (SPOUT_AT[target.part],) if name == "TurnSinkSpout" else task.checks
    return Goal(
        task=name,
        target=target,
        instruction=(instruction or task.instruction).format(**words),
        checks=tuple(check.about(target) for check in checks),
    )


def draw_scene(name: str, seed: int, instances: Instances = "A") -> Scene:
    """Returns the scene that a seed draws. Raises TaskError for an unknown name."""
    task = kitchen_task(name)
    start = until_it_fits(lambda rng: task.start(rng, instances), seed)
    goal = goal_of(name, start.target, start.words)
    return Scene(task=name, seed=seed, horizon=task.horizon, plan=start.draft.plan(), goals=(goal,))


def until_it_fits(draw: Callable[[np.random.Generator], Start], seed: int) -> Start:
    """Returns the first start that a seed draws in which everything has found room."""
    rng = np.random.default_rng(seed)
    while True:
        try:
            return draw(rng)
        except SceneFullError:
            continue
