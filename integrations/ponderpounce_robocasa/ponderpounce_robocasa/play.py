"""One episode: a restored scene, its demonstration, and chunks that are played in full."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ponderpounce_robocasa import layout
from ponderpounce_robocasa.scenes import Scene, restore

_PLAYED = ("PLAY", "STALE")


class Server(Protocol):
    """What is asked for rows: `wire.Policy`, or a fake."""

    metadata: Mapping[str, Any]

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]: ...
    def reset(self) -> None: ...


@dataclass(frozen=True)
class Outcome:
    """How an episode went. ``num_held``: rows that came from no policy, because the ladder held the robot."""

    is_success: bool
    num_steps: int
    num_held: int


def play(
    env: Any,
    server: Server,
    scene: Scene,
    demo: Sequence[np.ndarray] = (),
    demo_hz: int = 1,
    max_steps: int = layout.MAX_STEPS,
) -> Outcome:
    """Plays until the task's own predicate is true, or for ``max_steps``.

    Raises:
        Unfit: the environment or the server has other numbers.
        SceneError, Refused: the scene cannot be restored, or the server does not answer.
    """
    observation = restore(env, scene)
    layout.check_action(env)
    server.reset()
    keys = server.metadata["cameras"]
    request: dict[str, Any] = {"demonstration": list(demo), "demonstration_hz": demo_hz} if len(demo) else {}
    num_steps = num_held = 0
    while num_steps < max_steps:
        request[server.metadata["state"]] = layout.state_of(observation)
        request |= {keys[name]: picture for name, picture in layout.pictures_of(observation).items()}
        answer = server.infer({**request, "prompt": scene.instruction})
        rows = np.asarray(answer["actions"], np.float64)
        if rows.shape != (layout.NUM_ROWS, len(layout.ACTION_NAMES)):
            expected = (layout.NUM_ROWS, len(layout.ACTION_NAMES))
            raise layout.Unfit(f"expected rows {expected}, came {rows.shape}")
        request = {}  # the demonstration is shown once
        for row, level in zip(rows, answer["levels"], strict=True):
            observation = env.step(row)[0]
            num_steps, num_held = num_steps + 1, num_held + (level not in _PLAYED)
            if env._check_success():
                return Outcome(True, num_steps, num_held)
            if num_steps == max_steps:
                break
    return Outcome(False, num_steps, num_held)
