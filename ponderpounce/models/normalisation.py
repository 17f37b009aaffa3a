"""Robot units to the network's [-1, 1] and back: quantiles, and arm actions as deltas from the current state."""

# N horizon, 8 = 7 arm joints (rad) + gripper

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]

QUANTILE_EPS = 1e-6
NUM_ARM_JOINTS = 7
GRIPPER_MIN, GRIPPER_MAX = -1.0, 1.0  # closed, open


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantiles:
    """1 % and 99 % quantiles of each dim in the training data; what lies beyond maps beyond [-1, 1]."""

    q01: tuple[float, ...]
    q99: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.q01) != len(self.q99):
            raise ValueError(f"q01 has {len(self.q01)} dims and q99 {len(self.q99)}; they must agree")
        if any(low > high for low, high in zip(self.q01, self.q99, strict=True)):
            raise ValueError(f"q01 {self.q01} exceeds q99 {self.q99} in some dim")

    @property
    def num_dims(self) -> int:
        return len(self.q01)

    @property
    def _low(self) -> NDArray[np.float64]:
        return np.asarray(self.q01)

    @property
    def _span(self) -> NDArray[np.float64]:
        return np.asarray(self.q99) - self._low + QUANTILE_EPS

    def normalise(self, values: ArrayLike) -> Floats:
        """(..., dims) in robot units -> (..., dims) float32, mostly in [-1, 1]."""
        return ((np.asarray(values, dtype=np.float64) - self._low) / self._span * 2.0 - 1.0).astype(np.float32)

    def denormalise(self, values: ArrayLike) -> Floats:
        """Inverse of `normalise`."""
        return ((np.asarray(values, dtype=np.float64) + 1.0) / 2.0 * self._span + self._low).astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotStatistics:
    """Quantiles of the state, and of the action as the network learns it: arm deltas, absolute gripper."""

    state: Quantiles
    action: Quantiles

    def normalise_targets(self, targets_N8: ArrayLike, state_8: ArrayLike) -> Floats:
        """Absolute joint targets -> the network's actions; all rows are relative to the one current state."""
        actions_N8 = np.array(targets_N8, dtype=np.float64)
        actions_N8[..., :NUM_ARM_JOINTS] -= np.asarray(state_8, dtype=np.float64)[:NUM_ARM_JOINTS]
        return self.action.normalise(actions_N8)

    def absolute_targets(self, actions_N8: ArrayLike, state_8: ArrayLike) -> Floats:
        """The network's actions -> absolute joint targets (rad) and gripper, clipped to [-1, 1]."""
        rows_N8 = self.action.denormalise(actions_N8)
        rows_N8[..., :NUM_ARM_JOINTS] += np.asarray(state_8, dtype=np.float32)[:NUM_ARM_JOINTS]
        rows_N8[..., NUM_ARM_JOINTS] = rows_N8[..., NUM_ARM_JOINTS].clip(GRIPPER_MIN, GRIPPER_MAX)
        return rows_N8


ROBOMME = RobotStatistics(
    state=Quantiles(
        q01=(-0.344, -0.227, -0.281, -2.860, -0.206, 1.571, -0.437, 0.0),
        q99=(0.387, 0.985, 0.274, -1.162, 0.209, 3.053, 2.107, 0.040),
    ),
    action=Quantiles(
        q01=(-0.180, -0.319, -0.131, -0.534, -0.127, -0.292, -0.403, -1.0),
        q99=(0.196, 0.377, 0.117, 0.414, 0.126, 0.522, 0.417, 1.0),
    ),
)
"""RoboMME's published statistics, as we have them: rounded to three decimals. Right for models trained with
this table; a public RoboMME checkpoint wants the exact numbers of its own norm_stats."""
