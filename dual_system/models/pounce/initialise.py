"""POUNCE from a seed: every parameter drawn from one generator in a fixed order, no global random state."""

import torch
from torch import nn

from dual_system.models.gpu import generator_for
from dual_system.models.groot.blocks import EmbodimentLinear
from dual_system.models.groot.network import Groot
from dual_system.models.groot.pounce import GrootPounce, GrootPounceConfig
from dual_system.models.groot.qwen3 import PlainRmsNorm
from dual_system.models.pi05.gemma import AdaRmsNorm, RmsNorm
from dual_system.models.pi05.network import Pi05
from dual_system.models.pi05.pounce import Pounce, PounceConfig

_FAINT = 0.1


def random_pounce(config: PounceConfig, seed: int, device: torch.device | str = "cpu") -> Pounce:
    """Returns a float32 model with seeded random weights, drawn on ``device`` (`gpu.generator_for`).

    Built on the meta device first, because the constructors of torch.nn draw from the global generator.
    """
    with torch.device("meta"):
        model = Pounce(config)
    model.to_empty(device=device)
    generator = generator_for(torch.device(device), seed)
    initialise_pi05(model.pi05, generator)
    initialise_prefix(model, generator)
    if model.state_projector is not None:
        _draw(model.state_projector, generator)
    if model.frame_memory is not None:
        model.frame_memory.initialise(generator)
    if model.pointer is not None:
        model.pointer.initialise(generator)
    return model


@torch.no_grad()
def open_gates(model: Pounce | GrootPounce) -> None:
    """Prepares training from scratch: sets every adaRMS gate of pi0.5's expert to 1, with faint dependence on time.
    Drawn like the other weights, gates would be negative as often as positive."""
    if not isinstance(model, Pounce):
        return
    for module in model.pi05.expert.modules():
        if isinstance(module, AdaRmsNorm):
            module.dense.weight.mul_(_FAINT)
            _scale, _shift, gate = module.dense.bias.chunk(3)
            gate.fill_(1.0)


def random_groot_pounce(config: GrootPounceConfig, seed: int, device: torch.device | str = "cpu") -> GrootPounce:
    """`random_pounce` for GR00T."""
    with torch.device("meta"):
        model = GrootPounce(config)
    model.to_empty(device=device)
    generator = generator_for(torch.device(device), seed)
    initialise_groot(model.groot, generator)
    initialise_prefix(model, generator)
    return model


def initialise_prefix(model: Pounce | GrootPounce, generator: torch.Generator) -> None:
    """Draws a fresh cognition prefix at the scale of the model's text embeddings; does nothing at K = 0."""
    if model.cognition_prefix is None:
        return
    if isinstance(model, Pounce):
        embedding = model.pi05.language.embed_tokens.weight.detach()
        scale = embedding.shape[1] ** 0.5  # pi0.5 multiplies its text embeddings
    else:
        embedding = model.groot.eagle.language.embed_tokens.weight.detach()
        scale = 1.0
    text_rms = embedding.float().square().mean().sqrt().item() * scale
    model.cognition_prefix.to_empty(device=embedding.device)
    model.cognition_prefix.initialise(text_rms, generator)


def initialise_missing(model: Pounce, generator: torch.Generator) -> None:
    """Draws a frame memory or a pointer that a loaded file did not hold: it changes nothing until it is trained."""
    for part in (model.frame_memory, model.pointer):
        if part is not None and any(parameter.is_meta for parameter in part.parameters()):
            part.to_empty(device=model.pi05.language.embed_tokens.weight.device)
            part.initialise(generator)


def initialise_pi05(pi05: Pi05, generator: torch.Generator) -> None:
    """Preserves the variance of activations: weights N(0, 1 / fan-in), biases 0, norms the identity.

    The adaRMS layers are drawn like the rest. Public training starts them at zero, which closes every gate: such a
    model ignores its images, and a test on it would show nothing.
    """
    _draw(pi05, generator)


def initialise_groot(groot: Groot, generator: torch.Generator) -> None:
    """As `initialise_pi05`; every embodiment gets different weights."""
    _draw(groot, generator)


@torch.no_grad()
def _draw(network: nn.Module, generator: torch.Generator) -> None:
    for module in network.modules():
        if isinstance(module, nn.Linear | nn.Conv2d):
            module.weight.normal_(std=module.weight[0].numel() ** -0.5, generator=generator)
            if module.bias is not None:
                module.bias.zero_()
        elif isinstance(module, EmbodimentLinear):
            module.W.normal_(std=module.W.shape[1] ** -0.5, generator=generator)
            module.b.zero_()
        elif isinstance(module, nn.Embedding):
            module.weight.normal_(std=module.embedding_dim**-0.5, generator=generator)
        elif isinstance(module, nn.LayerNorm):
            module.weight.fill_(1.0)
            module.bias.zero_()
        elif isinstance(module, PlainRmsNorm):
            module.weight.fill_(1.0)
        elif isinstance(module, RmsNorm):
            module.weight.zero_()
