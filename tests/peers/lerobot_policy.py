"""LeRobot's side of test_lerobot_policy.py, under LeRobot's own Python: its evaluation loop with our plug-in.

    lerobot_policy.py URL FOLDER

Prints JSON: what it played.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from typing import Any, ClassVar

import gymnasium
import numpy as np
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.import_utils import register_third_party_plugins

PX, STEPS = 256, 5
HOME = np.array([0, 0, 0, -1.5, 0, 1.8, 0, 0.04], np.float32)


@EnvConfig.register_subclass("table")
@dataclass
class TableConfig(EnvConfig):
    fps: int = 20
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "front": PolicyFeature(type=FeatureType.VISUAL, shape=(PX, PX, 3)),
            "wrist": PolicyFeature(type=FeatureType.VISUAL, shape=(PX, PX, 3)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(8,)),
            "action": PolicyFeature(type=FeatureType.ACTION, shape=(8,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            "front": "observation.images.front",
            "wrist": "observation.images.wrist",
            "agent_pos": "observation.state",
            "action": "action",
        }
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}


class Table(gymnasium.Env):
    """A table without physics that goes where it is told."""

    metadata: ClassVar = {"render_fps": 20}
    _max_episode_steps = STEPS
    task_description = task = "pick the cube"

    def __init__(self) -> None:
        picture = gymnasium.spaces.Box(0, 255, (PX, PX, 3), np.uint8)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "pixels": gymnasium.spaces.Dict({"front": picture, "wrist": picture}),
                "agent_pos": gymnasium.spaces.Box(-10, 10, (8,), np.float32),
            }
        )
        self.action_space = gymnasium.spaces.Box(-10, 10, (8,), np.float32)
        self.played = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.played = 0
        return self._seen(), {"is_success": False}

    def step(self, action: Any) -> Any:
        self.played += 1
        return self._seen(), 0.0, False, self.played >= STEPS, {"is_success": False}

    def _seen(self) -> Any:
        picture = np.full((PX, PX, 3), self.played, np.uint8)
        return {"pixels": {"front": picture, "wrist": picture}, "agent_pos": HOME}


def main() -> int:
    url, folder = sys.argv[1:]
    register_third_party_plugins()
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.url = folder, url
    policy = make_policy(config, env_cfg=TableConfig())
    overrides = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": {}}}
    before, after = make_pre_post_processors(
        policy_cfg=config, pretrained_path=folder, preprocessor_overrides=overrides
    )
    nothing = PolicyProcessorPipeline(steps=[])
    env = gymnasium.vector.SyncVectorEnv([Table])
    played = [rollout(env, policy, nothing, nothing, before, after, seeds=[seed])["action"] for seed in (0, 1)]
    batch = [each.numpy().tolist() for each in played]
    sys.stdout.write(json.dumps({"type": config.type, "class": type(policy).__name__, "actions": batch}) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
