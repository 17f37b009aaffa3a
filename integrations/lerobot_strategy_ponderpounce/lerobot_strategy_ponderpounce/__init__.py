"""Any LeRobot robot under PonderPounce's clock: a program of its own, and a strategy where LeRobot takes one.

LeRobot imports this package alone, and finds the strategy by its configuration's name.
"""

from lerobot_strategy_ponderpounce.arm import Arm
from lerobot_strategy_ponderpounce.strategy import HAS_REGISTRY, PonderpounceStrategy, PonderpounceStrategyConfig

__all__ = ["HAS_REGISTRY", "Arm", "PonderpounceStrategy", "PonderpounceStrategyConfig"]
