"""The named sizes are the published ones, to the last parameter."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from dual_system.models.ponder.configs import (
    PonderConfig,
    qwen35_0p8b,
    qwen35_2b,
    qwen35_4b,
    qwen35_9b,
    tiny_cpu,
)
from dual_system.models.ponder.network import skeleton


@pytest.mark.parametrize(
    ("config", "num_parameters"),
    [
        (qwen35_0p8b, 852_985_920),
        (qwen35_2b, 2_213_241_664),
        (qwen35_4b, 4_539_265_536),
        (qwen35_9b, 9_409_813_744),
    ],
)
def test_parameter_count_is_exact(config: Callable[[], PonderConfig], num_parameters: int) -> None:
    assert sum(p.numel() for p in skeleton(config().qwen()).parameters()) == num_parameters


def test_the_tiny_size_has_every_kind_of_layer() -> None:
    qwen = tiny_cpu().qwen()
    assert set(qwen.text_config.layer_types) == {"linear_attention", "full_attention"}
    assert qwen.text_config.linear_num_value_heads > qwen.text_config.linear_num_key_heads
    assert qwen.vision_config.depth > 0


def test_carriers_must_fit_the_table() -> None:
    with pytest.raises(ValueError, match="do not fit into vocab_size 512"):
        replace(tiny_cpu(), first_carrier_id=511, num_carriers=2)


def test_mrope_section_must_fill_the_rotary_half() -> None:
    with pytest.raises(ValueError, match="head_dim"):
        replace(tiny_cpu(), head_dim=64)
