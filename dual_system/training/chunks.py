"""The commands of an episode that a chunk's rows imitate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dual_system.training.episode import TrainingEpisode


def target_rows(episode: TrainingEpisode, tick: int, horizon: int) -> NDArray[np.float32]:
    """Commands (horizon, A) from ``tick`` on; after the end the last one repeats, as on the robot."""
    return episode.action_TA[chunk_ticks(np.array([tick]), horizon, episode.num_ticks)[0]]


def chunk_ticks(first_M: NDArray[np.integer], horizon: int, num_ticks: int) -> NDArray[np.intp]:
    """Ticks of the commands of chunks that start at ``first_M``, (M, horizon), for `normalise_chunks`."""
    return np.minimum(first_M[:, None] + np.arange(horizon), num_ticks - 1)
