"""The paper's own results on RoboMME, typed from its Tables 1, 3, 4 and 7 and Figure 4: success in per cent.

They were measured in another simulator. They appear beside ours as published numbers, never as a baseline of ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

MARK = "paper, another simulator"

FAMILIES = MappingProxyType(
    {
        "counting": ("BinFill", "PickXtimes", "SwingXtimes", "StopCube"),
        "permanence": ("VideoUnmask", "ButtonUnmask", "VideoUnmaskSwap", "ButtonUnmaskSwap"),
        "reference": ("PickHighlight", "VideoRepick", "VideoPlaceButton", "VideoPlaceOrder"),
        "imitation": ("MoveCube", "InsertPeg", "PatternLock", "RouteStick"),
    }
)
"""Tasks of each family in the order of Table 7's columns."""
TASKS = tuple(task for tasks in FAMILIES.values() for task in tasks)

TABLE_7 = MappingProxyType(
    {
        "Human": (
            96.00, 100.00, 80.00, 78.00, 90.00, 92.00, 92.00, 90.00,
            92.00, 92.00, 98.00, 90.00, 90.00, 98.00, 84.00, 86.00,
        ),
        "SimpleSG+Oracle": (
            85.78, 99.78, 100.00, 44.67, 33.11, 22.00, 15.56, 15.56,
            44.00, 27.78, 31.33, 26.00, 87.33, 10.00, 95.33, 55.11,
        ),
        "GroundSG+Oracle": (
            85.78, 100.00, 100.00, 49.67, 98.78, 95.00, 99.22, 80.22,
            83.33, 97.33, 100.00, 100.00, 87.78, 15.56, 97.00, 55.56,
        ),
        "π0.5 1×": (
            30.00, 42.89, 35.56, 6.67, 20.44, 22.22, 18.67, 6.67,
            11.33, 0.44, 31.11, 25.78, 26.00, 1.56, 2.89, 4.67,
        ),
        "π0.5 + past actions 1×": (
            26.67, 58.33, 26.67, 4.67, 30.67, 23.67, 20.67, 16.00,
            12.33, 8.67, 24.00, 18.67, 34.00, 1.00, 4.00, 5.67,
        ),
        "SAM2Act+ 1×": (
            40.00, 76.00, 25.33, 0.00, 27.33, 32.00, 18.00, 26.67,
            17.33, 5.33, 24.67, 20.00, 29.33, 0.00, 0.00, 0.00,
        ),
        "MemER 1×": (
            56.67, 79.33, 59.33, 0.00, 81.33, 72.00, 38.00, 21.33,
            70.67, 25.33, 30.00, 26.00, 82.67, 6.67, 16.67, 12.00,
        ),
        "FrameSamp+Modul 1×": (
            39.56, 87.33, 92.00, 42.00, 32.67, 25.11, 24.44, 18.22,
            22.89, 30.44, 60.00, 32.00, 77.78, 7.56, 53.56, 66.67,
        ),
        "PonderPounce 1×": (
            50.67, 93.33, 72.00, 82.67, 94.67, 97.33, 25.33, 34.00,
            85.33, 40.67, 83.33, 79.33, 81.33, 6.00, 12.67, 34.67,
        ),
        "FrameSamp+Modul 9×": (
            74.00, 96.00, 98.00, 76.00, 28.00, 22.00, 20.00, 28.00,
            32.00, 42.00, 80.00, 78.00, 92.00, 8.00, 66.00, 86.00,
        ),
        "PonderPounce 9×": (
            74.00, 98.00, 93.33, 60.00, 96.67, 100.00, 73.33, 50.67,
            92.67, 88.67, 92.00, 97.33, 93.33, 18.67, 25.33, 54.67,
        ),
    }
)  # fmt: skip
"""Success per task, in the order of `TASKS`."""

TABLE_1 = MappingProxyType(
    {
        "Human": (88.50, 91.00, 93.00, 89.50, 90.50),
        "SimpleSG+Oracle": (82.56, 21.56, 32.28, 61.94, 49.58),
        "GroundSG+Oracle": (83.86, 93.31, 95.16, 63.98, 84.08),
        "π0.5 1×": (28.78, 17.00, 17.16, 8.78, 17.93),
        "π0.5 + past actions 1×": (29.09, 22.75, 15.92, 11.17, 19.73),
        "SAM2Act+ 1×": (35.33, 26.00, 16.83, 7.33, 21.37),
        "MemER 1×": (48.83, 53.16, 38.00, 29.50, 42.38),
        "FrameSamp+Modul 1×": (65.22, 25.11, 36.33, 51.39, 44.51),
        "PonderPounce 1×": (74.67, 62.83, 72.17, 33.67, 60.83),
        "FrameSamp+Modul 9×": (86.00, 24.50, 58.00, 63.00, 57.88),
        "PonderPounce 9×": (81.33, 80.17, 92.67, 48.00, 75.54),
    }
)
"""Success per family, in the order of `FAMILIES`, and the average."""

TABLE_3 = MappingProxyType(
    {
        "continuous cognition": (74.67, 62.83, 72.17, 33.67, 60.83),
        "trained without demonstration reasoning": (70.50, 60.00, 36.67, 25.67, 48.21),
        "trained without LM-head grounding": (49.34, 27.17, 21.50, 13.84, 27.96),
        "subgoal text in place of cognition": (62.00, 61.67, 73.34, 42.83, 59.96),
    }
)
"""The training ablations of Table 3, in the form of `TABLE_1`."""

TABLE_4 = MappingProxyType(
    {
        "every query": (74.67, 62.83, 72.17, 33.67, 60.83),
        "transitions only, age reported as 300 ms": (0.17, 0.17, 0.67, 6.33, 1.83),
    }
)
"""The delivery ablations of Table 4 with one checkpoint, in the form of `TABLE_1`."""

FIGURE_4 = MappingProxyType(
    {
        "1 s": {0.3: 1.00, 2.3: 7.11, 4.3: 9.22},
        "2 s": {0.3: 1.00, 4.3: 3.19},
        "4 s": {0.3: 1.00, 4.3: 1.14},
    }
)
"""Per refresh interval in training: the loss at an age [s] relative to that at 0.3 s, from the text of 5.2."""
FIGURE_4_FRESH = MappingProxyType({"1 s": 0.117, "2 s": 0.213, "4 s": 0.232})
"""Per refresh interval in training: the loss at 0.3 s."""

SHOWN = (
    "π0.5 1×",
    "MemER 1×",
    "FrameSamp+Modul 1×",
    "PonderPounce 1×",
    "FrameSamp+Modul 9×",
    "PonderPounce 9×",
)
"""Methods of Table 7 to show beside ours."""


def mean_of(method: str, tasks: Sequence[str]) -> float:
    """Returns a method's mean over some of the tasks [%], from Table 7; KeyError if there is no such task or method."""
    by_task = dict(zip(TASKS, TABLE_7[method], strict=True))
    return sum(by_task[task] for task in tasks) / len(tasks)
