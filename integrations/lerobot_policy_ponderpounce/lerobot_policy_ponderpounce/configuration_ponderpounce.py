"""What a policy that asks pp-gateway has to know: where it listens, and what it calls pictures and state."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs.policies import PreTrainedConfig


@PreTrainedConfig.register_subclass("ponderpounce")
@dataclass
class PonderpounceConfig(PreTrainedConfig):
    """``--policy.type=ponderpounce --policy.url=ws://127.0.0.1:8000``.

    ``keys``: LeRobot's names of the observation with the gateway's (pp-gateway's --cameras and --state-key).
    ``task``: the instruction, for environments that tell none.
    """

    url: str = "ws://127.0.0.1:8000"
    keys: dict[str, str] = field(
        default_factory=lambda: {
            "observation.images.front": "observation/image",
            "observation.images.wrist": "observation/wrist_image",
            "observation.state": "observation/state",
        }
    )
    task: str = ""
    answer_s: float = 120.0
    device: str | None = "cpu"

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> Any:
        raise NotImplementedError("this policy has no weights: train PonderPounce with pp-train")

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        """Raises ValueError if the environment or the robot lacks something that the gateway is to be sent."""
        if missing := self.keys.keys() - (self.input_features or {}).keys():
            came = ", ".join(sorted(self.input_features or {})) or "nothing"
            raise ValueError(f"--policy.keys names {', '.join(sorted(missing))}, which is not among {came}")
