"""The rows that are being played, as a pull on the chunk that follows them (`rtc`)."""

from collections.abc import Sequence

import torch

from ponderpounce.models import rtc
from ponderpounce.models.normalisation import RobotStatistics
from ponderpounce.models.pounce import PounceConfig
from pounce_server.contract import Request


def guide(
    requests: Sequence[Request], config: PounceConfig, statistics: RobotStatistics, device: torch.device
) -> rtc.Guide | None:
    """Returns where the previous rows pull each request's chunk; None if nobody has any that the chunk reaches."""
    shape = (len(requests), config.horizon, config.padded_action_dim)
    target_BNA, weight_BNA = torch.zeros(shape), torch.zeros(shape)
    dims = config.robot_action_dim
    for index, request in enumerate(requests):
        first = request.previous_row0
        if request.previous_rows is None or first >= config.horizon:
            continue
        rows_n8 = statistics.normalise_targets(request.previous_rows, request.proprio)[: config.horizon - first]
        mask = rtc.soft_mask(config.horizon - first, len(rows_n8), min(request.committed_rows, len(rows_n8)))
        target_BNA[index, first : first + len(rows_n8), :dims] = torch.from_numpy(rows_n8)
        weight_BNA[index, first:, :dims] = mask[:, None]
    if not weight_BNA.any():
        return None
    return rtc.Guide(target=target_BNA.to(device), weight=weight_BNA.to(device))
