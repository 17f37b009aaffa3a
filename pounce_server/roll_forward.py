"""State roll-forward: a chunk is planned from where the robot will be when it takes over (VLASH, 2512.01031).

The committed rows will be played in any case, so the state after them is known but for the arm's lag: the last one's
joint targets. The network is told that state, its first row is the first that is not committed, and the chunk that
leaves is laid out as always: row 0 at the observation's tick, committed rows where they belong. Pictures stay those of
the observation, which no ordinary training shows beside a later state; a network wants to be trained on such pairs.
"""

# N horizon

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dual_system.models.arm import NUM_ARM_JOINTS
from pounce_server.contract import Request


def ticks_ahead(request: Request, horizon: int) -> int:
    """How many rows of the chunk are settled before it is made: past ticks and committed rows. At least one is left."""
    if request.previous_rows is None or request.committed_rows == 0:
        return 0
    return min(request.previous_row0 + request.committed_rows, horizon - 1)


def rolled(request: Request, horizon: int) -> Request:
    """The request as of the tick at which its chunk takes over. The finger's opening (m) stays as measured."""
    ahead = ticks_ahead(request, horizon)
    if ahead <= request.previous_row0 or request.previous_rows is None:
        return request
    num_played = ahead - request.previous_row0
    proprio = request.proprio.copy()
    proprio[:NUM_ARM_JOINTS] = request.previous_rows[num_played - 1, :NUM_ARM_JOINTS]
    left = request.previous_rows[num_played:]
    return replace(
        request, proprio=proprio, previous_rows=left if len(left) else None, previous_row0=0, committed_rows=0
    )


def placed(rows_N8: NDArray[np.float32], request: Request) -> NDArray[np.float32]:
    """The chunk of ``request``, from the rows that were planned from its `rolled` state: the last few fall off its end.

    Rows of past ticks, which nobody plays, repeat the first that is left.
    """
    horizon = len(rows_N8)
    ahead = ticks_ahead(request, horizon)
    if ahead <= request.previous_row0 or request.previous_rows is None:
        return rows_N8
    places = np.maximum(np.arange(ahead) - request.previous_row0, 0)
    return np.concatenate([request.previous_rows[places], rows_N8[: horizon - ahead]])
