"""A pointer changes nothing until it is trained, points at what is there, and acts in serving as in training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dual_system.models.pi05.pounce import Pounce, PounceConfig, PounceInputs
from dual_system.models.ponder.context import IGNORE
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.models.pounce.family import random_model
from dual_system.models.pounce.precision import cast_streams
from pounce_server.engine import EagerEngine

PLAIN = replace(tiny_cpu(horizon=6), state_input="token")
POINTING = replace(PLAIN, num_pointed=2)
NUM_PATCHES = POINTING.pi05.vision.num_patches


def pounce(config: PounceConfig = POINTING, *, is_trained: bool = True) -> Pounce:
    model = random_model(config, 0)
    assert isinstance(model, Pounce)
    if is_trained and model.pointer is not None:
        with torch.no_grad():
            model.pointer.condition.weight.normal_(std=0.1, generator=torch.Generator().manual_seed(1))
    return model


def velocity(model: Pounce, inputs: PounceInputs) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    count = len(inputs.age_ns)
    noise_BNA = torch.randn(count, model.config.horizon, model.config.padded_action_dim, generator=generator)
    with torch.no_grad():
        return model.pi05.velocity_at(noise_BNA, torch.linspace(0.2, 0.8, count), model.prefill(inputs))


def test_until_it_is_trained_the_network_is_pi05_bit_for_bit() -> None:
    inputs = POINTING.example_inputs(3)
    plain, pointing = pounce(PLAIN), pounce(is_trained=False)
    pointing.load_state_dict(pointing.state_dict() | plain.state_dict())
    assert torch.equal(velocity(pointing, inputs), velocity(plain, inputs))
    assert not torch.equal(velocity(pounce(), inputs), velocity(plain, inputs))


def test_the_first_scores_are_of_the_front_pictures_patches_row_by_row() -> None:
    model, inputs = pounce(), POINTING.example_inputs(2)
    _, before_BQS = model.pointing(inputs)
    images = inputs.images.clone()
    images[:, 0, :, :28, 28:56] += 0.5  # the second patch of the first row
    _, after_BQS = model.pointing(replace(inputs, images=images))
    assert before_BQS.shape == (2, 4, NUM_PATCHES + 1)
    changed_QS = (after_BQS - before_BQS).abs().mean(dim=0)
    assert changed_QS[:2].sum(dim=0).argmax() == 1


def test_the_others_are_of_the_second_camera_s_and_it_may_be_out_of_view() -> None:
    model, inputs = pounce(), POINTING.example_inputs(2)
    _, before_BQS = model.pointing(inputs)
    images = inputs.images.clone()
    images[:, 1, :, 28:56, :28] += 5.0  # the first patch of the second row
    _, after_BQS = model.pointing(replace(inputs, images=images))
    changed_QS = (after_BQS - before_BQS).abs().mean(dim=0)
    assert changed_QS[2:, :-1].sum(dim=0).argmax() == round(NUM_PATCHES**0.5)
    assert (before_BQS[:, :2, -1] == torch.finfo(torch.float32).min).all()
    assert bool(before_BQS[:, 2:, -1].isfinite().all())


def test_what_is_out_of_view_is_not_read_from_the_second_picture() -> None:
    model, inputs = pounce(), POINTING.example_inputs(1)
    assert model.pointer is not None
    assert model.pointer.out_of_view is not None
    with torch.no_grad():
        model.pointer.out_of_view.bias.fill_(1e4)
        away = model.prefill(inputs).pointed
        model.pointer.read.weight[:, 3 * POINTING.pi05.language.width :].zero_()
        same = model.prefill(inputs).pointed
    assert away is not None
    assert same is not None
    assert torch.equal(away.styles, same.styles)


def test_the_expert_acts_on_what_is_taught_whatever_was_chosen() -> None:
    model, inputs = pounce(), POINTING.example_inputs(2)
    taught_BP = torch.tensor([[3, 17, NUM_PATCHES, 5], [0, 40, 2, NUM_PATCHES]])
    _, taught = model.pointing(inputs, taught_BP)
    before = model.prefill(inputs, taught_BP).pointed
    assert model.pointer is not None
    with torch.no_grad():
        model.pointer.score.weight.mul_(-3)
        model.pointer.out_of_view.bias.fill_(1e4)  # type: ignore[union-attr]
        after = model.prefill(inputs, taught_BP).pointed
    assert before is not None
    assert after is not None
    assert torch.equal(before.styles, after.styles)
    assert torch.equal(before.scores, taught)
    assert not torch.equal(before.scores, after.scores)


def test_a_place_that_is_not_taught_is_the_chosen_one() -> None:
    model, inputs = pounce(), POINTING.example_inputs(2)
    chosen, untaught = model.prefill(inputs).pointed, torch.full((2, 4), IGNORE)
    same = model.prefill(inputs, untaught).pointed
    other = model.prefill(inputs, untaught.index_fill(1, torch.tensor([1]), 3)).pointed
    assert chosen is not None
    assert same is not None
    assert other is not None
    assert torch.equal(chosen.styles, same.styles)
    assert not torch.equal(chosen.styles, other.styles)


def test_a_choice_that_is_certain_is_acted_on_as_if_it_were_taught() -> None:
    one = replace(POINTING, num_cameras=1)
    model, inputs = pounce(one), one.example_inputs(2)
    assert model.pointer is not None
    with torch.no_grad():
        model.pointer.score.weight.mul_(1e6)
        chosen = model.prefill(inputs).pointed
        assert chosen is not None
        taught = model.prefill(inputs, chosen.scores.argmax(dim=-1)).pointed
    assert taught is not None
    torch.testing.assert_close(chosen.styles, taught.styles)


def test_with_one_camera_it_points_in_front_alone() -> None:
    one = replace(POINTING, num_cameras=1)
    model = pounce(one)
    _, scores_BQS = model.pointing(one.example_inputs(2))
    assert scores_BQS.shape == (2, 2, NUM_PATCHES + 1)


def test_a_batch_is_its_samples_whatever_the_lengths_of_their_prompts() -> None:
    model, inputs = pounce(), POINTING.example_inputs(2)
    is_token = inputs.is_token.clone()
    is_token[1, 8:] = False
    together_BNA = velocity(model, replace(inputs, is_token=is_token))
    short = POINTING.example_inputs(2)
    alone = replace(
        short,
        images=short.images[1:],
        has_view=short.has_view[1:],
        token_ids=short.token_ids[1:, :8],
        is_token=short.is_token[1:, :8],
        age_ns=short.age_ns[1:],
        cognition=None if short.cognition is None else short.cognition[1:],
        state=None if short.state is None else short.state[1:],
    )
    generator = torch.Generator().manual_seed(2)
    noise_BNA = torch.randn(2, 6, POINTING.padded_action_dim, generator=generator)
    with torch.no_grad():
        alone_BNA = model.pi05.velocity_at(noise_BNA[1:], torch.tensor([0.8]), model.prefill(alone))
    torch.testing.assert_close(together_BNA[1:], alone_BNA, rtol=1e-4, atol=1e-5)


def test_draws_of_the_flow_that_share_a_prefix_are_those_that_do_not() -> None:
    model, inputs = pounce(), POINTING.example_inputs(2)
    actions_BNA = POINTING.example_actions(2)
    noise_SNA = torch.randn(6, *actions_BNA.shape[1:], generator=torch.Generator().manual_seed(3))
    times_S = torch.linspace(0.1, 0.9, 6)
    with torch.no_grad():
        together_SNA = model.unreduced_loss(inputs, actions_BNA, noise_SNA, times_S)
        for draw in range(3):
            rows = slice(2 * draw, 2 * draw + 2)
            alone_BNA = model.unreduced_loss(inputs, actions_BNA, noise_SNA[rows], times_S[rows])
            torch.testing.assert_close(together_SNA[rows], alone_BNA, rtol=1e-5, atol=1e-6)


def test_serving_conditions_the_flow_as_training_does() -> None:
    model, inputs = pounce(), POINTING.example_inputs(2)
    noise_BNA = torch.randn(2, 6, POINTING.padded_action_dim, generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        first = next(iter(model.sample(inputs, noise_BNA, model.step_table())))
        moved_BNA = noise_BNA - model.pi05.velocity_at(noise_BNA, torch.ones(2), model.prefill(inputs)) / 10
    torch.testing.assert_close(first.actions, moved_BNA, rtol=1e-5, atol=1e-6)


def test_what_was_filled_in_is_not_computed_again() -> None:
    model, inputs = pounce(), POINTING.example_inputs(2)
    filled, scores_BQS = model.pointing(inputs)
    assert filled.prefilled is not None
    assert model.prefill(filled) is filled.prefilled
    assert torch.equal(filled.prefilled.pointed.scores, scores_BQS)  # type: ignore[union-attr]
    with pytest.raises(ValueError, match="num_pointed is 0"):
        pounce(PLAIN).pointing(inputs)


def test_without_a_front_picture_it_points_at_nothing_there() -> None:
    model, inputs = pounce(), POINTING.example_inputs(1)
    has_view = torch.tensor([[False, True]])
    dark = replace(inputs, has_view=has_view)
    bright = replace(dark, images=torch.cat([inputs.images[:, :1] * -1, inputs.images[:, 1:]], dim=1))
    assert bool(velocity(model, dark).isfinite().all())
    assert torch.equal(velocity(model, dark), velocity(model, bright))


def test_without_a_second_picture_it_finds_nothing_there() -> None:
    model, inputs = pounce(), POINTING.example_inputs(1)
    dark = replace(inputs, has_view=torch.tensor([[True, False]]))
    bright = replace(dark, images=torch.cat([inputs.images[:, :1], inputs.images[:, 1:] * -1], dim=1))
    assert torch.equal(velocity(model, dark), velocity(model, bright))


def test_it_needs_a_front_picture_and_the_state() -> None:
    last = replace(POINTING.cognition, place="after_text")
    for broken in ({"num_cameras": 0}, {"state_input": "prompt"}, {"cognition": last}):
        with pytest.raises(ValueError, match="num_pointed needs a front camera"):
            replace(POINTING, **broken)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="num_pointed must be at least 0, came -1"):
        replace(PLAIN, num_pointed=-1)


def test_beside_streams_in_bfloat16_it_computes_in_float32() -> None:
    inputs, exact = POINTING.example_inputs(2), pounce()
    rounded = pounce()
    cast_streams(rounded, "bfloat16")
    _, exact_BQS = exact.pointing(inputs)
    _, rounded_BQS = rounded.pointing(inputs)
    assert rounded_BQS.dtype == torch.float32
    torch.testing.assert_close(rounded_BQS, exact_BQS, rtol=0.0, atol=0.1)
    assert bool(velocity(rounded, inputs).isfinite().all())


def test_a_folder_keeps_it(tmp_path: Path) -> None:
    bundle = replace(random_bundle(POINTING, 0), model=pounce())
    save_bundle(bundle, tmp_path / "pointing")
    assert load_bundle(tmp_path / "pointing").digest() == bundle.digest()


def test_a_fast_path_that_does_not_compute_it_is_refused() -> None:
    bundle = random_bundle(POINTING, 0)
    with pytest.raises(ValueError, match="has a pointer, which --path fused does not compute"):
        EagerEngine(bundle, path="fused")
    EagerEngine(bundle)
