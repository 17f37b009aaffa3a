"""Laws of POUNCE with GR00T inside: what may and may not move the actions, and what each slot of the prefix does."""

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from dual_system.models.groot import flow as groot_flow
from dual_system.models.groot.network import GrootCache
from dual_system.models.groot.pounce import GrootInputs, GrootPounce, GrootPounceConfig
from dual_system.models.groot.qwen3 import causal_bias
from dual_system.models.pounce.configs import groot_n1_5, tiny_groot
from dual_system.models.pounce.initialise import initialise_groot, initialise_prefix, random_groot_pounce

SLOTS = ("features", "embeddings")


def _model(slot: str, num_carriers: int = 2) -> GrootPounce:
    config = replace(tiny_groot(num_carriers=num_carriers), slot=slot)
    return random_groot_pounce(config, seed=0).requires_grad_(False)


@pytest.fixture(scope="module", params=SLOTS)
def model(request: pytest.FixtureRequest) -> GrootPounce:
    return _model(request.param)


@pytest.fixture(scope="module")
def inputs(model: GrootPounce) -> GrootInputs:
    return model.config.example_inputs(2)


def _velocity_of(model: GrootPounce, cache: GrootCache, batch_size: int = 2) -> Tensor:
    x = model.config.example_actions(batch_size, seed=3)
    return model.groot.velocity_at(x, torch.linspace(0.2, 0.9, batch_size), cache)


def _velocity(model: GrootPounce, inputs: GrootInputs) -> Tensor:
    return _velocity_of(model, model.prefill(inputs), len(inputs.age_ns))


def _moved(model: GrootPounce, inputs: GrootInputs, **changed: Tensor | None) -> float:
    return (_velocity(model, replace(inputs, **changed)) - _velocity(model, inputs)).abs().max().item()


def _rows(inputs: GrootInputs, rows: slice) -> GrootInputs:
    chosen = {field.name: getattr(inputs, field.name) for field in fields(inputs)}
    return GrootInputs(**{name: tensor if tensor is None else tensor[rows] for name, tensor in chosen.items()})


def _padded(inputs: GrootInputs, num_padding: int) -> GrootInputs:
    padding = torch.zeros(len(inputs.token_ids), num_padding, dtype=torch.int64)
    return replace(
        inputs,
        token_ids=torch.cat([padding, inputs.token_ids], dim=1),
        is_token=torch.cat([padding.bool(), inputs.is_token], dim=1),
    )


def test_everything_that_enters_moves_the_actions(model: GrootPounce, inputs: GrootInputs) -> None:
    text = inputs.token_ids != model.config.groot.eagle.image_token_id
    other_text = torch.where(text, (inputs.token_ids + 1) % 200, inputs.token_ids)
    assert _moved(model, inputs, images=-inputs.images) > 1e-4
    assert _moved(model, inputs, token_ids=other_text) > 1e-4
    assert _moved(model, inputs, state=-inputs.state) > 1e-4
    assert _moved(model, inputs, embodiment=1 - inputs.embodiment) > 1e-2
    assert _moved(model, inputs, cognition=-inputs.cognition) > 1e-5
    assert _moved(model, inputs, cognition=None) > 1e-5
    assert _moved(model, inputs, age_ns=inputs.age_ns + 2_000_000_000) > 1e-5


def test_rows_of_a_batch_do_not_mix(model: GrootPounce, inputs: GrootInputs) -> None:
    mixed = replace(inputs, embodiment=torch.tensor([0, 1]))
    together = _velocity(model, mixed)
    x, times = model.config.example_actions(2, seed=3), torch.linspace(0.2, 0.9, 2)
    for row in range(2):
        one = slice(row, row + 1)
        alone = model.groot.velocity_at(x[one], times[one], model.prefill(_rows(mixed, one)))
        torch.testing.assert_close(alone[0], together[row], atol=1e-5, rtol=0)


def test_padding_leaves_real_features_alone_and_still_moves_the_actions(
    model: GrootPounce, inputs: GrootInputs
) -> None:
    """The public model's habit: positions shift, which RoPE does not mind, but the head masks nothing."""
    num_tokens = inputs.token_ids.shape[1]
    padded = _padded(inputs, 5)
    ours, theirs = (model.features(each)[:, -num_tokens:] for each in (inputs, padded))
    torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=0)
    assert (_velocity(model, padded) - _velocity(model, inputs)).abs().max() > 1e-4


