"""What learns: every freeze mode of either family moves exactly its parts, and C gets its gradient in every slot."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from dual_system.models.pi05.pounce import freeze
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.family import AnyPounce, random_model

MODES: dict[str, Callable[[], AnyPounce]] = {
    "pi05 full": lambda: random_model(tiny_cpu(num_carriers=2), 0),
    "pi05 isolated": lambda: random_model(
        replace(tiny_cpu(num_carriers=2), cognition=replace(tiny_cpu(num_carriers=2).cognition, attention="isolated")),
        0,
    ),
    "groot features": lambda: random_model(tiny_groot(num_carriers=2), 0),
    "groot embeddings": lambda: random_model(replace(tiny_groot(num_carriers=2), slot="embeddings"), 0),
}

VISION = ("pi05.vision.", "pi05.projector.", "groot.eagle.vision.", "groot.eagle.projector.")
LANGUAGE = ("pi05.language.", "groot.eagle.language.")
FROZEN: dict[str, tuple[str, ...]] = {"none": (), "vision": VISION, "vlm": (*VISION, *LANGUAGE)}
# Of pi0.5's last language layer only keys and values are read, so the rest of it has nothing to learn from.
NEVER_READ = (
    *(f"pi05.language.layers.2.{part}" for part in ("self_attn.q_proj", "self_attn.o_proj", "post_attention", "mlp.")),
    "pi05.language.norm.",
)


def _loss(model: AnyPounce) -> torch.Tensor:
    """One batch of two; the second sample sees the learned null."""
    inputs = model.config.example_inputs(2)
    inputs = replace(inputs, is_null=torch.tensor([False, True]))
    actions, noise = model.config.example_actions(2), model.config.example_actions(2, seed=9)
    return model.loss(inputs, actions, noise, torch.tensor([0.3, 0.8]))


@pytest.mark.parametrize("what", FROZEN)
@pytest.mark.parametrize("mode", MODES)
def test_one_step_moves_exactly_what_the_mode_leaves_free(mode: str, what: str) -> None:
    model = MODES[mode]()
    freeze(model, "none")  # whatever was set before does not linger
    freeze(model, what)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    optimiser = torch.optim.SGD([parameter for parameter in model.parameters() if parameter.requires_grad], lr=10.0)
    _loss(model).backward()
    optimiser.step()
    moved = {name for name, tensor in model.state_dict().items() if not torch.equal(tensor, before[name])}
    assert moved == {name for name in before if not name.startswith((*FROZEN[what], *NEVER_READ))}


@pytest.mark.parametrize("what", FROZEN)
@pytest.mark.parametrize("mode", MODES)
def test_gradient_reaches_every_carrier_whatever_is_frozen(mode: str, what: str) -> None:
    model = MODES[mode]()
    freeze(model, what)
    inputs = model.config.example_inputs(2)
    cognition = inputs.cognition.clone().requires_grad_()
    actions, noise = model.config.example_actions(2), model.config.example_actions(2, seed=9)
    model.loss(replace(inputs, cognition=cognition), actions, noise, torch.tensor([0.3, 0.8])).backward()
    assert cognition.grad is not None
    assert cognition.grad.isfinite().all()
    assert (cognition.grad.abs().amax(dim=-1) > 0).all()


@pytest.mark.parametrize("mode", MODES)
def test_the_scale_sits_on_c_and_on_nothing_else(mode: str) -> None:
    """Half the gradient enters PONDER; what POUNCE learns is the same with any scale (paper A.3)."""
    grads = {}
    for scale in (0.5, 1.0):
        model = MODES[mode]()
        model.cognition_prefix.config = replace(model.cognition_prefix.config, gradient_scale=scale)
        inputs = model.config.example_inputs(2)
        cognition = inputs.cognition.clone().requires_grad_()
        actions, noise = model.config.example_actions(2), model.config.example_actions(2, seed=9)
        model.loss(replace(inputs, cognition=cognition), actions, noise, torch.tensor([0.3, 0.8])).backward()
        grads[scale] = cognition.grad, model.cognition_prefix.projector.weight.grad
    torch.testing.assert_close(grads[0.5][0], 0.5 * grads[1.0][0])
    torch.testing.assert_close(grads[0.5][1], grads[1.0][1])


@pytest.mark.parametrize("mode", MODES)
def test_an_unknown_mode_is_refused(mode: str) -> None:
    with pytest.raises(ValueError, match="none, vision, vlm, came 'all'"):
        freeze(MODES[mode](), "all")
