"""GR00T N1.5's public layout: exactly the published names, read with its habits, written back, misfits named."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from dual_system.models.groot.pounce import GrootPounce, GrootPounceConfig
from dual_system.models.groot.prompt import tiny_eagle_tokenizer_for_random_weights
from dual_system.models.groot.weights import load_weights, public_name, save_weights, unused_shapes
from dual_system.models.pi05.weights import save_weights as save_pi05
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import groot_n1_5, tiny_cpu, tiny_groot
from dual_system.models.pounce.family import family_of
from dual_system.models.pounce.initialise import random_groot_pounce, random_pounce
from dual_system.models.stored_tensors import StoredTensors, WeightsError

VISION = "backbone.eagle_model.vision_model.vision_model."
LANGUAGE = "backbone.eagle_model.language_model."


def _published_names() -> set[str]:
    """The tensors of nvidia/GR00T-N1.5-3B, written out from the layout and not from our modules."""
    both = ("weight", "bias")
    vision = [f"{VISION}embeddings.patch_embedding.{end}" for end in both]
    vision += [f"{VISION}embeddings.position_embedding.weight"]
    vision += [f"{VISION}post_layernorm.{end}" for end in both]
    vision += [
        f"{VISION}encoder.layers.{layer}.{part}.{end}"
        for layer in range(27)
        for part in (
            *("layer_norm1", "layer_norm2", "mlp.fc1", "mlp.fc2"),
            *(f"self_attn.{name}_proj" for name in ("q", "k", "v", "out")),
        )
        for end in both
    ]
    pooling = ["probe", "attention.in_proj_weight", "attention.in_proj_bias"]
    pooling += [f"{part}.{end}" for part in ("attention.out_proj", "layernorm", "mlp.fc1", "mlp.fc2") for end in both]
    language = [f"{LANGUAGE}{name}.weight" for name in ("model.embed_tokens", "model.norm", "lm_head")]
    language += [
        f"{LANGUAGE}model.layers.{layer}.{part}.weight"
        for layer in range(12)
        for part in (
            *("input_layernorm", "post_attention_layernorm", "self_attn.q_norm", "self_attn.k_norm"),
            *(f"self_attn.{name}_proj" for name in "qkvo"),
            *(f"mlp.{name}_proj" for name in ("gate", "up", "down")),
        )
    ]
    backbone = {*vision, *(f"{VISION}head.{name}" for name in pooling), *language}
    backbone |= {f"backbone.eagle_model.mlp1.0.{end}" for end in both}
    assert len(backbone) == 585

    block = [f"attn1.to_{name}" for name in "qkv"] + ["attn1.to_out.0", "ff.net.0.proj", "ff.net.2"]
    stacks = {"model": (16, [*block, "norm1.linear"]), "vl_self_attention": (4, [*block, "norm1", "norm3"])}
    head = {
        f"{stack}.transformer_blocks.{layer}.{part}.{end}"
        for stack, (depth, parts) in stacks.items()
        for layer in range(depth)
        for part in parts
        for end in both
    }
    linears = (*(f"timestep_encoder.timestep_embedder.linear_{i}" for i in (1, 2)), "proj_out_1", "proj_out_2")
    head |= {f"model.{part}.{end}" for part in linears for end in both}
    head |= {f"{mlp}.layer{i}.{end}" for mlp in ("state_encoder", "action_decoder") for i in (1, 2) for end in "Wb"}
    head |= {f"action_encoder.W{i}.{end}" for i in (1, 2, 3) for end in "Wb"}
    head |= {"future_tokens.weight", "position_embedding.weight", "vlln.weight", "vlln.bias"}
    return backbone | {f"action_head.{name}" for name in head}


@pytest.fixture(scope="module")
def full_size() -> GrootPounce:
    with torch.device("meta"):
        return GrootPounce(groot_n1_5(num_carriers=0))


def test_full_size_has_exactly_the_published_names(full_size: GrootPounce) -> None:
    names = {public_name(name) for name in full_size.state_dict()} | unused_shapes(full_size.config.groot).keys()
    assert names == _published_names()
    assert len(names) == 585 + 314


def test_full_size_has_the_published_parameter_counts(full_size: GrootPounce) -> None:
    def count(*parts: torch.nn.Module) -> int:
        return sum(parameter.numel() for part in parts for parameter in part.parameters())

    groot = full_size.groot
    unused = {name: torch.Size(shape).numel() for name, shape in unused_shapes(full_size.config.groot).items()}
    pooling = sum(size for name, size in unused.items() if name.startswith(VISION))
    assert count(groot.dit) == 550_386_688  # both as NVIDIA's training code logs them
    assert count(groot.mixer) == 201_433_088
    assert round((count(groot.eagle.vision) + pooling) / 1e6) == 428
    assert round(count(groot.eagle.language.layers, groot.eagle.language.norm) / 1e6) == 604
    assert round(count(groot.state_encoder, groot.action_encoder, groot.action_decoder) / 1e6) == 315
    assert round((count(groot) + sum(unused.values())) / 1e9, 2) == 2.72


@pytest.fixture(scope="module")
def model() -> GrootPounce:
    return random_groot_pounce(tiny_groot(), seed=1)


@pytest.fixture
def saved(model: GrootPounce, tmp_path: Path) -> Path:
    path = tmp_path / "model.safetensors"
    save_weights(model, path)
    return path


def _blank(config: GrootPounceConfig | None = None) -> GrootPounce:
    with torch.device("meta"):
        return GrootPounce(config or tiny_groot())


def _assert_same(loaded: GrootPounce, model: GrootPounce) -> None:
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name


@pytest.mark.peers
def test_a_file_of_full_depth_round_trips(tmp_path: Path) -> None:
    """Every published name, in small: nothing is lost, nothing added, no bit differs."""
    tiny, full = tiny_groot(num_carriers=0), groot_n1_5().groot
    eagle = tiny.groot.eagle
    eagle = replace(
        eagle,
        vision=replace(eagle.vision, depth=full.eagle.vision.depth),
        language=replace(eagle.language, depth=full.eagle.language.depth),
    )
    groot = replace(
        tiny.groot,
        eagle=eagle,
        mixer=replace(tiny.groot.mixer, depth=full.mixer.depth),
        dit=replace(tiny.groot.dit, depth=full.dit.depth),
    )
    config = replace(tiny, groot=groot)
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    model = random_groot_pounce(config, seed=0)
    save_weights(model, first)
    loaded = _blank(config)
    assert load_weights(loaded, first) is False
    _assert_same(loaded, model)
    save_weights(loaded, second)
    assert load_file(first).keys() == _published_names()
    assert first.read_bytes() == second.read_bytes()


def test_round_trip_keeps_the_prefix_too(model: GrootPounce, saved: Path) -> None:
    loaded = _blank()
    assert load_weights(loaded, saved) is True
    _assert_same(loaded, model)


def test_unused_heads_may_hold_anything_or_be_missing(model: GrootPounce, saved: Path) -> None:
    tensors = load_file(saved)
    unused = unused_shapes(model.config.groot)
    save_file(tensors | {name: torch.ones(3) for name in unused}, saved)
    loaded = _blank()
    load_weights(loaded, saved)
    _assert_same(loaded, model)
    save_file({name: tensor for name, tensor in tensors.items() if name not in unused}, saved)
    load_weights(_blank(), saved)


def test_the_token_embedding_is_not_the_lm_head(model: GrootPounce, saved: Path) -> None:
    tensors = load_file(saved)
    tensors[f"{LANGUAGE}lm_head.weight"] = tensors[f"{LANGUAGE}model.embed_tokens.weight"] + 1
    save_file(tensors, saved)
    loaded = _blank()
    load_weights(loaded, saved)
    _assert_same(loaded, model)


def test_lerobots_leading_name_is_accepted(model: GrootPounce, saved: Path) -> None:
    save_file({f"_groot_model.{name}": tensor for name, tensor in load_file(saved).items()}, saved)
    assert family_of(StoredTensors.of(saved).shapes, "x") == "groot"
    loaded = _blank()
    load_weights(loaded, saved)
    _assert_same(loaded, model)


def _shard(path: Path) -> list[Path]:
    """Cuts a file in two, with the index that NVIDIA's folder has."""
    tensors = list(load_file(path).items())
    path.unlink()
    half = len(tensors) // 2
    weight_map = {}
    shards = []
    for number, part in enumerate((tensors[:half], tensors[half:]), start=1):
        shards.append(path.with_name(f"model-{number:05}-of-00002.safetensors"))
        save_file(dict(part), shards[-1])
        weight_map |= {name: shards[-1].name for name, _ in part}
    path.with_name("model.safetensors.index.json").write_text(json.dumps({"weight_map": weight_map}))
    return shards


