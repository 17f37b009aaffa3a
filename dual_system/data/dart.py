"""DART: noise moves the arm off the oracle's path while the labels stay on it, so that data show how to come back.

Laskey et al., "DART: Noise Injection for Robust Imitation Learning" (2017): the clean action plus noise is executed,
the clean action is learned. Here the noise on the seven joint targets is an Ornstein-Uhlenbeck process; its strength
differs between episodes, and some have none. It fades as the tool nears anything that it could touch, and as the oracle
comes to a stop: a waiting script commands the arm to stay where it is, and would drift off with the noise. An episode's
noise is a function of its seed alone; the gripper has none.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.clearance import Clearance
from dual_system.tasks.physics import CONTROL_HZ, Physics

NoiseKind = Literal["none", "dart"]

_NOISE_STREAM = 2  # of a seed's random numbers; the scene and failed grasps draw from others


@dataclass(frozen=True, slots=True, kw_only=True)
class DartConfig:
    """How strong the noise is, and where."""

    std_rad: float = 0.025
    """Standard deviation on every joint target, before the episode's factor."""
    least_factor: float = 0.3
    most_factor: float = 1.7
    """Bounds of an episode's factor, drawn uniformly."""
    clean_share: float = 0.15
    """Share of episodes without noise."""
    correlation_s: float = 0.5
    """Time in which the noise decays to 1/e."""
    touch_m: float = 0.03
    """Clearance of the tool up to which there is no noise: the fingers reach beyond it."""
    free_m: float = 0.13
    """Clearance from which on the noise is full; in between it grows linearly."""
    moving_rad_s: float = 0.2
    """Speed of the fastest joint's target from which on the noise is full; below it is reduced linearly."""

    def share(self, clearance_m: float, speed_rad_s: float) -> float:
        """Returns how much of the noise is left, in [0, 1], at a clearance of the tool and a speed of the plan."""
        freedom = min(1.0, max(0.0, (clearance_m - self.touch_m) / (self.free_m - self.touch_m)))
        return freedom * min(1.0, speed_rad_s / self.moving_rad_s)

    def settings(self) -> dict[str, Any]:
        """Returns what a dataset records of it."""
        return {"kind": "dart", **asdict(self)}


DART = DartConfig()


def episode_std_rad(kind: NoiseKind, seed: int, config: DartConfig = DART) -> float:
    """Returns the noise's standard deviation in an episode, far from everything; 0 in one that is clean."""
    return 0.0 if kind == "none" else _std_rad(np.random.default_rng((seed, _NOISE_STREAM)), config)


class Dart:
    """The noise of one episode. Call `executed` once per control step, before the step."""

    def __init__(self, physics: Physics, seed: int, config: DartConfig = DART) -> None:
        self._rng = np.random.default_rng((seed, _NOISE_STREAM))
        self.std_rad = _std_rad(self._rng, config)
        self._robot, self._clearance, self._config = physics.robot, Clearance(physics), config
        self._keeps = float(np.exp(-1.0 / (config.correlation_s * CONTROL_HZ)))
        self._planned = physics.arm_qpos()
        self._nudge = np.zeros(self._planned.size)  # of unit variance once it has forgotten that it began at rest

    def executed(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the action (8,) that is executed in place of a planned one, within the robot's limits."""
        fresh = self._rng.standard_normal(self._nudge.size)
        self._nudge = self._keeps * self._nudge + np.sqrt(1 - self._keeps**2) * fresh
        nudged = action.astype(np.float64)
        speed_rad_s = float(np.abs(nudged[:-1] - self._planned).max()) * CONTROL_HZ
        self._planned = nudged[:-1].copy()
        strength_rad = self.std_rad * self._config.share(self._clearance.tool_m(), speed_rad_s)
        if strength_rad == 0.0:
            return action
        nudged[:-1] += strength_rad * self._nudge
        return nudged.clip(self._robot.action_low, self._robot.action_high).astype(np.float32)


def _std_rad(rng: np.random.Generator, config: DartConfig) -> float:
    """Draws an episode's strength: the first two numbers of its stream."""
    is_clean = rng.random() < config.clean_share
    factor = rng.uniform(config.least_factor, config.most_factor)
    return 0.0 if is_clean else config.std_rad * factor
