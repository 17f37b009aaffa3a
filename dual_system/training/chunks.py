"""The commands of an episode that a chunk's rows imitate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def chunk_ticks(first_M: NDArray[np.integer], horizon: int, num_ticks: int) -> NDArray[np.intp]:
    """Ticks of the commands of chunks that start at ``first_M``, (M, horizon), for `normalise_chunks`.

    After the episode's end its last command stays in force, as on the robot.
    """
    return np.minimum(first_M[:, None] + np.arange(horizon), num_ticks - 1)
