"""BinFill: put a given number of cubes of each color into the bin, then press the button.

Cubes vanish as they land in the bin, so their number must be remembered. In half of the scenes the table fills up as
time passes: the second cube of a color appears at step 50, the third at step 100, and so on.
Source: RoboMME's BinFill at 598e3b4, rules restated.

Kept from upstream on purpose: any cube counts as picked and as put in. A cube too many or of the wrong color fails only
once the list has come to the button, and then at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates
from dual_system.tasks.geometry import Footprint, pose
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import PlacedCube, draw_button, draw_cube, until_it_fits
from dual_system.tasks.props import BIN_HALF_M, BIN_HEIGHT_M, add_bin
from dual_system.tasks.scene import CUBE_COLORS, add_button, add_cube
from dual_system.tasks.task import Reasoning, Subtask, Task, task

APPEARANCE_STEPS = 50

# Ranges include both ends.
_NUM_COLORS = {"easy": 1, "medium": 2, "hard": 3}
_NUM_CUBES = {"easy": (4, 6), "medium": (8, 10), "hard": (10, 12)}
_NUM_WANTED_COLORS = {"easy": (1, 1), "medium": (1, 2), "hard": (2, 3)}
_NUM_WANTED = {"easy": (1, 3), "medium": (2, 4), "hard": (3, 5)}
_BIN_LOW_M, _BIN_HIGH_M, _BIN_YAW_RAD = (-0.05, -0.2), (0.15, 0.2), np.deg2rad(20.0)
_CUBES_CENTER_M, _CUBES_HALF_M, _GAP_M = (-0.1, 0.0), (0.2, 0.25), 0.02
_BUTTON, _BIN = "button", "bin"
_CUBES = tuple(f"cube_{i}" for i in range(12))


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One BinFill scene; ``wanted`` holds the number per color, in the order in which the oracle puts them in."""

    button_xy_m: tuple[float, float]
    bin: Footprint
    cubes: tuple[PlacedCube, ...]
    wanted: tuple[tuple[str, int], ...]
    is_filling_up: bool

    def of_color(self, color: str) -> list[str]:
        """Names of the color's cubes, in the order they appear."""
        return [name for name, cube in zip(_CUBES, self.cubes, strict=False) if cube.color == color]

    def colors_of(self, names: Sequence[str]) -> Counter[str]:
        """How many of each color these cubes are."""
        return Counter(self.cubes[_CUBES.index(name)].color for name in names)

    def appears_at_step(self, name: str) -> int:
        """The first observation that shows a cube."""
        rank = self.of_color(self.cubes[_CUBES.index(name)].color).index(name)
        return APPEARANCE_STEPS * rank if self.is_filling_up else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """Cubes that have fallen into the bin, in that order."""

    binned: tuple[str, ...] = ()


