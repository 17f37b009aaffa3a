"""openpi's JAX layout: every array finds its place, checked against what the einsums of that code compute."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dual_system.models.interface import CognitionConfig
from dual_system.models.pi05.openpi_jax import public_tensors, read_params
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pi05.prompt import tiny_tokenizer_for_random_weights
from dual_system.models.pi05.weights import public_name
from dual_system.models.pounce.checkpoint import load_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.initialise import random_pounce
from dual_system.models.public_layout import assign
from dual_system.models.stored_tensors import WeightsError

LAYERS = "PaliGemma/llm/layers/"
BLOCKS = "PaliGemma/img/Transformer/encoderblock/"


@pytest.fixture(scope="module")
def model() -> Pounce:
    return random_pounce(tiny_cpu(num_carriers=0), seed=4).requires_grad_(False)


def _jax_arrays(model: Pounce) -> dict[str, Tensor]:
    """The model in openpi's JAX layout: shapes written out as that code declares them."""
    pi05 = model.pi05
    vision, language, expert = pi05.vision, pi05.language, pi05.expert
    arrays = {
        "PaliGemma/img/embedding/kernel": vision.patch_embedding.weight.permute(2, 3, 1, 0),
        "PaliGemma/img/embedding/bias": vision.patch_embedding.bias,
        "PaliGemma/img/pos_embedding": vision.position_embedding.weight[None],
        "PaliGemma/img/Transformer/encoder_norm/scale": vision.post_layernorm.weight,
        "PaliGemma/img/Transformer/encoder_norm/bias": vision.post_layernorm.bias,
        "PaliGemma/llm/embedder/input_embedding": language.embed_tokens.weight,
        "PaliGemma/llm/final_norm/scale": language.norm.weight,
    }

    def linear(name: str, *modules: torch.nn.Linear, is_stacked: bool = True) -> None:
        kernels = torch.stack([module.weight.T for module in modules])
        biases = torch.stack([module.bias for module in modules])
        arrays[f"{name}/kernel"] = kernels if is_stacked else kernels[0]
        arrays[f"{name}/bias"] = biases if is_stacked else biases[0]

    for name in ("action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out"):
        linear(name, getattr(pi05, name), is_stacked=False)
    linear("PaliGemma/img/head", pi05.projector, is_stacked=False)
    linear("PaliGemma/llm/final_norm_1/Dense_0", expert.norm.dense, is_stacked=False)

    heads, blocks = vision.config.num_heads, list(vision.layers)
    for index in (0, 1):
        norms = [getattr(block, f"layer_norm{index + 1}") for block in blocks]
        arrays[f"{BLOCKS}LayerNorm_{index}/scale"] = torch.stack([norm.weight for norm in norms])
        arrays[f"{BLOCKS}LayerNorm_{index}/bias"] = torch.stack([norm.bias for norm in norms])
        linear(f"{BLOCKS}MlpBlock_0/Dense_{index}", *(getattr(block.mlp, f"fc{index + 1}") for block in blocks))
    attention = f"{BLOCKS}MultiHeadDotProductAttention_0/"
    for name in ("query", "key", "value"):
        projections = [getattr(block.self_attn, f"{name[0]}_proj") for block in blocks]
        arrays[f"{attention}{name}/kernel"] = torch.stack([p.weight.T.unflatten(1, (heads, -1)) for p in projections])
        arrays[f"{attention}{name}/bias"] = torch.stack([p.bias.unflatten(0, (heads, -1)) for p in projections])
    outs = [block.self_attn.out_proj for block in blocks]
    arrays[f"{attention}out/kernel"] = torch.stack([out.weight.T.unflatten(0, (heads, -1)) for out in outs])
    arrays[f"{attention}out/bias"] = torch.stack([out.bias for out in outs])

    for suffix, stream, config in (("", language, pi05.config.language), ("_1", expert, pi05.config.expert)):
        attn = [layer.self_attn for layer in stream.layers]
        mlp = [layer.mlp for layer in stream.layers]

        def split(weight: Tensor, head_dim: int = config.head_dim) -> Tensor:
            return weight.unflatten(0, (-1, head_dim)).transpose(1, 2)  # (heads, width, head_dim)

        arrays[f"{LAYERS}attn/q_einsum{suffix}/w"] = torch.stack([split(a.q_proj.weight) for a in attn])
        arrays[f"{LAYERS}attn/kv_einsum{suffix}/w"] = torch.stack(
            [torch.stack([split(a.k_proj.weight), split(a.v_proj.weight)]) for a in attn]
        )
        arrays[f"{LAYERS}attn/attn_vec_einsum{suffix}/w"] = torch.stack(
            [a.o_proj.weight.T.unflatten(0, (-1, config.head_dim)) for a in attn]
        )
        arrays[f"{LAYERS}mlp{suffix}/gating_einsum"] = torch.stack(
            [torch.stack([m.gate_proj.weight.T, m.up_proj.weight.T]) for m in mlp]
        )
        arrays[f"{LAYERS}mlp{suffix}/linear"] = torch.stack([m.down_proj.weight.T for m in mlp])
    for theirs, ours in (("pre_attention_norm", "input_layernorm"), ("pre_ffw_norm", "post_attention_layernorm")):
        arrays[f"{LAYERS}{theirs}/scale"] = torch.stack([getattr(layer, ours).weight for layer in language.layers])
        linear(f"{LAYERS}{theirs}_1/Dense_0", *(getattr(layer, ours).dense for layer in expert.layers))
    return {name: array.contiguous() for name, array in arrays.items()}


