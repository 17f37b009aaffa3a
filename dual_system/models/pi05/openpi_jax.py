"""openpi's JAX checkpoints: the same pi0.5 with layers stacked on axis 0 and einsum-shaped matrices.

A checkpoint is an orbax folder (``params/`` of an openpi download). Reading one needs ``pip install tensorstore``,
which is no dependency of this project because nothing else uses it.
"""

# W width, h heads, g key heads, D head dim, M mlp width

import importlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pi05.weights import public_name
from dual_system.models.public_layout import assign
from dual_system.models.stored_tensors import WeightsError, require_finite
from protocol.files import read_object

METADATA_FILE = "_METADATA"

_IMAGE = "PaliGemma/img/"
_BLOCKS = _IMAGE + "Transformer/encoderblock/"
_LAYERS = "PaliGemma/llm/layers/"


class _Rule(NamedTuple):
    """How one of our tensors (one per layer, if stacked) is made from one JAX array."""

    jax: str
    ours: str
    convert: Callable[[Tensor], Tensor] = lambda array: array
    is_stacked: bool = False


def _turned(kernel: Tensor) -> Tensor:
    """(in, out) -> (out, in)."""
    return kernel.T


def _heads_out(kernel_WhD: Tensor) -> Tensor:
    """SigLIP's q, k, v kernels -> (h * D, W)."""
    return kernel_WhD.flatten(1).T


def _heads_in(kernel_hDW: Tensor) -> Tensor:
    """Output projections -> (W, h * D)."""
    return kernel_hDW.flatten(0, 1).T


def _einsum_heads(kernel_hWD: Tensor) -> Tensor:
    """Gemma's q, k, v einsums -> (h * D, W)."""
    return kernel_hWD.transpose(1, 2).flatten(0, 1)


def _linear(jax: str, ours: str, *, is_stacked: bool = False) -> Iterator[_Rule]:
    yield _Rule(f"{jax}/kernel", f"{ours}.weight", _turned, is_stacked)
    yield _Rule(f"{jax}/bias", f"{ours}.bias", is_stacked=is_stacked)


def _vision_rules() -> Iterator[_Rule]:
    vision = "pi05.vision."
    yield _Rule(f"{_IMAGE}embedding/kernel", f"{vision}patch_embedding.weight", lambda hwio: hwio.permute(3, 2, 0, 1))
    yield _Rule(f"{_IMAGE}embedding/bias", f"{vision}patch_embedding.bias")
    yield _Rule(f"{_IMAGE}pos_embedding", f"{vision}position_embedding.weight", lambda array: array[0])
    yield _Rule(f"{_IMAGE}Transformer/encoder_norm/scale", f"{vision}post_layernorm.weight")
    yield _Rule(f"{_IMAGE}Transformer/encoder_norm/bias", f"{vision}post_layernorm.bias")
    yield from _linear(f"{_IMAGE}head", "pi05.projector")
    layer = f"{vision}layers.{{}}."
    for index in (0, 1):
        for theirs, ours in (("scale", "weight"), ("bias", "bias")):
            yield _Rule(f"{_BLOCKS}LayerNorm_{index}/{theirs}", f"{layer}layer_norm{index + 1}.{ours}", is_stacked=True)
        yield from _linear(f"{_BLOCKS}MlpBlock_0/Dense_{index}", f"{layer}mlp.fc{index + 1}", is_stacked=True)
    attention = f"{_BLOCKS}MultiHeadDotProductAttention_0/"
    for name in ("query", "key", "value"):
        ours = f"{layer}self_attn.{name[0]}_proj"
        yield _Rule(f"{attention}{name}/kernel", f"{ours}.weight", _heads_out, is_stacked=True)
        yield _Rule(f"{attention}{name}/bias", f"{ours}.bias", Tensor.flatten, is_stacked=True)
    yield _Rule(f"{attention}out/kernel", f"{layer}self_attn.out_proj.weight", _heads_in, is_stacked=True)
    yield _Rule(f"{attention}out/bias", f"{layer}self_attn.out_proj.bias", is_stacked=True)


def _stream_rules(suffix: str, stream: str) -> Iterator[_Rule]:
    """Rules of the matrices that both streams have; the expert's names end in ``_1``."""
    layer = f"{stream}layers.{{}}."
    attention, mlp = f"{layer}self_attn.", f"{layer}mlp."
    kv = f"{_LAYERS}attn/kv_einsum{suffix}/w"  # (2, g, W, D)
    gate_up = f"{_LAYERS}mlp{suffix}/gating_einsum"  # (2, W, M)
    yield _Rule(f"{_LAYERS}attn/q_einsum{suffix}/w", f"{attention}q_proj.weight", _einsum_heads, is_stacked=True)
    yield _Rule(kv, f"{attention}k_proj.weight", lambda array: _einsum_heads(array[0]), is_stacked=True)
    yield _Rule(kv, f"{attention}v_proj.weight", lambda array: _einsum_heads(array[1]), is_stacked=True)
    yield _Rule(f"{_LAYERS}attn/attn_vec_einsum{suffix}/w", f"{attention}o_proj.weight", _heads_in, is_stacked=True)
    yield _Rule(gate_up, f"{mlp}gate_proj.weight", lambda array: array[0].T, is_stacked=True)
    yield _Rule(gate_up, f"{mlp}up_proj.weight", lambda array: array[1].T, is_stacked=True)
    yield _Rule(f"{_LAYERS}mlp{suffix}/linear", f"{mlp}down_proj.weight", _turned, is_stacked=True)


