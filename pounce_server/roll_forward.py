"""State roll-forward: a chunk is planned from the robot's state when it takes over (VLASH, 2512.01031).

The committed rows will be played in any case, so the state after them is known up to the arm's lag: the last one's
joint targets. The network is conditioned on that state, and its first row is the first uncommitted one. The published
chunk has the usual layout: row 0 at the observation's tick, committed rows in their places. The pictures are still the
observation's. Ordinary training never pairs them with a later state, so a network should be trained on such pairs.
"""

# N horizon

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dual_system.models.arm import NUM_ARM_JOINTS
from pounce_server.contract import Request


def ticks_ahead(request: Request, horizon: int) -> int:
    """Number of the chunk's rows that are fixed beforehand: past ticks and committed rows; at most horizon - 1."""
    if request.previous_rows is None or request.committed_rows == 0:
        return 0
    return min(request.previous_row0 + request.committed_rows, horizon - 1)


def rolled(request: Request, horizon: int) -> Request:
    """The request rolled forward to the tick at which its chunk takes over. The finger opening stays as measured."""
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
    """The chunk of ``request``, from rows planned from its `rolled` state; the last few fall off its end.

    Rows of past ticks are never played; they repeat the first previous row.
    """
    horizon = len(rows_N8)
    ahead = ticks_ahead(request, horizon)
    if ahead <= request.previous_row0 or request.previous_rows is None:
        return rows_N8
    places = np.maximum(np.arange(ahead) - request.previous_row0, 0)
    return np.concatenate([request.previous_rows[places], rows_N8[: horizon - ahead]])