def test_shards_are_one_checkpoint(model: GrootPounce, saved: Path) -> None:
    shards = _shard(saved)
    loaded = _blank()
    load_weights(loaded, saved)
    _assert_same(loaded, model)
    shards[1].unlink()
    with pytest.raises(
        FileNotFoundError, match=r"index\.json lists model-00002-of-00002\.safetensors, which is not there"
    ):
        load_weights(_blank(), saved)


def test_misfits_are_all_named_at_once(saved: Path) -> None:
    tensors = load_file(saved)
    tensors["action_head.vlln.wait"] = tensors.pop("action_head.vlln.weight")
    tensors["action_head.vlln.bias"] = torch.zeros(5)
    save_file(tensors, saved)
    with pytest.raises(WeightsError) as error:
        load_weights(_blank(), saved)
    message = str(error.value)
    assert "1 missing: action_head.vlln.weight" in message
    assert "1 unknown: action_head.vlln.wait" in message
    assert "1 misshapen: action_head.vlln.bias expected (64,) came (5,)" in message


# -- folders


PUBLIC_CONFIG = {
    "model_type": "gr00t_n1_5",
    "action_horizon": 16,
    "action_head_cfg": {
        "action_horizon": 18,
        "num_inference_timesteps": 5,
        "num_timestep_buckets": 1000,
        "use_vlln": True,
        "add_pos_embed": True,
        "diffusion_model_cfg": {
            "num_attention_heads": 4,
            "attention_head_dim": 12,
            "norm_type": "ada_norm",
            "interleave_self_attention": True,
            "positional_embeddings": None,
        },
        "vl_self_attention_cfg": {"num_attention_heads": 4, "attention_head_dim": 16, "positional_embeddings": None},
    },
    "backbone_cfg": {"project_to_dim": None, "select_layer": 2},
}


