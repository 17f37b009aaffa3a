"""A policy's numbers against a robot's dimensions: which it takes as they are, and which do not fit."""

from __future__ import annotations

from protocol.errors import EpisodeRefused
from protocol.messages import Dimension, DimensionKind, Refusal, Robot
from protocol.peers.mapping import Kind, Numbers, PolicyMapping

_FITS: dict[DimensionKind, tuple[Kind, ...]] = {
    DimensionKind.POSITION: ("position", "velocity", "delta", "offset"),
    DimensionKind.VELOCITY: ("velocity",),
    DimensionKind.DELTA: ("delta",),
    DimensionKind.GRIPPER: ("gripper", "position"),
}
_AS_THEY_ARE = (DimensionKind.VELOCITY, DimensionKind.DELTA)


def fitting_dims(mapping: PolicyMapping, robot: Robot) -> frozenset[int]:
    """The commands that are velocities or deltas for this robot too; none if it does not describe its dimensions.

    Raises:
        EpisodeRefused: a number of the policy is no command of this robot, or starts from another measured number.
    """
    if not robot.dimensions:
        return frozenset()
    if len(robot.dimensions) != mapping.num_commands:
        raise EpisodeRefused(
            Refusal.ROBOT, f"{mapping.name} maps {mapping.num_commands} commands, {robot.name} has {robot.action_dim}"
        )
    for each in mapping.actions:
        for position, dim in enumerate(each.dims):
            _check(mapping, robot, each, position, robot.dimensions[dim])
    return frozenset(dim for dim, each in enumerate(robot.dimensions) if each.kind in _AS_THEY_ARE)


def _check(mapping: PolicyMapping, robot: Robot, each: Numbers, position: int, dimension: Dimension) -> None:
    """Raises EpisodeRefused, see `fitting_dims`."""
    fits = _FITS.get(dimension.kind, ())
    if each.kind not in fits:
        raise EpisodeRefused(
            Refusal.ROBOT,
            f"{mapping.name}: the policy's {each.kind} cannot be {robot.name}'s {dimension.name}, a "
            f"{dimension.kind.name.lower()}; expected {' or '.join(fits) or 'nothing'}",
        )
    if dimension.kind == DimensionKind.DELTA and mapping.play_hz != mapping.rate_hz:
        raise EpisodeRefused(
            Refusal.ROBOT, f"{mapping.name}: deltas of {dimension.name} are not resampled; mend play_hz"
        )
    if dimension.kind in _AS_THEY_ARE or not each.measured:
        return
    if each.measured[position] != dimension.state_index:
        raise EpisodeRefused(
            Refusal.ROBOT,
            f"{mapping.name}: {dimension.name} starts from measured number {each.measured[position]}, {robot.name} "
            f"measures it in {dimension.state_index}; say so in `measured`",
        )
