"""A residual head that is a perceptron: from the newest joints and the due row to a bounded correction of the joints.

Its hidden layer is random and fixed; the last layer is fitted in closed form (ridge regression), so fitting to a few
thousand ticks takes a second, without gradients. Untrained, the last layer is zero: no correction.
"""

# T ticks, A action dim, J = A - 1 joints, F features, U hidden units

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from clock.residual import Due
from clock.timebase import NS_PER_S
from protocol import files
from protocol.messages import Floats

_ARRAYS = ("inner", "outer", "limit_rad")
_TICKS_PER_UNIT = 20.0
RIDGE = 1e-3
MAX_FILE_BYTES = 16 << 20


@dataclass(frozen=True, kw_only=True, eq=False)
class ResidualMlp:
    """See the module. Raises ValueError if the arrays do not fit each other or are not finite."""

    inner: Floats
    """(F, U)"""
    outer: Floats
    """(U + 1, J), bias last"""
    limit_rad: Floats
    """(J,): largest correction per joint"""

    def __post_init__(self) -> None:
        units, joints = self.inner.shape[-1], self.limit_rad.shape[-1]
        shapes = {name: getattr(self, name).shape for name in _ARRAYS}
        expected = {"inner": (_num_features(joints), units), "outer": (units + 1, joints), "limit_rad": (joints,)}
        if shapes != expected:
            raise ValueError(f"residual head: expected arrays of {expected}, came {shapes}")
        if not all(np.isfinite(getattr(self, name)).all() for name in _ARRAYS):
            raise ValueError("residual head: expected finite numbers in inner, outer and limit_rad")

    @classmethod
    def untrained(cls, *, limit_rad: Floats, num_units: int = 64, seed: int = 0) -> ResidualMlp:
        joints = len(limit_rad)
        inner = np.random.default_rng(seed).standard_normal((_num_features(joints), num_units))
        return cls(
            inner=(inner / np.sqrt(len(inner))).astype(np.float32),
            outer=np.zeros((num_units + 1, joints), np.float32),
            limit_rad=np.asarray(limit_rad, np.float32),
        )

    def fitted(self, seen: Sequence[Due], wanted_TJ: Floats) -> ResidualMlp:
        """Returns the head with the same hidden layer whose corrections fit ``wanted_TJ`` (rad) best."""
        hidden_TU = np.stack([self._hidden(due) for due in seen]).astype(np.float64)
        gram = hidden_TU.T @ hidden_TU + RIDGE * np.eye(hidden_TU.shape[1])
        scaled_TJ = np.arctanh(np.clip(wanted_TJ / self.limit_rad, -0.99, 0.99))
        outer = np.linalg.solve(gram, hidden_TU.T @ scaled_TJ).astype(np.float32)
        return ResidualMlp(inner=self.inner, outer=outer, limit_rad=self.limit_rad)

    @cached_property
    def digest(self) -> str:
        digest = hashlib.blake2b(digest_size=8)
        for name in _ARRAYS:
            digest.update(np.ascontiguousarray(getattr(self, name), np.float32).tobytes())
        return f"mlp-{digest.hexdigest()}"

    def correction(self, due: Due) -> Floats:
        """See `ResidualHead`. Raises ValueError for a robot with another number of joints."""
        joints_J = np.tanh(self._hidden(due) @ self.outer) * self.limit_rad
        return np.append(joints_J, 0.0).astype(np.float32)

    def _hidden(self, due: Due) -> Floats:
        num_joints = len(self.limit_rad)
        if len(due.row_A) != num_joints + 1 or len(due.state) < num_joints:
            raise ValueError(
                f"expected a row of {num_joints + 1} and at least {num_joints} joint positions, came "
                f"{len(due.row_A)} and {len(due.state)}"
            )
        joints = due.state[:num_joints]
        clock = (due.row / _TICKS_PER_UNIT, due.age_ns / NS_PER_S, 1.0)
        features = np.concatenate([joints, (due.row_A[:-1] - joints) / self.limit_rad, [due.row_A[-1]], clock])
        hidden_U = np.tanh(features.astype(np.float32) @ self.inner)
        return np.append(hidden_U, 1.0).astype(np.float32)

    def save(self, path: Path) -> None:
        np.savez(path, **{name: getattr(self, name) for name in _ARRAYS})


def load(path: Path) -> ResidualMlp:
    """Reads a file of `ResidualMlp.save`.

    Raises:
        ValueError: the file is no such head.
        OSError: it cannot be read.
    """
    kind = f"residual head (.npz with {', '.join(_ARRAYS)})"
    arrays = files.read_npz(path, kind, most_bytes=MAX_FILE_BYTES)
    with files.reading(path, kind):
        return ResidualMlp(**{name: arrays[name].astype(np.float32) for name in _ARRAYS})


def _num_features(num_joints: int) -> int:
    """Number of features: joints, distance to the row, gripper, row index, age and 1."""
    return 2 * num_joints + 1 + 3
