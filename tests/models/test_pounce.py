"""Laws of POUNCE as a whole: what may and may not move the actions, and where gradients reach."""

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from dual_system.models import flow
from dual_system.models.pi05.network import Prefix
from dual_system.models.pi05.pounce import Pounce, PounceConfig, PounceInputs, freeze
from dual_system.models.pounce.configs import pi05_base, tiny_cpu
from dual_system.models.pounce.initialise import initialise_pi05, initialise_prefix, random_pounce


def _isolated(config: PounceConfig) -> PounceConfig:
    return replace(config, cognition=replace(config.cognition, attention="isolated"))


@pytest.fixture(scope="module")
def model() -> Pounce:
    return random_pounce(tiny_cpu(num_carriers=2), seed=0).requires_grad_(False)


@pytest.fixture(scope="module")
def inputs(model: Pounce) -> PounceInputs:
    return model.config.example_inputs(2)


def _velocity(model: Pounce, inputs: PounceInputs) -> Tensor:
    batch_size = len(inputs.age_ns)
    x = model.config.example_actions(batch_size, seed=3)
    return model.pi05.velocity_at(x, torch.linspace(0.2, 0.9, batch_size), model.prefill(inputs))


def _row(inputs: PounceInputs, row: int) -> PounceInputs:
    one = slice(row, row + 1)
    return PounceInputs(
        images=inputs.images[one],
        has_view=inputs.has_view[one],
        token_ids=inputs.token_ids[one],
        is_token=inputs.is_token[one],
        age_ns=inputs.age_ns[one],
        cognition=None if inputs.cognition is None else inputs.cognition[one],
    )


def _moved(model: Pounce, inputs: PounceInputs, **changed: Tensor | None) -> float:
    return (_velocity(model, replace(inputs, **changed)) - _velocity(model, inputs)).abs().max().item()


@pytest.mark.parametrize("attention", ["full", "isolated"])
def test_everything_that_enters_moves_the_actions(model: Pounce, inputs: PounceInputs, attention: str) -> None:
    if attention == "isolated":
        isolated = random_pounce(_isolated(model.config), seed=0)
        isolated.load_state_dict(model.state_dict())
        model = isolated.requires_grad_(False)
    assert _moved(model, inputs, images=-inputs.images) > 1e-3
    assert _moved(model, inputs, token_ids=(inputs.token_ids + 1) % model.config.pi05.vocab_size) > 1e-3
    assert _moved(model, inputs, cognition=-inputs.cognition) > 1e-3
    assert _moved(model, inputs, cognition=None) > 1e-3
    assert _moved(model, inputs, age_ns=inputs.age_ns + 2_000_000_000) > 1e-4


def test_a_missing_cameras_pixels_do_not_matter(model: Pounce, inputs: PounceInputs) -> None:
    missing = replace(inputs, has_view=torch.tensor([[True, False], [True, True]]))
    garbage = missing.images.clone()
    garbage[0, 1] = 0.3
    assert _moved(model, missing, images=garbage) == 0.0
    assert _moved(model, inputs, has_view=missing.has_view) > 1e-3


def test_a_missing_camera_is_as_if_it_had_no_slot(model: Pounce, inputs: PounceInputs) -> None:
    missing = replace(inputs, has_view=torch.tensor([[True, False], [True, False]]))
    absent = replace(inputs, images=inputs.images[:, :1], has_view=inputs.has_view[:, :1])
    torch.testing.assert_close(_velocity(model, missing), _velocity(model, absent), atol=1e-5, rtol=0)


def test_padding_does_not_matter(model: Pounce, inputs: PounceInputs) -> None:
    padding = torch.full((2, 5), 7)
    padded = replace(
        inputs,
        token_ids=torch.cat([inputs.token_ids, padding], dim=1),
        is_token=torch.cat([inputs.is_token, torch.zeros_like(padding, dtype=torch.bool)], dim=1),
    )
    torch.testing.assert_close(_velocity(model, padded), _velocity(model, inputs), atol=1e-5, rtol=0)


