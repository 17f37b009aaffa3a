"""Exported folders hold the public names and nothing else, and other programs' readers see the same weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from transformers.models.qwen3_5 import Qwen3_5ForConditionalGeneration

from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.pi05.weights import unused_shapes
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder, weights_hash
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.export_hf import PREFIX_FILE, ExportOptions, export_folder, main
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu, tiny_groot
from dual_system.models.pounce.family import AnyPounceConfig


def nvidia_like() -> AnyPounceConfig:
    """A small GR00T whose folder tells it: SigLIP's head count stands nowhere, so it has the published one."""
    tiny = tiny_groot()
    eagle = replace(tiny.groot.eagle, vision=replace(tiny.groot.eagle.vision, num_heads=16))
    eagle = replace(eagle, language=replace(eagle.language, vocab_size=262))
    return replace(tiny, groot=replace(tiny.groot, eagle=eagle, num_embodiments=32))


def exported(bundle: PounceBundle, folder: Path, **changes: object) -> Path:
    save_bundle(bundle, folder / "ours")
    export_folder(ExportOptions(pounce=folder / "ours", out=folder / "public", **changes))  # type: ignore[arg-type]
    return folder / "public"


def test_ponder_s_folder_is_read_by_transformers_and_by_us(tmp_path: Path) -> None:
    ponder = Ponder.random(replace(tiny_ponder(), num_layers=4), seed=1)
    save_ponder(ponder, tmp_path / "ours")
    assert main(["--ponder", str(tmp_path / "ours"), "--out", str(tmp_path / "public")]) == 0
    assert weights_hash(load_ponder(tmp_path / "public")) == weights_hash(ponder)
    public = Qwen3_5ForConditionalGeneration.from_pretrained(tmp_path / "public", dtype=torch.float32)
    found = dict(public.named_parameters())
    for name, parameter in ponder.qwen.named_parameters():
        assert torch.equal(found[name], parameter), name


@pytest.mark.parametrize(("layout", "leading"), [("openpi", ""), ("lerobot", "model.")])
def test_pi05_s_folder_has_public_names_alone(tmp_path: Path, layout: str, leading: str) -> None:
    bundle = random_bundle(tiny_cpu(), seed=2)
    assert isinstance(bundle.model.config, PounceConfig)
    public = exported(bundle, tmp_path, layout=layout)
    names = set(load_file(public / "model.safetensors"))
    assert {name for name in names if not name.startswith(leading + "paligemma_with_expert.")} == {
        f"{leading}{part}.{end}"
        for part in ("action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out")
        for end in ("weight", "bias")
    }
    assert {leading + name for name in unused_shapes(bundle.model.config.pi05)} <= names
    again = load_bundle(public, config=bundle.model.config, statistics=bundle.statistics).model.state_dict()
    for name, tensor in bundle.model.state_dict().items():
        assert name.startswith("cognition_prefix.") or torch.equal(again[name], tensor), name
    assert set(load_file(public / PREFIX_FILE)) == {
        name.replace("cognition_prefix.", "pounce_prefix.") for name in again if name.startswith("cognition_prefix.")
    }


def test_groot_s_folder_tells_its_own_sizes(tmp_path: Path) -> None:
    bundle = random_bundle(nvidia_like(), seed=3)
    public = load_bundle(exported(bundle, tmp_path))
    assert public.model.config.groot == bundle.model.config.groot
    assert public.model.config.num_steps == bundle.model.config.num_steps
    found = public.model.state_dict()
    for name, tensor in bundle.model.state_dict().items():
        assert name.startswith("cognition_prefix.") or torch.equal(found[name], tensor), name


def test_what_a_public_folder_cannot_tell_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="read back it would be another one"):
        exported(random_bundle(tiny_groot(), seed=0), tmp_path)
    assert not (tmp_path / "public").exists()


def test_a_state_token_has_no_public_place(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="reads the state as a token"):
        exported(random_bundle(replace(tiny_cpu(), state_input="token"), seed=0), tmp_path)
    assert not (tmp_path / "public").exists()


def test_one_model_into_a_new_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--out", str(tmp_path / "x")]) == 2
    assert "one of --ponder and --pounce" in capsys.readouterr().err
    assert main(["--ponder", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "there already" in capsys.readouterr().err
