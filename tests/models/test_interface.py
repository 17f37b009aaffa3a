"""Laws of the cognition prefix: order, null, age, scale, and the halved gradient."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models.interface import CognitionConfig, CognitionPrefix, scale_gradient
from dual_system.models.small_pair.place_code import NUM_PLACE_FEATURES, place_features

WIDTH = 32
SIZE = 24


def _prefix(num_carriers: int = 3, text_rms: float = 1.0, **settings_: float) -> CognitionPrefix:
    config = CognitionConfig(num_carriers=num_carriers, cognition_size=SIZE, **settings_)
    prefix = CognitionPrefix(config, WIDTH)
    prefix.initialise(text_rms, torch.Generator().manual_seed(0))
    return prefix


def _cognition(batch_size: int = 2, num_carriers: int = 3, seed: int = 0) -> Tensor:
    return torch.randn(batch_size, num_carriers, SIZE, generator=torch.Generator().manual_seed(seed))


AGES_NS = torch.tensor([300_000_000, 1_300_000_000])


@given(num_carriers=st.integers(1, 16))
@settings(max_examples=16, deadline=None)
def test_prefix_is_one_age_token_and_k_carriers(num_carriers: int) -> None:
    prefix = _prefix(num_carriers)
    tokens = prefix(_cognition(2, num_carriers), AGES_NS)
    assert tokens.shape == (2, 1 + num_carriers, WIDTH)
    assert prefix.config.num_tokens == 1 + num_carriers


def test_age_moves_only_the_first_token_and_carriers_only_their_own() -> None:
    prefix, cognition = _prefix(), _cognition()
    tokens = prefix(cognition, AGES_NS)
    older = prefix(cognition, AGES_NS + 1_000_000_000)
    assert not torch.allclose(older[:, 0], tokens[:, 0], atol=1e-3)
    assert torch.equal(older[:, 1:], tokens[:, 1:])
    order = [2, 0, 1]
    torch.testing.assert_close(prefix(cognition[:, order], AGES_NS)[:, 1:], tokens[:, 1:][:, order])


def test_fresh_null_cognition_is_zero_with_age_zero_whatever_the_clock_says() -> None:
    prefix = _prefix()
    assert (prefix.null_cognition == 0).all()
    null = prefix(None, AGES_NS)
    assert torch.equal(null, prefix(None, torch.zeros(2, dtype=torch.int64)))
    assert (null[:, 1:] == 0).all()


def test_null_samples_in_a_batch_are_the_learned_null() -> None:
    prefix = _prefix()
    torch.nn.init.constant_(prefix.null_cognition, 0.7)
    is_null = torch.tensor([False, True])
    mixed = prefix(_cognition(), AGES_NS, is_null)
    torch.testing.assert_close(mixed[1], prefix(None, AGES_NS)[1])
    torch.testing.assert_close(mixed[0], prefix(_cognition(), AGES_NS)[0])
    assert not torch.allclose(mixed[1, 1:], torch.zeros(3, WIDTH))


@pytest.mark.parametrize("text_rms", [0.5, 4.0])
def test_fresh_tokens_have_the_rms_of_text(text_rms: float) -> None:
    tokens = _prefix(text_rms=text_rms)(_cognition(400), torch.arange(400) * 50_000_000)
    for part in (tokens[:, 0], tokens[:, 1:]):
        assert part.square().mean().sqrt().item() == pytest.approx(text_rms, rel=0.15)


def test_projector_std_can_be_set() -> None:
    weight = _prefix(projector_std=1e-3).projector.weight
    assert weight.std().item() == pytest.approx(1e-3, rel=0.1)


@settings(deadline=None)
@given(scale=st.floats(0.0, 2.0, width=32))
def test_scaled_gradient_is_identity_forward_and_scale_backward(scale: float) -> None:
    x = torch.randn(3, 4, generator=torch.Generator().manual_seed(0), requires_grad=True)
    y = scale_gradient(x, scale)
    assert torch.equal(y, x)
    y.square().sum().backward()
    assert x.grad is not None
    torch.testing.assert_close(x.grad, scale * 2 * x.detach())


def test_gradient_into_cognition_is_half_and_into_the_projector_whole() -> None:
    gradients = {}
    for scale in (0.5, 1.0):
        prefix, cognition = _prefix(gradient_scale=scale), _cognition().requires_grad_()
        prefix(cognition, AGES_NS).square().sum().backward()
        gradients[scale] = (cognition.grad, prefix.projector.weight.grad)
    (half, projector_half), (whole, projector_whole) = gradients[0.5], gradients[1.0]
    torch.testing.assert_close(half, whole * 0.5)
    torch.testing.assert_close(projector_half, projector_whole)
    assert CognitionConfig().gradient_scale == 0.5, "paper A.3"


def test_dropped_cognition_gets_no_gradient_and_the_null_gets_it_whole() -> None:
    is_null = torch.tensor([False, True])
    gradients = {}
    for scale in (0.5, 1.0):
        prefix, cognition = _prefix(gradient_scale=scale), _cognition().requires_grad_()
        prefix(cognition, AGES_NS, is_null).sum().backward()
        assert cognition.grad is not None
        assert (cognition.grad[1] == 0).all()
        assert (cognition.grad[0] != 0).any()
        gradients[scale] = prefix.null_cognition.grad
    torch.testing.assert_close(gradients[0.5], gradients[1.0])


def test_one_playback_tick_of_age_is_visible() -> None:
    tokens = _prefix()(_cognition(), torch.tensor([300_000_000, 350_000_000]))
    assert (tokens[0, 0] - tokens[1, 0]).abs().max() > 0.1


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_carriers": 17}, r"0\.\.16, came 17"),
        ({"num_carriers": -1}, r"0\.\.16, came -1"),
        ({"cognition_size": 0}, "at least 1, came 0"),
        ({"age_features": 7}, "even and at least 2, came 7"),
        ({"attention": "half"}, "'full' or 'isolated', came 'half'"),
    ],
)
def test_wrong_configurations_are_refused(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CognitionConfig(**wrong)


@pytest.mark.parametrize("shape", [(2, 2, SIZE), (2, 3, SIZE + 1), (1, 3, SIZE)])
def test_cognition_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \(2, 3, 24\), came"):
        _prefix()(torch.zeros(shape), AGES_NS)


def test_no_carriers_no_module() -> None:
    with pytest.raises(ValueError, match="K = 0"):
        _prefix(num_carriers=0)


def test_snapped_cognition_is_that_of_the_nearest_place() -> None:
    config = CognitionConfig(num_carriers=2, cognition_size=40)
    plain, snapping = CognitionPrefix(config, WIDTH), CognitionPrefix(replace(config, rounds_places=True), WIDTH)
    plain.initialise(1.0, torch.Generator().manual_seed(0))
    snapping.load_state_dict(plain.state_dict())
    cognition = torch.randn(2, 2, 40, generator=torch.Generator().manual_seed(1))
    clean, places = cognition.clone(), ((10.0, 20.0), (100.5, 3.0), (255.0, 0.0), (128.0, 64.0))
    clean[..., :NUM_PLACE_FEATURES] = torch.from_numpy(np.stack([place_features(each) for each in places])).view(
        2, 2, -1
    )
    blurred = clean.clone()
    blurred[..., :NUM_PLACE_FEATURES] += 0.02
    torch.testing.assert_close(snapping(blurred, AGES_NS), plain(clean, AGES_NS))
    is_null = torch.tensor([True, True])
    assert torch.equal(snapping(blurred, AGES_NS, is_null), plain(None, AGES_NS))
