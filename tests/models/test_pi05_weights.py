"""The public checkpoint layout: read with its habits, written back the same, every misfit named."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pi05.weights import load_weights, public_name, save_weights, unused_shapes
from dual_system.models.pounce.configs import pi05_base, tiny_cpu
from dual_system.models.pounce.initialise import random_pounce
from dual_system.models.stored_tensors import WeightsError

LM_HEAD = "paligemma_with_expert.paligemma.lm_head.weight"
EMBED = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
JUNK = "paligemma_with_expert.gemma_expert.lm_head.weight"
GOLDEN_WEIGHTS = Path(__file__).parent / "data" / "goldens" / "pi05_base" / "weights.safetensors"


def _published_names() -> set[str]:
    """The 812 tensors of openpi's pi05 checkpoints, written out from the layout and not from our modules."""
    both = ("weight", "bias")
    vision = "paligemma_with_expert.paligemma.model.vision_tower.vision_model."
    language = "paligemma_with_expert.paligemma.model.language_model."
    expert = "paligemma_with_expert.gemma_expert.model."
    names = {f"{part}.{end}" for part in ("action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out")
             for end in both}  # fmt: skip
    names |= {f"{vision}embeddings.patch_embedding.{end}" for end in both}
    names |= {f"{vision}embeddings.position_embedding.weight", LM_HEAD, JUNK, f"{language}norm.weight"}
    names |= {f"{vision}post_layernorm.{end}" for end in both}
    names |= {f"paligemma_with_expert.paligemma.model.multi_modal_projector.linear.{end}" for end in both}
    vision_parts = [f"self_attn.{name}_proj" for name in ("q", "k", "v", "out")]
    vision_parts += ["layer_norm1", "layer_norm2", "mlp.fc1", "mlp.fc2"]
    names |= {f"{vision}encoder.layers.{i}.{part}.{end}" for i in range(27) for part in vision_parts for end in both}
    matrices = [f"self_attn.{name}_proj" for name in "qkvo"] + [f"mlp.{name}_proj" for name in ("gate", "up", "down")]
    norms = ("input_layernorm", "post_attention_layernorm")
    names |= {f"{language}layers.{i}.{part}.weight" for i in range(18) for part in (*matrices, *norms)}
    names |= {f"{expert}layers.{i}.{part}.weight" for i in range(18) for part in matrices}
    names |= {f"{expert}layers.{i}.{part}.dense.{end}" for i in range(18) for part in norms for end in both}
    return names | {f"{expert}norm.dense.{end}" for end in both}


def test_full_size_has_exactly_the_published_names() -> None:
    with torch.device("meta"):
        model = Pounce(pi05_base(num_carriers=0))
    names = {public_name(name) for name in model.state_dict()} | unused_shapes(model.config.pi05).keys()
    assert names == _published_names()
    assert len(names) == 812


@pytest.mark.acceptance
def test_a_file_of_full_depth_round_trips(tmp_path: Path) -> None:
    """Every published name, in small: nothing is lost, nothing added, no bit differs."""
    tiny, full = tiny_cpu(num_carriers=0), pi05_base().pi05
    pi05 = replace(
        tiny.pi05,
        vision=replace(tiny.pi05.vision, depth=full.vision.depth),
        language=replace(tiny.pi05.language, depth=full.language.depth),
        expert=replace(tiny.pi05.expert, depth=full.expert.depth),
    )
    config = replace(tiny, pi05=pi05)
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    model = random_pounce(config, seed=0)
    save_weights(model, first)
    with torch.device("meta"):
        loaded = Pounce(config)
    assert load_weights(loaded, first) is False
    _assert_same(loaded, model)
    save_weights(loaded, second)
    assert load_file(first).keys() == _published_names()
    assert first.read_bytes() == second.read_bytes()


@pytest.fixture(scope="module")
def model() -> Pounce:
    return random_pounce(tiny_cpu(), seed=1)


@pytest.fixture
def saved(model: Pounce, tmp_path: Path) -> Path:
    path = tmp_path / "model.safetensors"
    save_weights(model, path)
    return path


def _blank() -> Pounce:
    with torch.device("meta"):
        return Pounce(tiny_cpu())


def _assert_same(loaded: Pounce, model: Pounce) -> None:
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name


