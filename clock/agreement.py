"""Whether an episode's parts fit, before anything moves: robot, schedule, and the contracts of the models."""

from __future__ import annotations

from collections.abc import Sequence

from clock.channels import misfit
from clock.feasibility import check_feasible
from clock.residual import ResidualHead, check_head
from protocol import messages as m
from protocol.errors import EpisodeRefused


def agree(
    info: m.EpisodeInfo, contracts: Sequence[m.Contract], *, residual: ResidualHead | None, allow_starved: bool
) -> tuple[list[str], int]:
    """Checks that the parts fit; returns warnings and the ticks that an invocation takes.

    Raises:
        EpisodeRefused: the parts do not fit, the schedule is infeasible, or untrained weights would move a robot.
    """
    *ponder, pounce = contracts
    if ponder and (why_not := misfit(ponder[0], pounce)):
        raise EpisodeRefused(m.Refusal.MODELS, why_not)
    if (pounce.horizon, pounce.action_dim) != (info.schedule.horizon, info.robot.action_dim):
        raise EpisodeRefused(
            m.Refusal.ROBOT,
            f"POUNCE gives chunks of ({pounce.horizon}, {pounce.action_dim}), the episode was opened for "
            f"({info.schedule.horizon}, {info.robot.action_dim}). Load another checkpoint.",
        )
    rate_hz = info.schedule.control_hz
    if pounce.control_hz not in (0, rate_hz):
        raise EpisodeRefused(
            m.Refusal.SCHEDULE,
            f"POUNCE's rows are for {pounce.control_hz} Hz, {info.robot.name} takes {rate_hz} commands a second. "
            "Rows are not resampled: load a checkpoint of the robot's rate, or say the other control_hz in the "
            "robot's file if the robot can keep it.",
        )
    if residual is not None:
        try:
            check_head(residual, info.robot)
        except ValueError as error:
            raise EpisodeRefused(m.Refusal.ROBOT, str(error)) from error
    fake = [c.proc for c in contracts if c.is_fake]
    if fake and not info.robot.is_simulated:
        raise EpisodeRefused(
            m.Refusal.MODELS, f"{' and '.join(fake)} run untrained weights, which never move a real robot."
        )
    warnings = [f"{proc} runs untrained weights: expect motion, not skill" for proc in fake]
    if not pounce.control_hz and not info.robot.is_simulated:
        warnings.append(f"POUNCE does not say for which rate its rows are: they are played at {rate_hz} Hz")
    feasibility = check_feasible(info.schedule, pounce.infer_p99_ns)
    if not feasibility.is_feasible:
        if info.schedule.mode == m.Mode.REALTIME and not allow_starved:
            raise EpisodeRefused(m.Refusal.SCHEDULE, f"the schedule cannot be kept: {feasibility.sentence()}")
        warnings.append(feasibility.sentence())
    return warnings, feasibility.delay_ticks
