"""``hf:ORG/NAME`` is a folder like any other; a path never becomes a download."""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dual_system.hub import local_folder
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu

COMMIT = "c" * 40


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The hub's cache, and no network."""
    constants = pytest.importorskip("huggingface_hub").constants
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    return tmp_path / "hub"


def keep(cache: Path, repo: str, folder: Path) -> None:
    """Lays a folder into the cache as the hub's client does: files by their hash, and links to them."""
    place = cache / f"models--{repo.replace('/', '--')}"
    snapshot = place / "snapshots" / COMMIT
    for sub in (snapshot, place / "blobs", place / "refs"):
        sub.mkdir(parents=True)
    (place / "refs" / "main").write_text(COMMIT)
    for path in folder.iterdir():
        blob = place / "blobs" / hashlib.sha256(path.read_bytes()).hexdigest()
        path.rename(blob)
        (snapshot / path.name).symlink_to(Path("../../blobs") / blob.name)


def test_a_snapshot_of_links_is_loaded_without_a_network(cache: Path, tmp_path: Path) -> None:
    config = replace(tiny_ponder(), num_layers=4, vision_depth=1, image_px=(64, 64))
    save_ponder(Ponder.random(config, seed=1), tmp_path / "ponder", max_shard_bytes=300_000)
    save_bundle(random_bundle(tiny_cpu(), seed=0), tmp_path / "pounce")
    for name in ("ponder", "pounce"):
        keep(cache, f"org/{name}", tmp_path / name)
    assert load_ponder(Path("hf:org/ponder")).hidden_size == config.hidden_size
    assert load_bundle(Path(f"hf:org/pounce@{COMMIT}")).model.config == tiny_cpu()


def test_what_is_not_there_is_a_sentence(cache: Path) -> None:
    with pytest.raises(FileNotFoundError, match="hf:org/none: the Hugging Face hub did not give it"):
        local_folder(Path("hf:org/none"))


@pytest.mark.parametrize("path", ["org/name", "runs/ponder", "/tmp/x", "."])
def test_a_path_is_never_fetched(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert local_folder(Path(path)) == Path(path)


@pytest.mark.parametrize("path", ["hf:", "hf:name", "hf:a/b/c", "hf:a/b@"])
def test_another_form_of_id_is_refused(path: str) -> None:
    with pytest.raises(ValueError, match="expected hf:ORG/NAME"):
        local_folder(Path(path))


def test_without_the_client_the_way_out_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ValueError, match="pip install huggingface_hub"):
        local_folder(Path("hf:org/name"))


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("Qwen/Qwen3.5-0.8B", "there is no such folder; the hub's model is hf:Qwen/Qwen3.5-0.8B"),
        ("https://huggingface.co/Qwen/Qwen3.5-0.8B", "the hub's model is hf:Qwen/Qwen3.5-0.8B"),
        ("/no/such/folder", "there is no such folder"),
        ("file", "it is a file; name its folder"),
        ("outer", "outer/pretrained_model has a config.json"),
        ("pickles", "pytorch_model.bin is weights in pickles, which are never read: convert them"),
        ("adapter", "adapter_model.safetensors is an adapter, to be merged into its base model first"),
        ("cut", "model.safetensors.incomplete is a download that has not ended"),
    ],
)
@pytest.mark.parametrize("load", [load_ponder, load_bundle])
def test_what_stands_in_the_place_of_a_checkpoint_is_said(
    load: Callable[[Path], object], path: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    for name in ("outer/pretrained_model/config.json", "pickles/pytorch_model.bin", "adapter/adapter_model.safetensors",
                 "cut/model.safetensors.incomplete"):  # fmt: skip
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text("{}")
    with pytest.raises(FileNotFoundError, match=re.escape(said)):
        load(Path(path))