def _rewrite(path: Path, change: dict[str, str | None]) -> None:
    """Renames tensors of a file; None drops."""
    tensors = {change.get(name, name): tensor for name, tensor in load_file(path).items()}
    save_file({name: tensor for name, tensor in tensors.items() if name is not None}, path)


def test_round_trip_keeps_every_bit(model: Pounce, saved: Path) -> None:
    loaded = _blank()
    assert load_weights(loaded, saved) is True
    _assert_same(loaded, model)


def test_saved_names_are_the_public_ones_and_ours() -> None:
    with torch.device("meta"):
        names = {public_name(name) for name, _ in Pounce(tiny_cpu()).named_parameters()}
    ours = {name for name in names if name.startswith("pounce_prefix.")}
    assert ours == {
        f"pounce_prefix.{part}"
        for part in ("projector.weight", "projector.bias", "age_projection.weight", "null_cognition")
    }
    golden = {name for name in load_file(GOLDEN_WEIGHTS)}
    assert names - ours == golden - {JUNK}  # same depths as tiny_cpu, so the same set of names


def test_public_file_without_prefix_leaves_ours_alone(model: Pounce, saved: Path) -> None:
    prefix_names = [name for name in load_file(saved) if name.startswith("pounce_prefix.")]
    _rewrite(saved, dict.fromkeys(prefix_names))
    other = random_pounce(tiny_cpu(), seed=2)
    before = other.cognition_prefix.projector.weight.clone()
    assert load_weights(other, saved) is False
    assert torch.equal(other.cognition_prefix.projector.weight, before)
    assert torch.equal(other.pi05.action_in_proj.weight, model.pi05.action_in_proj.weight)


def test_lerobots_leading_model_is_accepted(model: Pounce, saved: Path) -> None:
    _rewrite(saved, {name: f"model.{name}" for name in load_file(saved)})
    loaded = _blank()
    load_weights(loaded, saved)
    _assert_same(loaded, model)


def test_embedding_may_stand_under_either_name_or_both(model: Pounce, saved: Path) -> None:
    tensors = load_file(saved)
    for names in ([EMBED], [EMBED, LM_HEAD]):
        rest = {name: tensor for name, tensor in tensors.items() if name != LM_HEAD}
        save_file(rest | {name: tensors[LM_HEAD].clone() for name in names}, saved)
        loaded = _blank()
        load_weights(loaded, saved)
        _assert_same(loaded, model)


def test_tied_tensors_that_differ_are_refused(saved: Path) -> None:
    tensors = load_file(saved)
    save_file(tensors | {EMBED: tensors[LM_HEAD] + 1}, saved)
    with pytest.raises(WeightsError, match=r"tied tensors that differ.*embed_tokens"):
        load_weights(_blank(), saved)


def test_the_experts_unused_head_is_dropped(model: Pounce, saved: Path) -> None:
    save_file(load_file(saved) | {JUNK: torch.ones(3, 3)}, saved)
    loaded = _blank()
    load_weights(loaded, saved)
    _assert_same(loaded, model)


def test_missing_unknown_and_misshapen_are_all_named_at_once(saved: Path) -> None:
    tensors = load_file(saved)
    tensors["action_in_proj.wait"] = tensors.pop("action_in_proj.weight")
    tensors["time_mlp_in.bias"] = torch.zeros(5)
    save_file(tensors, saved)
    with pytest.raises(WeightsError) as error:
        load_weights(_blank(), saved)
    message = str(error.value)
    assert "1 missing: action_in_proj.weight" in message
    assert "1 unknown: action_in_proj.wait" in message
    assert "1 misshapen: time_mlp_in.bias expected (48,) came (5,)" in message


def test_half_a_prefix_is_missing_the_other_half(saved: Path) -> None:
    _rewrite(saved, {"pounce_prefix.null_cognition": None})
    with pytest.raises(WeightsError, match=r"missing: pounce_prefix\.null_cognition"):
        load_weights(_blank(), saved)


def test_long_lists_are_cut_with_a_count(saved: Path) -> None:
    save_file({"nothing": torch.zeros(1)}, saved)
    with pytest.raises(WeightsError, match=r"missing: .* and \d+ more"):
        load_weights(_blank(), saved)
