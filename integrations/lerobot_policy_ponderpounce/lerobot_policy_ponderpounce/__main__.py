"""``python -m lerobot_policy_ponderpounce FOLDER``: what ``lerobot-rollout --policy.path FOLDER`` wants."""

from __future__ import annotations

import argparse
import sys

from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_policy_ponderpounce.configuration_ponderpounce import PonderpounceConfig
from lerobot_policy_ponderpounce.processor_ponderpounce import make_ponderpounce_pre_post_processors


def main() -> int:
    parser = argparse.ArgumentParser(prog="lerobot_policy_ponderpounce", description=__doc__)
    parser.add_argument("folder", help="is written: config.json and the two pipelines, no weights")
    parser.add_argument("--url", default="ws://127.0.0.1:8000", help="of pp-gateway --dialect openpi")
    parser.add_argument("--cameras", nargs="+", default=["front", "wrist"], help="names of the robot's cameras")
    parser.add_argument("--picture", nargs=2, type=int, default=[256, 256], help="height and width in pixels")
    parser.add_argument("--state", type=int, default=8, help="numbers that are measured")
    parser.add_argument("--action", type=int, default=8, help="numbers that are commanded")
    asked = parser.parse_args()
    height, width = asked.picture
    usual = {"front": "observation/image", "wrist": "observation/wrist_image"}
    keys = {f"observation.images.{name}": usual.get(name, f"observation/{name}") for name in asked.cameras}
    inputs = {key: PolicyFeature(type=FeatureType.VISUAL, shape=(3, height, width)) for key in keys}
    config = PonderpounceConfig(
        url=asked.url,
        keys=keys | {"observation.state": "observation/state"},
        input_features=inputs | {"observation.state": PolicyFeature(type=FeatureType.STATE, shape=(asked.state,))},
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(asked.action,))},
    )
    config.save_pretrained(asked.folder)
    before, after = make_ponderpounce_pre_post_processors(config)
    before.save_pretrained(asked.folder)
    after.save_pretrained(asked.folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
