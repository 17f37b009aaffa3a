"""How old the pictures are on which a robot moves, and whether it may.

A camera's picture has the instant at which it was captured. One that is too old, cameras that are too far apart, and a
camera that shows the same bytes for too long are no ground to play new rows on, whatever else comes in time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from clock.limits import Hit
from protocol.messages import Observation, Robot

NEVER = -1
"""The age of a picture that has not come."""


@dataclass(slots=True)
class _Camera:
    captured_ns: int
    changed_ns: int
    data: bytes | memoryview


@dataclass(slots=True)
class Sight:
    """The newest picture of each camera. Instants are episode time."""

    robot: Robot
    _cameras: dict[str, _Camera] = field(default_factory=dict)

    def on_observation(self, observation: Observation) -> None:
        instants = observation.captured_ns or (observation.source_ns,) * len(observation.images)
        is_watched = self.robot.max_picture_still_ns > 0
        for image, captured_ns in zip(observation.images, instants, strict=True):
            data = image.data if is_watched else b""
            before = self._cameras.get(image.camera)
            is_still = before is not None and is_watched and before.data == data
            changed_ns = before.changed_ns if before is not None and is_still else captured_ns
            self._cameras[image.camera] = _Camera(captured_ns, changed_ns, data)

    def age_ns(self, now_ns: int) -> tuple[int, ...]:
        """Age of each camera's picture, in the robot's order; () before any picture."""
        return self._since(now_ns, is_change=False) if self._cameras else ()

    def still_ns(self, now_ns: int) -> tuple[int, ...]:
        """Time since each camera's picture changed; () if that is not watched."""
        is_watched = self._cameras and self.robot.max_picture_still_ns
        return self._since(now_ns, is_change=True) if is_watched else ()

    def _since(self, now_ns: int, *, is_change: bool) -> tuple[int, ...]:
        found = (self._cameras.get(name) for name in self.robot.cameras)
        instants = (None if each is None else each.changed_ns if is_change else each.captured_ns for each in found)
        return tuple(NEVER if at_ns is None else max(0, now_ns - at_ns) for at_ns in instants)


def unfit(robot: Robot, age_ns: tuple[int, ...], still_ns: tuple[int, ...]) -> Hit:
    """Why these pictures are no ground to move on; NONE if they are."""
    hit = Hit.NONE
    if not robot.cameras:
        return hit
    if robot.max_picture_age_ns and (not age_ns or NEVER in age_ns or max(age_ns) > robot.max_picture_age_ns):
        hit |= Hit.PICTURE_OLD
    seen_ns = [each for each in age_ns if each != NEVER]
    if robot.max_picture_skew_ns and seen_ns and max(seen_ns) - min(seen_ns) > robot.max_picture_skew_ns:
        hit |= Hit.PICTURES_APART
    if robot.max_picture_still_ns and max(still_ns, default=0) > robot.max_picture_still_ns:
        hit |= Hit.PICTURE_STILL
    return hit


def unfit_text(robot: Robot, hit: Hit, age_ns: tuple[int, ...], still_ns: tuple[int, ...]) -> str:
    """A sentence about pictures that are ``unfit``, with the cameras, their ages and the limit."""

    def listed(values_ns: tuple[int, ...]) -> str:
        pairs = zip(robot.cameras, values_ns, strict=False)
        return ", ".join(f"{name} {'never' if ns == NEVER else f'{ns / 1e6:.0f} ms'}" for name, ns in pairs)

    if Hit.PICTURE_OLD in hit:
        return f"pictures are too old: {listed(age_ns) or 'none came'}; allowed {robot.max_picture_age_ns / 1e6:.0f} ms"
    if Hit.PICTURE_STILL in hit:
        return (
            f"a camera shows the same picture again and again: {listed(still_ns)} without a change; allowed "
            f"{robot.max_picture_still_ns / 1e6:.0f} ms"
        )
    return f"cameras are too far apart: {listed(age_ns)}; allowed {robot.max_picture_skew_ns / 1e6:.0f} ms apart"
