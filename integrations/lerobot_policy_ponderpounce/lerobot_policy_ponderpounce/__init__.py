"""A LeRobot policy that asks pp-gateway. LeRobot imports this package alone, and it registers the configuration."""

from lerobot_policy_ponderpounce.configuration_ponderpounce import PonderpounceConfig

__all__ = ["PonderpounceConfig"]
