"""The pipelines around the policy: nothing is normalised, because the gateway speaks the robot's units."""

from __future__ import annotations

from typing import Any

from lerobot.processor import AddBatchDimensionProcessorStep, DeviceProcessorStep, RenameObservationsProcessorStep
from lerobot.processor.factory import make_policy_processor_pipelines

from lerobot_policy_ponderpounce.configuration_ponderpounce import PonderpounceConfig


def make_ponderpounce_pre_post_processors(config: PonderpounceConfig, dataset_stats: Any = None) -> tuple[Any, Any]:
    """LeRobot's usual steps without the two that normalise."""
    return make_policy_processor_pipelines(
        input_steps=[
            RenameObservationsProcessorStep(rename_map={}),
            AddBatchDimensionProcessorStep(),
            DeviceProcessorStep(device=config.device or "cpu"),
        ],
        output_steps=[DeviceProcessorStep(device="cpu")],
    )
