"""Whether a robot's cameras are those of a checkpoint's training: pictures of others, or in another order, mislead."""

from __future__ import annotations

from protocol.errors import EpisodeRefused
from protocol.messages import Refusal, Robot


def check_names(server: str, trained: tuple[str, ...], robot: Robot) -> None:
    """Raises EpisodeRefused unless the robot has these cameras in this order; () if the checkpoint names none."""
    if trained and robot.cameras != trained:
        raise EpisodeRefused(
            Refusal.CAMERAS,
            f"{server} was trained on the cameras {', '.join(trained)}, in this order; {robot.name} has "
            f"{', '.join(robot.cameras)}. If they are the same, name and order them so in the robot's file.",
        )