def test_every_array_finds_its_place_bit_for_bit(model: Pounce) -> None:
    loaded = random_pounce(model.config, seed=5)
    assign(loaded, public_tensors(_jax_arrays(model), "jax"), public_name, "jax")
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name


def test_projections_compute_what_the_einsums_of_that_code_do(model: Pounce) -> None:
    arrays, config = _jax_arrays(model), model.config.pi05.language
    x = torch.randn(2, 5, config.width, generator=torch.Generator().manual_seed(0))
    attention = model.pi05.language.layers[1].self_attn
    queries = torch.einsum("BTD,NDH->BTNH", x, arrays[f"{LAYERS}attn/q_einsum/w"][1])
    torch.testing.assert_close(attention.q_proj(x).unflatten(-1, (-1, config.head_dim)), queries)
    keys, values = torch.einsum("BSD,zKDH->zBSKH", x, arrays[f"{LAYERS}attn/kv_einsum/w"][1])
    torch.testing.assert_close(attention.k_proj(x).unflatten(-1, (-1, config.head_dim)), keys)
    torch.testing.assert_close(attention.v_proj(x).unflatten(-1, (-1, config.head_dim)), values)
    out = torch.einsum("BTNH,NHD->BTD", queries, arrays[f"{LAYERS}attn/attn_vec_einsum/w"][1])
    torch.testing.assert_close(attention.o_proj(queries.flatten(2)), out, atol=1e-4, rtol=1e-4)


def test_missing_and_unknown_arrays_are_named(model: Pounce) -> None:
    arrays = _jax_arrays(model)
    arrays["state_proj/kernel"] = arrays.pop("time_mlp_in/kernel")  # what pi0 has instead
    with pytest.raises(WeightsError) as error:
        public_tensors(arrays, "params")
    assert "1 missing: time_mlp_in/kernel" in str(error.value)
    assert "1 unknown: state_proj/kernel" in str(error.value)


def test_a_folder_that_is_no_checkpoint_says_so(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no orbax checkpoint .* params/"):
        read_params(tmp_path)


def test_an_orbax_folder_loads(model: Pounce, tmp_path: Path) -> None:
    orbax = pytest.importorskip("orbax.checkpoint", reason="needs orbax-checkpoint and tensorstore")
    tree: dict[str, object] = {}
    for name, array in _jax_arrays(model).items():
        *path, last = ("params", *name.split("/"), "value")
        node = tree
        for part in path:
            node = node.setdefault(part, {})  # type: ignore[assignment]
        node[last] = np.asarray(array)
    with orbax.PyTreeCheckpointer() as writer:
        writer.save(tmp_path / "params", tree)
    (tmp_path / "tokenizer.model").write_bytes(tiny_tokenizer_for_random_weights().model_bytes)
    bundle = load_bundle(tmp_path, config=replace(model.config, cognition=CognitionConfig(num_carriers=2)))
    assert (bundle.is_random, bundle.has_fresh_prefix) == (False, True)
    for name, tensor in model.state_dict().items():
        assert torch.equal(bundle.model.state_dict()[name], tensor), name


def test_without_tensorstore_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorstore", None)
    (tmp_path / "params").mkdir()
    (tmp_path / "params" / "_METADATA").write_text('{"tree_metadata": {}}')
    with pytest.raises(ValueError, match="pip install tensorstore"):
        load_bundle(tmp_path, config=tiny_cpu())
    with pytest.raises(ValueError, match=r"is openpi's JAX pi0\.5, its config is GR00T's"):
        load_bundle(tmp_path, config=tiny_groot())