def _rules() -> Iterator[_Rule]:
    yield from _vision_rules()
    yield from _stream_rules("", "pi05.language.")
    yield from _stream_rules("_1", "pi05.expert.")
    yield _Rule("PaliGemma/llm/embedder/input_embedding", "pi05.language.embed_tokens.weight")
    yield _Rule("PaliGemma/llm/final_norm/scale", "pi05.language.norm.weight")
    yield from _linear("PaliGemma/llm/final_norm_1/Dense_0", "pi05.expert.norm.dense")
    for theirs, ours in (("pre_attention_norm", "input_layernorm"), ("pre_ffw_norm", "post_attention_layernorm")):
        yield _Rule(f"{_LAYERS}{theirs}/scale", f"pi05.language.layers.{{}}.{ours}.weight", is_stacked=True)
        yield from _linear(f"{_LAYERS}{theirs}_1/Dense_0", f"pi05.expert.layers.{{}}.{ours}.dense", is_stacked=True)
    for name in ("action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out"):
        yield from _linear(name, f"pi05.{name}")


def public_tensors(arrays: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Turns JAX arrays into tensors under public names (`pi05.weights`).

    Args:
        arrays: arrays by slash-separated path below ``params``, without the trailing ``/value`` of some checkpoints.
        source: names the checkpoint in errors.

    Raises:
        WeightsError: an array is missing (pi0, which has no adaRMS, lacks those of ``Dense_0``) or unknown.
    """
    rules = list(_rules())
    known = {rule.jax for rule in rules}
    problems = {"missing": known - arrays.keys(), "unknown": arrays.keys() - known}
    if any(problems.values()):
        raise WeightsError(source, problems)
    tensors: dict[str, Tensor] = {}
    for rule in rules:
        layers = arrays[rule.jax] if rule.is_stacked else arrays[rule.jax][None]
        for index, layer in enumerate(layers):
            tensors[public_name(rule.ours.format(index))] = rule.convert(layer).contiguous()
    return tensors


def read_params(folder: Path) -> dict[str, Tensor]:
    """Reads an orbax folder into float32 tensors, under the paths that `public_tensors` expects.

    Raises:
        FileNotFoundError: the folder is no orbax checkpoint.
        ValueError: tensorstore is not installed.
        WeightsError: an array cannot be read; CheckpointError: it has numbers that are not finite.
    """
    if not (folder / METADATA_FILE).is_file():
        raise FileNotFoundError(f"{folder} is no orbax checkpoint (no {METADATA_FILE}); openpi's is called params/")
    try:
        tensorstore = importlib.import_module("tensorstore")
    except ModuleNotFoundError as error:
        raise ValueError(f"{folder} is a JAX checkpoint; pip install tensorstore to read it") from error
    paths = _leaves(folder / METADATA_FILE)
    arrays = {}
    for path in paths:
        store = {"driver": "ocdbt", "base": f"file://{folder.resolve()}", "path": ".".join(path) + "/"}
        try:
            array = (
                tensorstore.open({"driver": "zarr", "kvstore": store}, open=True, read=True).result().read().result()
            )
        except ValueError as error:
            raise WeightsError(str(folder), {"unreadable": [f"{'/'.join(path)}: {error}"]}) from error
        name = "/".join(path).removeprefix("params/").removesuffix("/value")
        arrays[name] = torch.from_numpy(np.ascontiguousarray(array, np.float32))
        require_finite(arrays[name], name, folder)
    return arrays


def _leaves(path: Path) -> list[list[str]]:
    """Paths of the arrays. Raises ValueError if orbax's metadata does not list them."""
    try:
        leaves = read_object(path)["tree_metadata"].values()
        return [[str(key["key"]) for key in leaf["key_metadata"]] for leaf in leaves]
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} lists no arrays (tree_metadata, key_metadata): {error!r}") from None


def load_jax_weights(model: Pounce, folder: Path) -> None:
    """Loads openpi's JAX ``folder`` into ``model``; the model's own cognition prefix is kept.

    Raises:
        WeightsError: an array is missing, unknown or of another shape.
    """
    assign(model, public_tensors(read_params(folder), str(folder)), public_name, str(folder))
