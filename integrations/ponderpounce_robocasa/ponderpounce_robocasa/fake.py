"""A fake of RoboCasa-DC's environment: its observables, its way of being restored, and an arm that drifts as commanded.

It tells a program from one that mixes up numbers, flips or calls; it says nothing about kitchens.

    python -m ponderpounce_robocasa --environment ponderpounce_robocasa.fake:make ...
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from ponderpounce_robocasa import layout

NUM_SIM = 5
"""Numbers of the simulator's state: time, then the hand's place and the step count's stand-in."""
REACHED_M = 0.48


class FakeKitchen:
    """Succeeds once the hand has drifted `REACHED_M` along x; ``calls`` are those of restoring, in order."""

    action_dim = len(layout.ACTION_NAMES)

    def __init__(self, task: str, seed: int) -> None:
        self.task, self.seed = task, seed
        self.calls: list[str] = []
        self.rows: list[np.ndarray] = []
        self._meta: dict[str, Any] = {}
        self._state = np.zeros(NUM_SIM)
        ends = np.cumsum([size for _, size in layout.BODY_PARTS])
        parts = {name: (int(end) - size, int(end)) for (name, size), end in zip(layout.BODY_PARTS, ends, strict=True)}
        self.robots = [SimpleNamespace(composite_controller=SimpleNamespace(_action_split_indexes=parts))]
        self.sim = SimpleNamespace(
            reset=lambda: self._called("sim.reset"),
            forward=lambda: self._called("sim.forward"),
            set_state_from_flattened=self._set_state,
            get_state=lambda: SimpleNamespace(flatten=lambda: self._state.copy()),
        )

    def set_ep_meta(self, meta: dict[str, Any]) -> None:
        self._called("set_ep_meta")
        self._meta = meta

    def reset(self) -> None:
        self._called("reset")

    def edit_model_xml(self, xml: str) -> str:
        self._called("edit_model_xml")
        return xml + "<!-- edited -->"

    def reset_from_xml_string(self, xml: str) -> None:
        self._called("reset_from_xml_string" if xml.endswith("<!-- edited -->") else "reset from XML as it was stored")

    def step(self, row: np.ndarray) -> tuple[dict[str, Any], float, bool, dict[str, Any]]:
        self.rows.append(np.array(row))
        self._state[0] += 1 / layout.CONTROL_HZ
        self._state[1:4] += 0.05 * np.clip(row[:3], -1, 1)
        return self._get_observations(), 0.0, False, {}

    def _check_success(self) -> bool:
        return bool(self._state[1] >= REACHED_M)

    def _get_observations(self, force_update: bool = False) -> dict[str, Any]:
        """Numbers that count up through the state's order, but for the hand's place; pictures are bright above."""
        counted = np.arange(layout.NUM_STATE) / 1000  # within the robot file's limits
        found: dict[str, Any] = {}
        begin = 0
        for name, size in layout.STATE:
            found[name] = counted[begin : begin + size].copy()
            begin += size
        found["robot0_eef_pos"] = self._state[1:4].copy()
        del found["robot0_joint_pos"]  # as PandaOmron's, unless it is activated
        angles = counted[:7]
        found["robot0_joint_pos_cos"], found["robot0_joint_pos_sin"] = np.cos(angles), np.sin(angles)
        for shade, observable in enumerate(layout.CAMERAS.values(), start=1):
            upright = np.zeros((layout.PX, layout.PX, 3), np.uint8)
            upright[: layout.PX // 2] = 60 * shade
            found[observable] = upright[::-1]
        return found

    def _set_state(self, state: np.ndarray) -> None:
        self._called("sim.set_state_from_flattened")
        self._state = np.array(state, np.float64)

    def _called(self, name: str) -> None:
        self.calls.append(name)


def make(task: str, seed: int) -> FakeKitchen:
    return FakeKitchen(task, seed)
