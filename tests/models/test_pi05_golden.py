"""Our pi0.5 against numbers from the public implementations: every tensor the goldens hold, float32, 1e-4."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pytest
import torch
from torch import Tensor

from dual_system.models import flow
from dual_system.models.golden import read_golden
from dual_system.models.interface import CognitionConfig
from dual_system.models.pi05.network import Prefix
from dual_system.models.pi05.pounce import Pounce, PounceInputs
from dual_system.models.pounce.initialise import random_pounce

TOLERANCE = 1e-4
COMMITTED = Path(__file__).parent / "data" / "goldens"
SHARED = Path(__file__).parents[3] / "shared" / "goldens"


@dataclass(frozen=True, slots=True, kw_only=True)
class Golden:
    model: Pounce
    inputs: PounceInputs
    given: dict[str, Tensor]
    expected: dict[str, Tensor]

    def prefix(self) -> Prefix:
        inputs = self.inputs
        return self.model.pi05.embed_prefix(inputs.images, inputs.has_view, inputs.token_ids, inputs.is_token)


@pytest.fixture(scope="module", params=["pi05_base", "pi05_three_views"])
def golden(request: pytest.FixtureRequest) -> Golden:
    folder = next((root / request.param for root in (COMMITTED, SHARED) if (root / request.param).is_dir()), None)
    if folder is None:
        pytest.skip(f"golden {request.param} is neither committed nor in ../shared/goldens beside the checkout")
    golden = read_golden(folder)
    assert isinstance(golden.model, Pounce)
    given = golden.given
    inputs = PounceInputs(
        images=given["images"],
        has_view=given["image_masks"],
        token_ids=given["token_ids"],
        is_token=given["token_mask"],
        age_ns=torch.zeros(len(given["time"]), dtype=torch.int64),
    )
    return Golden(model=golden.model, inputs=inputs, given=given, expected=golden.expected)


def _assert_close(ours: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(ours, expected, atol=TOLERANCE, rtol=0.0)


def test_prefix_embeddings_and_padding(golden: Golden) -> None:
    prefix = golden.prefix()
    _assert_close(prefix.embeds, golden.expected["prefix_embeds"])
    assert torch.equal(prefix.is_real, golden.expected["prefix_pad_mask"])


def test_prefix_hidden_states_where_real(golden: Golden) -> None:
    is_real = golden.expected["prefix_pad_mask"]
    hidden = golden.model.pi05.prefix_hidden(golden.prefix())
    _assert_close(hidden[is_real], golden.expected["prefix_hidden"][is_real])


def test_time_condition(golden: Golden) -> None:
    _assert_close(golden.model.pi05.time_condition(golden.given["time"]), golden.expected["time_cond"])


def test_velocity(golden: Golden) -> None:
    given = golden.given
    x_t = flow.noised(given["actions"], given["noise"], given["time"])
    velocity = golden.model.pi05.velocity_at(x_t, given["time"], golden.model.prefill(golden.inputs))
    _assert_close(velocity, golden.expected["velocity"])


def test_loss_unreduced_and_both_means(golden: Golden) -> None:
    given, expected = golden.given, golden.expected
    batch = golden.inputs, given["actions"], given["noise"], given["time"]
    _assert_close(golden.model.unreduced_loss(*batch), expected["loss_unreduced"])
    _assert_close(golden.model.loss(*batch, over="all"), expected["loss_mean_all"][0])
    _assert_close(golden.model.loss(*batch), expected["loss_mean_real"][0])


def test_sampler_step_by_step(golden: Golden) -> None:
    noise = golden.given["noise"]
    steps = list(golden.model.sample(golden.inputs, noise, golden.model.step_table()))
    velocities = torch.stack([step.velocity for step in steps], dim=1)
    trajectory = torch.stack([noise, *(step.actions for step in steps)], dim=1)
    _assert_close(velocities, golden.expected["sample_velocities"])
    _assert_close(trajectory, golden.expected["sample_trajectory"])
    _assert_close(steps[-1].actions, golden.expected["actions"])


def _with_cognition(golden: Golden, attention: Literal["full", "isolated"]) -> tuple[Pounce, PounceInputs]:
    """The golden's weights behind a fresh, loud cognition prefix of K = 3."""
    cognition = CognitionConfig(num_carriers=3, cognition_size=16, attention=attention)
    model = random_pounce(replace(golden.model.config, cognition=cognition), seed=0)
    model.load_state_dict(golden.model.state_dict(), strict=False)
    batch_size = len(golden.inputs.age_ns)
    carriers = torch.randn(batch_size, 3, 16, generator=torch.Generator().manual_seed(1))
    return model.requires_grad_(False), replace(golden.inputs, cognition=carriers)


def test_isolated_prefix_hidden_from_the_actions_is_the_public_model(golden: Golden) -> None:
    """Images and text are untouched by P, and P's shift of all positions cancels in RoPE."""
    model, inputs = _with_cognition(golden, "isolated")
    cache = model.prefill(inputs)
    visible = cache.visible.clone()
    visible[:, : model.config.cognition.num_tokens] = False
    given = golden.given
    x_t = flow.noised(given["actions"], given["noise"], given["time"])
    velocity = model.pi05.velocity_at(x_t, given["time"], replace(cache, visible=visible))
    _assert_close(velocity, golden.expected["velocity"])


@pytest.mark.parametrize("attention", ["full", "isolated"])
def test_visible_prefix_is_not_the_public_model(golden: Golden, attention: Literal["full", "isolated"]) -> None:
    model, inputs = _with_cognition(golden, attention)
    given = golden.given
    x_t = flow.noised(given["actions"], given["noise"], given["time"])
    velocity = model.pi05.velocity_at(x_t, given["time"], model.prefill(inputs))
    assert (velocity - golden.expected["velocity"]).abs().max() > 10 * TOLERANCE


def test_every_expected_tensor_is_compared(golden: Golden) -> None:
    assert set(golden.expected) == {
        "prefix_embeds",
        "prefix_pad_mask",
        "prefix_hidden",
        "time_cond",
        "velocity",
        "loss_unreduced",
        "loss_mean_all",
        "loss_mean_real",
        "sample_velocities",
        "sample_trajectory",
        "actions",
    }