def test_rows_of_a_batch_do_not_mix(model: Pounce, inputs: PounceInputs) -> None:
    together = _velocity(model, inputs)
    x, times = model.config.example_actions(2, seed=3), torch.linspace(0.2, 0.9, 2)
    for row in range(2):
        alone = model.pi05.velocity_at(x[row : row + 1], times[row : row + 1], model.prefill(_row(inputs, row)))
        torch.testing.assert_close(alone[0], together[row], atol=1e-5, rtol=0)


def test_tabulated_styles_are_the_styles_of_the_time(model: Pounce, inputs: PounceInputs) -> None:
    table, cache = model.step_table(), model.prefill(inputs)
    x = model.config.example_actions(2, seed=3)
    for index, time in enumerate(flow.euler_times(model.config.num_steps)):
        direct = model.pi05.velocity_at(x, torch.full((2,), time), cache)
        torch.testing.assert_close(model.pi05.velocity(x, table.styles[index], cache), direct, atol=1e-5, rtol=0)


def test_full_attention_lets_images_see_cognition_and_isolated_does_not(model: Pounce, inputs: PounceInputs) -> None:
    num_cognition = model.config.cognition.num_tokens
    other = replace(inputs, cognition=-inputs.cognition)
    isolated = random_pounce(_isolated(model.config), seed=0)
    last = -1
    for candidate, may_differ in ((model, True), (isolated, False)):
        keys, other_keys = (candidate.prefill(each).keys[last][:, :, num_cognition:] for each in (inputs, other))
        assert torch.equal(keys, other_keys) is not may_differ


def test_isolated_cognition_does_not_see_the_images(model: Pounce, inputs: PounceInputs) -> None:
    num_cognition = model.config.cognition.num_tokens
    isolated = random_pounce(_isolated(model.config), seed=0)
    keys, other_keys = (
        isolated.prefill(each).keys[-1][:, :, :num_cognition]
        for each in (inputs, replace(inputs, images=-inputs.images))
    )
    assert torch.equal(keys, other_keys)


def test_isolated_images_and_text_keep_every_bit_of_the_public_model(inputs: PounceInputs) -> None:
    config = _isolated(tiny_cpu(num_carriers=2))
    isolated = random_pounce(config, seed=0).requires_grad_(False)
    public = Pounce(replace(config, cognition=replace(config.cognition, num_carriers=0))).requires_grad_(False)
    public.load_state_dict(isolated.state_dict(), strict=False)
    some_missing = replace(
        inputs,
        has_view=torch.tensor([[True, False], [True, True]]),
        is_token=torch.arange(12) < torch.tensor([[9], [12]]),
    )
    num_cognition = config.cognition.num_tokens
    ours, theirs = isolated.prefill(some_missing), public.prefill(some_missing)
    for layer in range(config.pi05.language.depth):
        assert torch.equal(ours.keys[layer][:, :, num_cognition:], theirs.keys[layer])
        assert torch.equal(ours.values[layer][:, :, num_cognition:], theirs.values[layer])
    assert torch.equal(ours.next_position, theirs.next_position)


def test_positions_count_real_tokens_only() -> None:
    is_real = torch.tensor([[True, False, True, True], [False, False, True, False]])
    prefix = Prefix(embeds=torch.zeros(2, 4, 1), is_real=is_real)
    positions = prefix.positions()
    assert positions[is_real].tolist() == [0, 1, 2, 0]


def test_cognition_stands_before_position_zero() -> None:
    is_real = torch.tensor([[True, True, True, False, True]])
    prefix = Prefix(embeds=torch.zeros(1, 5, 1), is_real=is_real, num_cognition=2)
    assert prefix.positions()[is_real].tolist() == [-2, -1, 0, 1]


