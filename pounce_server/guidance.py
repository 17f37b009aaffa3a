"""The rows being played as inputs of the network: a guidance target (`rtc`) or committed rows (`committed`)."""

from collections.abc import Sequence

import numpy as np
import torch

from dual_system.models.normalisation import Floats, RobotStatistics
from dual_system.models.pi05 import rtc as rtc
from dual_system.models.pi05.committed import Committed, first_rows
from dual_system.models.pi05.pounce import PounceConfig
from pounce_server.contract import Request


def guide(
    requests: Sequence[Request], config: PounceConfig, statistics: RobotStatistics, device: torch.device
) -> rtc.Guide | None:
    """Returns the guidance towards each request's previous rows; None if no chunk overlaps any."""
    shape = (len(requests), config.horizon, config.padded_action_dim)
    target_BNA, weight_BNA = torch.zeros(shape), torch.zeros(shape)
    dims = config.robot_action_dim
    for index, request in enumerate(requests):
        first = request.previous_row0
        if request.previous_rows is None or first >= config.horizon:
            continue
        reached = request.previous_rows[: config.horizon - first]
        rows_n8 = statistics.normalise_targets(reached, request.proprio, first_row=first)
        mask = rtc.soft_mask(config.horizon - first, len(rows_n8), min(request.committed_rows, len(rows_n8)))
        target_BNA[index, first : first + len(rows_n8), :dims] = torch.from_numpy(rows_n8)
        weight_BNA[index, first:, :dims] = mask[:, None]
    if not weight_BNA.any():
        return None
    return rtc.Guide(target=target_BNA.to(device), weight=weight_BNA.to(device))


def given(
    requests: Sequence[Request], config: PounceConfig, statistics: RobotStatistics, device: torch.device
) -> Committed | None:
    """Returns the committed rows at the start of each request's chunk; None if no request has any.

    At most as many as in training are given, the first ones. A late observation's chunk begins at past ticks, whose
    commands the request does not contain: the first unplayed row stands in.
    """
    shape = (len(requests), config.horizon, config.padded_action_dim)
    rows_BNA, count_B = torch.zeros(shape), torch.zeros(len(requests), dtype=torch.int64)
    for index, request in enumerate(requests):
        count = num_given(request, config.max_committed_rows)
        if count == 0 or request.previous_rows is None:
            continue
        places = np.maximum(np.arange(count) - request.previous_row0, 0)
        rows_n8 = statistics.normalise_targets(request.previous_rows[places], request.proprio)
        rows_BNA[index, :count, : config.robot_action_dim] = torch.from_numpy(rows_n8)
        count_B[index] = count
    if not count_B.any():
        return None
    return Committed(rows=rows_BNA.to(device), is_given=first_rows(count_B, config.horizon).to(device))


def num_given(request: Request, max_rows: int) -> int:
    """Number of the chunk's rows that are fixed before it is generated: those of past ticks and the committed ones."""
    if request.previous_rows is None or request.committed_rows == 0:
        return 0
    return min(request.previous_row0 + request.committed_rows, max_rows)


def with_committed(rows_N8: Floats, request: Request, max_rows: int) -> Floats:
    """``rows_N8`` with exact committed rows: normalising and back has rounded them."""
    count = num_given(request, max_rows) - request.previous_row0
    if request.previous_rows is None or count <= 0:
        return rows_N8
    first = request.previous_row0
    return np.concatenate([rows_N8[:first], request.previous_rows[:count], rows_N8[first + count :]])
