"""What is wrong with a folder is said alike of PONDER's and of POUNCE's."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from dual_system.models.device import require_device
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 7\n"
WEIGHTS, INDEX = "model.safetensors", "model.safetensors.index.json"
LOADERS: dict[str, Callable[[Path], Any]] = {"ponder": load_ponder, "pi05": load_bundle, "groot": load_bundle}
TOKENIZERS = {"ponder": "tokenizer.json", "pi05": "tokenizer.model", "groot": "tokenizer.json"}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("folders")
    config = replace(tiny_ponder(), num_layers=4, vision_depth=1, image_px=(64, 64), tied_embeddings=True)
    save_ponder(Ponder.random(config, seed=1), root / "ponder")
    save_bundle(random_bundle(tiny_cpu(), seed=0), root / "pi05")
    save_bundle(random_bundle(tiny_groot(), seed=0), root / "groot")
    return root


@pytest.fixture(params=list(LOADERS))
def family(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def folder(folders: Path, family: str, tmp_path: Path) -> Path:
    return shutil.copytree(folders / family, tmp_path / family)


def edit_config(folder: Path, **changes: Any) -> None:
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def edit_tensors(folder: Path, edit: Callable[[str, torch.Tensor], tuple[str, torch.Tensor]]) -> None:
    tensors = [edit(name, tensor) for name, tensor in load_file(folder / WEIGHTS).items()]
    save_file(dict(tensors), folder / WEIGHTS)


def first_of(folder: Path) -> str:
    """A tensor that every loader reads."""
    return next(name for name in load_file(folder / WEIGHTS) if name.endswith("q_proj.weight"))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("damage", [lambda path: path.write_text(POINTER), cut], ids=["pointer", "cut"])
@pytest.mark.parametrize("name", ["config.json", WEIGHTS, "tokenizer"])
def test_a_broken_file_is_named(folder: Path, family: str, name: str, damage: Callable[[Path], Any]) -> None:
    path = folder / (TOKENIZERS[family] if name == "tokenizer" else name)
    damage(path)
    with pytest.raises(ValueError, match=path.name) as error:
        LOADERS[family](folder)
    assert ("git lfs pull" in str(error.value)) == (damage is not cut)


@pytest.mark.parametrize("prefix", ["_orig_mod.", "module.", "module._orig_mod."])
def test_a_wrapper_s_prefix_changes_nothing(folder: Path, family: str, prefix: str) -> None:
    edit_tensors(folder, lambda name, tensor: (prefix + name, tensor))
    LOADERS[family](folder)


def test_another_prefix_is_shown(folder: Path, family: str) -> None:
    edit_tensors(folder, lambda name, tensor: ("base_model.model." + name, tensor))
    with pytest.raises(ValueError, match=r"unknown: base_model\.model\."):
        LOADERS[family](folder)


def test_weights_that_are_not_finite_are_refused(folder: Path, family: str) -> None:
    name = first_of(folder)
    edit_tensors(folder, lambda key, tensor: (key, tensor * float("nan") if key == name else tensor))
    with pytest.raises(ValueError, match="NaN or infinite"):
        LOADERS[family](folder)


def test_a_quantised_folder_is_refused(folder: Path, family: str) -> None:
    edit_config(folder, quantization_config={"quant_method": "bitsandbytes"})
    with pytest.raises(ValueError, match=r"quantised .*bitsandbytes"):
        LOADERS[family](folder)


def test_quantised_tensors_are_refused_whatever_the_config_says(folder: Path, family: str) -> None:
    edit_tensors(folder, lambda name, tensor: (name, tensor.to(torch.int8) if "q_proj" in name else tensor))
    with pytest.raises(ValueError, match="is I8, expected floating point"):
        LOADERS[family](folder)


def test_an_index_that_leads_out_of_the_folder_is_refused(folder: Path, family: str) -> None:
    names = list(load_file(folder / WEIGHTS))
    (folder / WEIGHTS).rename(folder.parent / WEIGHTS)
    (folder / INDEX).write_text(json.dumps({"weight_map": dict.fromkeys(names, f"../{WEIGHTS}")}))
    with pytest.raises(ValueError, match=r"beside it for .*, came '\.\./"):
        LOADERS[family](folder)


def test_more_layers_than_tensors_are_not_built(folder: Path, family: str) -> None:
    path = folder / "config.json"
    text = path.read_text()
    for name in ("num_hidden_layers", "depth"):
        values = json.loads(text, object_hook=lambda each, name=name: each | ({name: 10**9} if name in each else {}))
        path.write_text(json.dumps(values))
        if json.loads(text) != values:
            with pytest.raises(ValueError, match=f"{name} is 1000000000, and .* tensors are stored"):
                LOADERS[family](folder)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"text_config": 5}, "describes no Qwen3.5 network"),
        ({"torch_dtype": "os"}, "torch_dtype is 'os'"),
        ({"vision_config": {"patch_size": 0}}, "describes no Qwen3.5 network"),
    ],
)
def test_a_config_of_no_network_is_refused(folders: Path, tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    folder = shutil.copytree(folders / "ponder", tmp_path / "ponder")
    edit_config(folder, **changes)
    with pytest.raises(ValueError, match=said):
        load_ponder(folder)


@pytest.mark.parametrize("differs", [False, True])
def test_a_tied_head_may_be_stored_if_it_is_the_embedding(folders: Path, tmp_path: Path, differs: bool) -> None:
    folder = shutil.copytree(folders / "ponder", tmp_path / "ponder")
    tensors = load_file(folder / WEIGHTS)
    tensors["lm_head.weight"] = tensors["model.language_model.embed_tokens.weight"] + float(differs)
    save_file(tensors, folder / WEIGHTS)
    if not differs:
        load_ponder(folder)
        return
    with pytest.raises(ValueError, match="tied tensors that differ"):
        load_ponder(folder)


@pytest.mark.parametrize("family", ["ponder", "groot"], indirect=True)
@pytest.mark.parametrize(
    ("normalizer", "said"),
    [
        ({"type": "Replace", "pattern": {"String": "a"}, "content": "a" * 100}, "the normalizer is Replace"),
        ({"type": "Precompiled", "precompiled_charsmap": "AAAA"}, "no tokenizer.json"),  # parsing it panics
    ],
)
def test_a_tokenizer_that_rewrites_texts_is_refused(
    folder: Path, family: str, normalizer: dict[str, Any], said: str
) -> None:
    path = folder / TOKENIZERS[family]
    path.write_text(json.dumps(json.loads(path.read_text()) | {"normalizer": normalizer}))
    with pytest.raises(ValueError, match=rf"tokenizer\.json: {said}"):
        LOADERS[family](folder)


@pytest.mark.parametrize("device", ["gpu", "cuda:99", "mps", "meta"])
def test_a_device_that_is_not_there_is_a_sentence(device: str) -> None:
    with pytest.raises(ValueError, match=rf"--device {device} cannot be used: .*torch .* has cpu"):
        require_device(device)
    require_device("cpu")