@pytest.mark.parametrize("attention", ["full", "isolated"])
def test_gradient_reaches_cognition_through_the_frozen_backbone(attention: str) -> None:
    config = tiny_cpu(num_carriers=2)
    model = random_pounce(config if attention == "full" else _isolated(config), seed=0)
    freeze(model, "vlm")
    cognition = model.config.example_inputs(2).cognition.requires_grad_()
    inputs = replace(model.config.example_inputs(2), cognition=cognition)
    actions, noise = model.config.example_actions(2), model.config.example_actions(2, seed=9)
    model.loss(inputs, actions, noise, torch.tensor([0.3, 0.8])).backward()

    assert cognition.grad is not None
    assert cognition.grad.isfinite().all()
    assert (cognition.grad.abs().amax(dim=-1) > 0).all(), "every carrier of every sample learns"
    for part in (model.pi05.vision, model.pi05.projector, model.pi05.language):
        assert all(parameter.grad is None for parameter in part.parameters())
    for parameter in (
        model.cognition_prefix.projector.weight,
        model.cognition_prefix.age_projection.weight,
        model.pi05.expert.norm.dense.weight,
    ):
        assert (parameter.grad != 0).any()


@pytest.mark.parametrize(
    ("what", "frozen"),
    [("none", set()), ("vision", {"vision", "projector"}), ("vlm", {"vision", "projector", "language"})],
)
def test_freeze_sets_exactly_the_named_parts(what: str, frozen: set[str]) -> None:
    with torch.device("meta"):
        model = Pounce(tiny_cpu())
    freeze(model, "vlm")  # whatever was set before does not linger
    freeze(model, what)
    for name, parameter in model.named_parameters():
        part = name.split(".")[1] if name.startswith("pi05.") else "prefix"
        assert parameter.requires_grad is (part not in frozen), name


def test_unknown_freeze_mode_is_refused() -> None:
    with torch.device("meta"), pytest.raises(ValueError, match="none, vision, vlm, came 'all'"):
        freeze(Pounce(tiny_cpu(num_carriers=0)), "all")


def test_same_seed_same_weights_and_the_global_generator_is_left_alone() -> None:
    before = torch.get_rng_state()
    first, again, other = (random_pounce(tiny_cpu(), seed).state_dict() for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_every_parameter_is_drawn() -> None:
    model = random_pounce(tiny_cpu(), seed=0).requires_grad_(False)
    for parameter in model.parameters():
        parameter.fill_(torch.nan)
    initialise_pi05(model.pi05, torch.Generator().manual_seed(0))
    initialise_prefix(model, torch.Generator().manual_seed(0))
    assert all(parameter.isfinite().all() for parameter in model.parameters())


def test_full_size_has_the_published_parameter_count() -> None:
    config = pi05_base()
    with torch.device("meta"):
        model = Pounce(config)
    parameters = list(model.pi05.parameters())
    used = sum(parameter.numel() for parameter in parameters)
    unused_head = config.pi05.vocab_size * config.pi05.expert.width
    assert round(used / 1e9, 3) == 3.353
    assert used + unused_head == 3_616_757_520  # with it, the published 3.617 B in 812 tensors
    assert len(parameters) + 1 == 812


def test_full_size_runs_on_the_meta_device() -> None:
    """Shapes fit at full size, and no tensor is created on another device than the inputs'."""
    config = pi05_base(num_carriers=8)
    inputs = config.example_inputs(1)
    given = {field.name: getattr(inputs, field.name) for field in fields(inputs)}
    on_meta = {name: tensor for name, tensor in given.items() if tensor is not None}
    with torch.device("meta"):
        model = Pounce(config)
    noise = torch.empty(1, 20, 32, device="meta")
    cache = model.prefill(PounceInputs(**{name: tensor.to("meta") for name, tensor in on_meta.items()}))
    assert cache.keys[0].shape == (1, 1, 9 + 2 * 256 + 12, 256)
    styles = model.step_table().styles
    assert (len(styles), styles[0].shape) == (10, (37, 3, 1, 1, 1024))
    assert model.pi05.velocity(noise, styles[0], cache).shape == (1, 20, 32)


def test_streams_that_cannot_attend_jointly_are_refused() -> None:
    config = tiny_cpu().pi05
    with pytest.raises(ValueError, match=r"language\.depth 3 != expert\.depth 2"):
        replace(config, expert=replace(config.expert, depth=2))
