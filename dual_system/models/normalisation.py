"""Robot units to the network's [-1, 1] and back: an `action_space` and the quantiles of its dims."""

# N horizon, 8 = 7 arm joints (rad) + gripper (in space "native": as many as the robot has), D numbers of the space

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dual_system.models.action_space import ROBOT_DIM, ActionSpace, actions_in, num_dims, states_in, targets_from

Floats = NDArray[np.float32]

QUANTILE_EPS = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantiles:
    """1 % and 99 % quantiles of each dim in the training data; values beyond them map beyond [-1, 1]."""

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
    """How the network's numbers map to the robot: the action space of its states and actions, and their quantiles.

    Raises:
        ValueError: no such space, or quantiles with a wrong number of dims.
    """

    state: Quantiles
    action: Quantiles
    space: ActionSpace = "joint_delta"
    reach: tuple[float, ...] = ()
    """Spread of each chunk row relative to the whole chunk's, by which the row is scaled; () for one scale, as in the
    released RoboMME statistics. The first rows move little: on the whole chunk's scale, the differences that decide a
    grasp drown in the flow's residual noise."""

    def __post_init__(self) -> None:
        expected = num_dims(self.space)
        for name, table in (("state", self.state), ("action", self.action)):
            if expected is not None and table.num_dims != expected:
                raise ValueError(
                    f"statistics in space {self.space!r} need {expected} {name} dims, came {table.num_dims}; "
                    "collect them in that space (TrainingSet.statistics)"
                )
        if any(each <= 0 for each in self.reach):
            raise ValueError(f"a row's reach must be above 0, came {self.reach}")
        if self.reach and self.space == "native":
            raise ValueError("a row's reach is a share of moves from the chunk's first state; native commands are none")

    @property
    def robot_state_dim(self) -> int:
        """Dims of the robot's state, before `action_space.states_in`."""
        return self.state.num_dims if self.space == "native" else ROBOT_DIM

    @property
    def robot_command_dim(self) -> int:
        """Dims of a row in the robot's units."""
        return self.action.num_dims if self.space == "native" else ROBOT_DIM

    def normalise_states(self, states_8: ArrayLike) -> Floats:
        """The robot's states (..., 8) -> (..., D) as the network reads them."""
        return self.state.normalise(states_in(self.space, states_8))

    def normalise_targets(self, targets_N8: ArrayLike, state_8: ArrayLike, *, first_row: int = 0) -> Floats:
        """Absolute joint targets -> the network's actions (N, D); all rows are relative to the one current state.

        ``first_row``: index of the first target within its chunk.
        """
        rows_1N = np.arange(len(np.asarray(targets_N8)))[None]
        return self.normalise_chunks(targets_N8, np.asarray(state_8)[None], rows_1N, first_row=first_row)[0]

    def normalise_chunks(
        self, targets_T8: ArrayLike, states_M8: ArrayLike, rows_MN: NDArray[np.integer], *, first_row: int = 0
    ) -> Floats:
        """`normalise_targets` for M chunks (M, N, D): chunk m starts at state m and commands ``targets[rows[m]]``."""
        actions_MND = actions_in(self.space, targets_T8, states_M8, rows_MN)
        actions_MND[..., :-1] /= self._reach(actions_MND.shape[1], first_row)
        return self.action.normalise(actions_MND)

    def absolute_targets(self, actions_ND: ArrayLike, state_8: ArrayLike) -> Floats:
        """The network's actions (N, D) -> rows in the robot's units, (N, 8) (`targets_from`)."""
        actions = self.action.denormalise(actions_ND)
        actions[:, :-1] *= self._reach(len(actions), 0)
        return targets_from(self.space, actions, state_8).astype(np.float32)

    def _reach(self, num_rows: int, first_row: int) -> NDArray[np.float64]:
        """Scales (N, 1) of the rows. Raises ValueError for a chunk longer than the statistics cover."""
        if not self.reach:
            return np.ones((num_rows, 1))
        if first_row + num_rows > len(self.reach):
            raise ValueError(f"statistics are of chunks of {len(self.reach)} rows, came {first_row + num_rows}")
        return np.array(self.reach)[first_row : first_row + num_rows, None]


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
"""RoboMME's published statistics, rounded to three decimals. Right for models trained with this table; a public
RoboMME checkpoint needs the exact numbers of its own norm_stats."""
