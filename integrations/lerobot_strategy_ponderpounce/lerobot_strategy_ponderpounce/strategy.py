"""``lerobot-rollout --strategy.type=ponderpounce``: the robot's own program in the place of LeRobot's loop.

LeRobot 0.6.1 creates its own strategies only; ``HAS_REGISTRY`` says whether this one takes others.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from lerobot.rollout.configs import RolloutStrategyConfig
from lerobot.rollout.strategies.core import RolloutStrategy
from ponderpounce_client import Client, Observation, Settings, Watchdog, drive, leave_holding

from lerobot_strategy_ponderpounce.arm import Arm

HAS_REGISTRY = hasattr(RolloutStrategyConfig, "extra_dataset_features")


@dataclass
class PonderpounceStrategyConfig(RolloutStrategyConfig):
    """As the options of ``python -m lerobot_strategy_ponderpounce``; ``yes``: nobody is asked before the first row."""

    dataset_mode: ClassVar[str] = "none"

    url: str = "ws://127.0.0.1:8000"
    api_key_file: str = ""
    speed: float = 1.0
    dry_run: bool = False
    yes: bool = False
    at_exit: str = "hold"
    holds_position: bool = False


class PonderpounceStrategy(RolloutStrategy):
    """One episode under the gateway's clock. LeRobot's engine is never started; its robot is held, not driven home."""

    _watchdog: Watchdog | None = None

    def setup(self, ctx: Any) -> None:
        """Raises Lost, Refused, ValueError, OSError; nothing moves."""
        asked, robot = self.config, ctx.hardware.robot_wrapper.inner
        key = Path(asked.api_key_file).read_text(encoding="utf-8").strip() if asked.api_key_file else ""
        self._client = Client(asked.url, key)
        options = {"holds_position": asked.holds_position, "say": _say, "until": ctx.runtime.shutdown_event}
        self._arm = _Stoppable(robot, self._client.welcome, {}, **options)
        self._watchdog = Watchdog(leave_holding)

    def run(self, ctx: Any) -> None:
        """Raises RuntimeError with the sentence in which the episode ended unasked."""
        asked, cfg = self.config, ctx.runtime.cfg
        settings = Settings(
            instruction=cfg.task, speed=asked.speed, is_dry=asked.dry_run, is_confirmed=asked.yes,
            at_exit=asked.at_exit, max_s=cfg.duration or None,
        )  # fmt: skip
        if why := drive(self._arm, self._client, settings, self._watchdog, say=_say):
            raise RuntimeError(why)

    def teardown(self, ctx: Any) -> None:
        """Also after a ``setup`` that failed."""
        for each in (getattr(self, "_arm", None), getattr(self, "_client", None), self._watchdog):
            if each is not None:
                each.close()
        self._teardown_hardware(ctx.hardware, return_to_initial_position=False)


class _Stoppable(Arm):
    """LeRobot ends a run by an event, as a person ends the program: once."""

    def __init__(self, *arguments: Any, until: Any, **options: Any) -> None:
        self._until = until
        super().__init__(*arguments, **options)

    def observe(self) -> Observation:
        if self._until is not None and self._until.is_set():
            self._until = None
            raise KeyboardInterrupt
        return super().observe()


def _say(sentence: str) -> None:
    sys.stdout.write(f"{sentence}\n")


if HAS_REGISTRY:
    RolloutStrategyConfig.register_subclass("ponderpounce")(PonderpounceStrategyConfig)