def _public_config() -> GrootPounceConfig:
    tiny = tiny_groot()
    vision = replace(tiny.groot.eagle.vision, num_heads=16)  # SigLIP's head count stands in no file
    eagle = replace(tiny.groot.eagle, vision=vision, language=replace(tiny.groot.eagle.language, vocab_size=262))
    return replace(tiny, groot=replace(tiny.groot, eagle=eagle, num_embodiments=32, horizon=18))


@pytest.fixture
def public_folder(tmp_path: Path) -> Path:
    """NVIDIA's kind of folder in small: shards, a config in its dialect, no prefix of ours."""
    config = replace(_public_config(), cognition=replace(_public_config().cognition, num_carriers=0))
    path = tmp_path / "model.safetensors"
    save_weights(random_groot_pounce(config, seed=3), path)
    _shard(path)
    (tmp_path / "config.json").write_text(json.dumps(PUBLIC_CONFIG))
    (tmp_path / "tokenizer.json").write_bytes(tiny_eagle_tokenizer_for_random_weights().model_bytes)
    return tmp_path


def test_a_public_folder_tells_its_own_sizes(public_folder: Path) -> None:
    bundle = load_bundle(public_folder)
    config = bundle.model.config
    assert isinstance(config, GrootPounceConfig)
    assert config.groot == _public_config().groot
    assert (config.num_steps, config.embodiment) == (5, 31)
    assert (bundle.is_random, bundle.has_fresh_prefix) == (False, True)