def test_tabulated_styles_are_the_styles_of_the_time(model: GrootPounce, inputs: GrootInputs) -> None:
    table, cache = model.step_table(), model.prefill(inputs)
    x = model.config.example_actions(2, seed=3)
    assert [round(index / 4 * 1000) for index in range(4)] == groot_flow.euler_buckets(4, 1000)
    for index, style in enumerate(table.styles):
        direct = model.groot.velocity_at(x, torch.full((2,), index / 4), cache)
        torch.testing.assert_close(model.groot.velocity(x, style, cache), direct, atol=1e-5, rtol=0)


def test_the_cache_is_all_that_a_step_needs_of_the_observation(
    model: GrootPounce, inputs: GrootInputs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Features, mixer, cross-attention keys and values, state: computed once for all flow steps."""
    cache = model.prefill(inputs)
    calls: list[str] = []
    for name in ("features", "mixed", "state_features"):
        monkeypatch.setattr(model.groot, name, lambda *_, name=name, **__: calls.append(name))
    monkeypatch.setattr(model.groot.dit, "read", lambda *_: calls.append("read"))
    steps = list(model.groot.sample(model.config.example_actions(2), cache, model.step_table()))
    assert len(steps) == model.config.num_steps
    assert calls == []


def test_without_carriers_it_is_the_public_network(inputs: GrootInputs) -> None:
    bare = random_groot_pounce(tiny_groot(num_carriers=0), seed=0).requires_grad_(False)
    assert bare.cognition_prefix is None
    without = replace(bare.config.example_inputs(2), age_ns=torch.tensor([7, 8]))
    groot = bare.groot
    features = groot.features(without.images, without.token_ids, without.is_token)
    cache = groot.prefill(features, without.state, without.embodiment)
    assert torch.equal(_velocity(bare, without), _velocity_of(bare, cache))


def test_in_the_features_slot_the_language_model_does_not_know_of_cognition() -> None:
    model = _model("features")
    inputs = model.config.example_inputs(2)
    groot, num_cognition = model.groot, model.config.cognition.num_tokens
    features = model.features(inputs)
    public = groot.features(inputs.images, inputs.token_ids, inputs.is_token)
    assert torch.equal(features[:, num_cognition:], public)
    assert features.shape[1] == public.shape[1] + 3  # age and two carriers


def test_in_the_embeddings_slot_every_token_sees_cognition() -> None:
    model = _model("embeddings")
    inputs = model.config.example_inputs(2)
    num_cognition = model.config.cognition.num_tokens
    ours, other = (model.features(each) for each in (inputs, replace(inputs, cognition=-inputs.cognition)))
    assert ours.shape[1] == inputs.token_ids.shape[1] + num_cognition
    assert torch.equal(ours[:, 0], other[:, 0]), "the age token stands first and sees nothing else"
    assert ((ours - other)[:, 1:].abs().amax(dim=-1) > 0).all()


def test_in_the_embeddings_slot_padding_does_not_move_cognition_away() -> None:
    model = _model("embeddings")
    inputs = model.config.example_inputs(2)
    num_real = inputs.token_ids.shape[1]
    ours, padded = (model.features(each) for each in (inputs, _padded(inputs, 7)))
    num_cognition = model.config.cognition.num_tokens
    torch.testing.assert_close(ours[:, :num_cognition], padded[:, :num_cognition], atol=1e-4, rtol=0)
    torch.testing.assert_close(ours[:, -num_real:], padded[:, -num_real:], atol=1e-4, rtol=0)


def test_null_is_chosen_by_sample(model: GrootPounce, inputs: GrootInputs) -> None:
    one_null = _velocity(model, replace(inputs, is_null=torch.tensor([True, False])))
    torch.testing.assert_close(one_null[0], _velocity(model, replace(inputs, cognition=None))[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(one_null[1], _velocity(model, inputs)[1], atol=1e-6, rtol=0)


@pytest.mark.parametrize("num_carriers", [0, 1, 16])
def test_any_number_of_carriers_samples(num_carriers: int) -> None:
    for slot in SLOTS:
        model = _model(slot, num_carriers)
        noise = torch.randn(1, 20, 32, generator=torch.Generator().manual_seed(0))
        *_, last = model.sample(model.config.example_inputs(1), noise, model.step_table())
        assert last.actions.shape == (1, 20, 32)
        assert last.actions.isfinite().all()


def test_the_default_loss_is_over_the_robots_dims(model: GrootPounce, inputs: GrootInputs) -> None:
    actions, noise = model.config.example_actions(2), model.config.example_actions(2, seed=9)
    times = torch.tensor([0.3, 0.8])
    unreduced = model.unreduced_loss(inputs, actions, noise, times)
    expected = unreduced[..., : model.config.robot_action_dim].mean()
    torch.testing.assert_close(model.loss(inputs, actions, noise, times), expected, atol=1e-6, rtol=1e-5)


def test_rows_that_see_nothing_average_everything() -> None:
    bias = causal_bias(torch.tensor([[False, True, True]]), torch.float32)[0, 0]
    logits = torch.tensor([[3.0, -5.0, 40.0]] * 3)
    weights = torch.softmax(logits + bias, dim=-1)
    torch.testing.assert_close(weights[0], torch.full((3,), 1 / 3))
    assert weights[1].tolist() == [0.0, 1.0, 0.0]
    assert weights[2, 0] == 0.0


def test_every_parameter_is_drawn() -> None:
    model = random_groot_pounce(tiny_groot(), seed=0).requires_grad_(False)
    for parameter in model.parameters():
        parameter.fill_(torch.nan)
    initialise_groot(model.groot, torch.Generator().manual_seed(0))
    initialise_prefix(model, torch.Generator().manual_seed(0))
    assert all(parameter.isfinite().all() for parameter in model.parameters())


def test_a_fresh_projector_has_the_papers_scale() -> None:
    prefix = random_groot_pounce(tiny_groot(cognition_size=4096), seed=0).cognition_prefix
    assert prefix.projector.weight.std().item() == pytest.approx(1e-3, rel=0.02)
    assert (prefix.projector.bias == 0).all()
    assert (prefix.null_cognition == 0).all()


def test_full_size_runs_on_the_meta_device() -> None:
    """Shapes fit at full size, and no tensor is created on another device than the inputs'."""
    config = groot_n1_5(num_carriers=8)
    inputs = config.example_inputs(1)
    on_meta = {field.name: getattr(inputs, field.name) for field in fields(inputs) if field.name != "is_null"}
    with torch.device("meta"):
        model = GrootPounce(config)
    cache = model.prefill(GrootInputs(**{name: tensor.to("meta") for name, tensor in on_meta.items()}))
    assert len(cache.features_read) == 8
    assert cache.features_read[0][0].shape == (1, 32, 9 + 2 * 256 + 12, 48)
    assert cache.context.shape == (1, 33, 1536)
    styles = model.step_table().styles
    assert (len(styles), styles[0].norms.shape) == (4, (17, 2, 1, 1, 1536))
    noise = torch.empty(1, 16, 32, device="meta")
    assert model.groot.velocity(noise, styles[0], cache).shape == (1, 16, 32)


REFUSED = {
    "isolated": (lambda config: replace(config, cognition=replace(config.cognition, attention="isolated")), "the slot"),
    "slot": (lambda config: replace(config, slot="mixer"), "slot must be 'features' or 'embeddings', came 'mixer'"),
    "embodiment": (lambda config: replace(config, embodiment=2), r"embodiment must be 0\.\.1, came 2"),
    "state": (lambda config: replace(config, robot_state_dim=65), r"robot_state_dim must be 1\.\.64, came 65"),
    "horizon": (lambda config: replace(config, groot=replace(config.groot, horizon=65)), r"horizon must be 1\.\.64"),
}


@pytest.mark.parametrize(("change", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_configs_that_mean_nothing_are_refused(change: object, message: str) -> None:
    config: GrootPounceConfig = tiny_groot()
    with pytest.raises(ValueError, match=message):
        change(config)