@task(family="counting")
class BinFill(Task[Layout, Memory]):
    """Fill the bin with given numbers of colored cubes, then press the button."""

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_button(spec, _BUTTON)
        add_bin(spec, _BIN)
        for cube in _CUBES:
            add_cube(spec, cube)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))

    def arrange(self, physics: Physics, layout: Layout) -> None:
        physics.place(_BUTTON, pose(*layout.button_xy_m, 0.0))
        physics.place(_BIN, pose(*layout.bin.center_m, BIN_HEIGHT_M / 2, layout.bin.yaw_rad))
        for name, cube in zip(_CUBES, layout.cubes, strict=False):
            if layout.appears_at_step(name) == 0:
                cube.put(physics, name)

    def stage(self, physics: Physics, layout: Layout, memory: Memory | None, step: int) -> None:
        appearing = [name for name in _CUBES[: len(layout.cubes)] if layout.appears_at_step(name) == step > 0]
        vanishing = memory.binned[-1:] if memory else ()  # those before it have gone already
        for name in appearing:
            layout.cubes[_CUBES.index(name)].put(physics, name)
        for name in vanishing:
            physics.park(name)
        if appearing or vanishing:
            physics.refresh()

    def instruction(self, layout: Layout) -> str:
        cubes = captions.counted_cubes(dict(_in_order_of_speech(dict(layout.wanted))))
        return f"put {cubes} into the bin, then press the button to stop"

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        return _steps(layout, _left(layout, ()))

    def subtasks_after(self, layout: Layout, memory: Memory) -> tuple[Subtask, ...]:
        """Those in the bin first, as they came; one too many or of another color takes the place of the last."""
        num_wanted = sum(count for _, count in layout.wanted)
        return _steps(layout, [*memory.binned, *_left(layout, memory.binned)][:num_wanted])

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        order = _left(layout, ())
        done, left = order[: index // 2], order[index // 2 :]
        count = "; ".join(
            f"{what}: {_listed(layout.colors_of(names)) or 'none'}"
            for what, names in (("Target", order), ("completed", done), ("remaining", left))
        )
        if not left:
            return Reasoning(text=f"{count}. Next, press the button[ at <>].", grounds=(f"{_BUTTON}/cap",))
        text = f"{count}. Next, move a {layout.cubes[_CUBES.index(left[0])].color} cube[ at <>] to the bin[ at <>]."
        return Reasoning(text=text, grounds=(left[0], _BIN))

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        """The first cube that goes into the bin was of the other color, which is asked for once.

        One cube before the end the one color is still missing here, and the other one there.
        """
        if len(layout.wanted) != 2 or layout.wanted[1][1] != 1:
            return ()
        (color, count), (other, _) = layout.wanted
        first = _CUBES.index(layout.of_color(color)[0])
        cubes = list(layout.cubes)
        cubes[first] = replace(cubes[first], color=other)
        twin = replace(layout, cubes=tuple(cubes), wanted=((other, 1), (color, count)))
        is_possible = twin.of_color(other)[0] == _CUBES[first] and len(twin.of_color(color)) >= count
        times = [[told.appears_at_step(name) for name in _CUBES[: len(cubes)]] for told in (layout, twin)]
        return (twin,) if is_possible and times[0] == times[1] else ()

    def remember(self, memory: Memory | None, physics: Physics, layout: Layout) -> Memory:
        binned = memory.binned if memory else ()
        for name in _CUBES[: len(layout.cubes)]:
            if name not in binned and _fell_in(physics, name):
                return Memory(binned=(*binned, name))  # one per step, as upstream counts
        return Memory(binned=binned)


def _left(layout: Layout, binned: Sequence[str]) -> list[str]:
    """The cubes that the list still wants after these, in its order."""
    had = layout.colors_of(binned)
    wanted = ((color, max(count - had[color], 0)) for color, count in layout.wanted)
    return [name for color, count in wanted for name in [n for n in layout.of_color(color) if n not in binned][:count]]


def _steps(layout: Layout, order: Sequence[str]) -> tuple[Subtask, ...]:
    """These cubes one after the other, then the button."""
    steps: list[Subtask] = []
    for num_binned, name in enumerate(order, start=1):
        color = layout.cubes[_CUBES.index(name)].color
        nth = captions.ORDINALS[layout.colors_of(order[:num_binned])[color] - 1]
        steps += [
            Subtask(
                text=f"pick up the {nth} {color} cube[ at <>]",
                grounds=(name,),
                is_done=partial(_is_any_picked, layout),
                failure=_pressed_early,
                motion=partial(_pick, name),
            ),
            Subtask(
                text="put it into the bin[ at <>]",
                grounds=(_BIN,),
                is_done=_has_binned(num_binned),
                failure=_pressed_early,
                motion=lambda motions: motions.drop_into(_BIN),
                carries=(name, *_CUBES[: len(layout.cubes)]),
            ),
        ]
    button = Subtask(
        text="press the button[ at <>]",
        grounds=(f"{_BUTTON}/cap",),
        is_done=lambda physics, memory: predicates.is_pressed(physics, _BUTTON),
        failure=partial(_miscounted, layout),
        motion=lambda motions: motions.press(_BUTTON),
    )
    return (*steps, button)


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    button = draw_button(rng)
    x_m, y_m = rng.uniform(_BIN_LOW_M, _BIN_HIGH_M)
    yaw_rad = float(rng.uniform(-_BIN_YAW_RAD, _BIN_YAW_RAD))
    bin_ = Footprint(center_m=(float(x_m), float(y_m)), half_m=BIN_HALF_M, yaw_rad=yaw_rad)
    colors = rng.permutation(list(CUBE_COLORS))[: _NUM_COLORS[difficulty]].tolist()
    asked = colors[: _between(rng, _NUM_WANTED_COLORS[difficulty])]
    # Several colors share the total at random; upstream lets one of them come away with nothing.
    wanted = Counter(rng.choice(asked, _between(rng, _NUM_WANTED[difficulty])).tolist())
    shown = [color for color in colors for _ in range(max(wanted[color], 1))]
    shown += rng.choice(colors, _between(rng, _NUM_CUBES[difficulty]) - len(shown)).tolist()
    cubes: list[PlacedCube] = []
    for color in rng.permutation(shown).tolist():
        taken = [button, bin_, *(cube.footprint for cube in cubes)]
        cubes.append(
            draw_cube(rng, color, center_m=_CUBES_CENTER_M, half_m=_CUBES_HALF_M, obstacles=taken, gap_m=_GAP_M)
        )
    order = rng.permutation(sorted(wanted)).tolist()
    return Layout(
        button_xy_m=button.center_m,
        bin=bin_,
        cubes=tuple(cubes),
        wanted=tuple((color, wanted[color]) for color in order),
        is_filling_up=bool(rng.integers(2)),
    )


def _between(rng: np.random.Generator, ends: tuple[int, int]) -> int:
    return int(rng.integers(*ends, endpoint=True))


def _in_order_of_speech(counts: dict[str, int]) -> list[tuple[str, int]]:
    return [(color, counts[color]) for color in CUBE_COLORS if color in counts]


def _fell_in(physics: Physics, name: str) -> bool:
    return predicates.is_dropped_onto(physics, name, _BIN) and predicates.is_let_go(physics, name)


def _is_any_picked(layout: Layout, physics: Physics, memory: Memory) -> bool:
    return predicates.first_picked(physics, _CUBES[: len(layout.cubes)]) is not None


def _has_binned(count: int) -> Callable[[Physics, Memory], bool]:
    return lambda physics, memory: len(memory.binned) >= count


def _pick(name: str, motions: Motions) -> Actions:
    return motions.pick(name)


def _pressed_early(physics: Physics, memory: Memory) -> str | None:
    return "pressed the button before enough cubes were in" if predicates.is_pressed(physics, _BUTTON) else None


def _miscounted(layout: Layout, physics: Physics, memory: Memory) -> str | None:
    binned = layout.colors_of(memory.binned)
    if binned == Counter(dict(layout.wanted)):
        return None
    had, asked = _listed(binned), _listed(dict(layout.wanted))
    return f"put in {had} instead of {asked}"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {color}" for color, count in _in_order_of_speech(counts))