def test_a_folder_without_nvidias_config_means_the_published_heads(public_folder: Path) -> None:
    (public_folder / "config.json").write_text('{"type": "groot", "chunk_size": 50}')  # lerobot's dialect
    with pytest.raises(ValueError, match=r"num_heads \* head_dim 2048 must be the language width 64"):
        load_bundle(public_folder)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("model_type", "gr00t_n1", "model_type is 'gr00t_n1', built here is 'gr00t_n1_5' only"),
        ("action_head_cfg.use_vlln", False, "use_vlln is False, built here is True only"),
        ("backbone_cfg.project_to_dim", 1536, "project_to_dim is 1536, built here is None only"),
    ],
)
def test_another_groot_is_refused_by_name(public_folder: Path, name: str, value: object, message: str) -> None:
    config = json.loads(json.dumps(PUBLIC_CONFIG))
    *path, last = name.split(".")
    record = config
    for part in path:
        record = record[part]
    record[last] = value
    (public_folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=message):
        load_bundle(public_folder)


def test_a_folder_without_its_tokenizer_says_where_to_get_one(public_folder: Path) -> None:
    (public_folder / "tokenizer.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"save Eagle's as tokenizer\.json .* --tokenizer"):
        load_bundle(public_folder)


def test_our_own_folder_survives(tmp_path: Path) -> None:
    bundle = random_bundle(tiny_groot(num_carriers=2), seed=0)
    save_bundle(bundle, tmp_path)
    loaded = load_bundle(tmp_path)
    assert loaded.model.config == bundle.model.config
    assert loaded.digest() == bundle.digest()
    assert (loaded.is_random, loaded.has_fresh_prefix) == (True, True)
    with pytest.raises(ValueError, match=r"has its own config\.json"):
        load_bundle(tmp_path, config=bundle.model.config)


def test_the_family_is_told_by_the_tensors(saved: Path, tmp_path: Path) -> None:
    assert family_of(StoredTensors.of(saved).shapes, "x") == "groot"
    pi05 = tmp_path / "pi05.safetensors"
    save_pi05(random_pounce(tiny_cpu(), seed=0), pi05)
    assert family_of(StoredTensors.of(pi05).shapes, "x") == "pi05"
    save_file({"conv1.weight": torch.zeros(1)}, pi05)
    with pytest.raises(WeightsError, match=r"1 tensors, none of them pi0\.5's .* or GR00T N1\.5's .*: conv1\.weight"):
        family_of(StoredTensors.of(pi05).shapes, "x")


def test_shapes_are_read_without_the_numbers(saved: Path, model: GrootPounce) -> None:
    shapes = StoredTensors.of(saved).shapes
    assert shapes["action_head.vlln.weight"] == (64,)
    assert len(shapes) == len(model.state_dict()) + len(unused_shapes(model.config.groot))


def test_parts_that_do_not_fit_each_other_are_refused() -> None:
    bundle = random_bundle(tiny_groot(), seed=0)
    with pytest.raises(ValueError, match="reads with EagleTokenizer, came Tokenizer"):
        replace(bundle, tokenizer=random_bundle(tiny_cpu(), seed=0).tokenizer)
    with pytest.raises(ValueError, match="statistics describe 8 state dims, the config 7"):
        random_bundle(replace(tiny_groot(), robot_state_dim=7), seed=0)
    eagle = replace(tiny_groot().groot.eagle, image_token_id=260)
    with pytest.raises(ValueError, match="the tokenizer's image token is 261, the model's 260"):
        random_bundle(replace(tiny_groot(), groot=replace(tiny_groot().groot, eagle=eagle)), seed=0)
