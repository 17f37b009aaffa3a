"""Public folders become a trained pair that plays: the commands of docs/training.md on networks of tiny width.

Head counts, grouping, layer pattern and file layout are those of Qwen3.5 0.8B and 9B and of openpi's pi0.5; widths,
depths and vocabulary are small.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from dual_system.data.episode import Package
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.configs import PonderConfig, qwen35_0p8b, qwen35_9b
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.training import train
from dual_system.training.build import Start, build
from dual_system.training.data import TrainingSet
from dual_system.training.recipes import recipe
from sim_client import evaluate

PX = 256
ON_CPU = ["--device", "cpu", "--dtype", "bfloat16"]


def narrow(size: PonderConfig, hidden_size: int) -> PonderConfig:
    """Four layers, three recurrent and one of attention, of the size's head counts."""
    return replace(
        size, hidden_size=hidden_size, ffn_size=96, num_layers=4, head_dim=32, gdn_head_dim=16, vocab_size=4096,
        vision_depth=1, vision_hidden_size=4 * size.vision_num_heads, vision_ffn_size=64, mrope_section=(2, 1, 1),
        first_carrier_id=4000,
    )  # fmt: skip


def public_ponder(folder: Path, config: PonderConfig) -> Path:
    """Qwen3.5's folder: no ponder.json, and padding rows that are all equal where carriers will be."""
    ponder = Ponder.random(config, seed=1, dtype=torch.bfloat16)
    with torch.no_grad():
        ponder.qwen.model.language_model.embed_tokens.weight[ponder.format.vocabulary.num_tokens :] = 0
    save_ponder(ponder, folder, max_shard_bytes=300_000)
    (folder / "ponder.json").unlink()
    assert len(list(folder.glob("model-*.safetensors"))) > 1
    return folder


def public_pounce(folder: Path) -> tuple[Path, Path]:
    """openpi's folder, and the tokenizer, which it lacks; names as torch.compile leaves them, numbers of two widths."""
    save_bundle(random_bundle(replace_heads(tiny_cpu()), seed=0), folder)
    tensors = {
        f"_orig_mod.{name}": tensor.to(torch.bfloat16) if "expert" in name else tensor
        for name, tensor in load_file(folder / "model.safetensors").items()
        if not name.startswith("pounce_prefix.")
    }
    save_file(tensors, folder / "model.safetensors")
    (folder / "config.json").write_text('{"action_dim": 32, "paligemma_variant": "gemma_2b"}')
    tokenizer = (folder / "tokenizer.model").rename(folder.with_name("tokenizer.model"))
    return folder, tokenizer


def replace_heads(config: PounceConfig) -> PounceConfig:
    """With SigLIP's published number of heads, which no file of a public folder says."""
    return replace(config, pi05=replace(config.pi05, vision=replace(config.pi05.vision, width=64, num_heads=16)))


@pytest.fixture(scope="module")
def data(
    tmp_path_factory: pytest.TempPathFactory,
    package_of_noise: Callable[..., Package],
    write_dataset: Callable[..., Path],
) -> Path:
    packages = [package_of_noise(seed, px=PX, num_rows=25) for seed in range(2)]
    return write_dataset(tmp_path_factory.mktemp("data") / "set", packages)


def test_a_public_pair_is_built_for_each_other(data: Path, tmp_path: Path) -> None:
    """Under the recipe of 9B: the prefix is of the PONDER that came, and carriers are drawn."""
    config = narrow(qwen35_0p8b(), 64)
    pounce, tokenizer = public_pounce(tmp_path / "openpi")
    start = Start(ponder=public_ponder(tmp_path / "qwen", config), pounce=pounce, tokenizer=tokenizer, dtype="bfloat16")
    model, bundle = build(recipe("robomme"), TrainingSet(data), start)
    assert model.pounce.config.cognition.cognition_size == config.hidden_size
    assert (bundle.is_random, bundle.has_fresh_prefix) == (False, True)
    table = model.ponder.qwen.model.language_model.embed_tokens.weight
    rms = {row: table[row].float().square().mean().sqrt().item() for row in (5, model.ponder.format.carrier_ids[0])}
    assert all(value == pytest.approx(1, rel=0.5) for value in rms.values())
    dtypes = {name: parameter.dtype for name, parameter in model.named_parameters()}
    for name in ("ponder.qwen.lm_head.weight", "pounce.pi05.expert.layers.0.mlp.up_proj.weight"):
        assert dtypes.get(name, table.dtype) == torch.bfloat16
    assert {each for name, each in dtypes.items() if name.startswith("pounce.cognition_prefix")} == {torch.float32}
    trained = {name for name, parameter in model.named_parameters() if parameter.requires_grad}
    assert not [name for name in trained if name.startswith(("pounce.pi05.vision.", "pounce.pi05.language."))]


@pytest.mark.peers
@pytest.mark.sim
@pytest.mark.parametrize(
    ("name", "config"),
    [("robomme_0p8b", narrow(qwen35_0p8b(), 64)), ("robomme", narrow(qwen35_9b(), 96))],
    ids=["0.8B", "9B"],
)  # fmt: skip
def test_a_public_pair_is_trained_resumed_exported_and_evaluated(
    name: str, config: PonderConfig, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ponder = public_ponder(tmp_path / "qwen", config)
    pounce, tokenizer = public_pounce(tmp_path / "openpi")
    run = tmp_path / "run"
    command = ["--recipe", name, "--data", str(data), "--out", str(run), "--ponder", str(ponder)]
    command += ["--pounce", str(pounce), "--tokenizer", str(tokenizer), *ON_CPU, "--no-progress"]
    command += ["--batch-episodes", "2", "--max-invocations", "2", "--accumulate", "2"]
    for steps in (1, 2):
        assert train.main([*command, "--steps", str(steps)]) == 0, capsys.readouterr().err
    assert [json.loads(line)["step"] for line in (run / "log.jsonl").read_text().splitlines()] == [0, 1]

    trained = load_ponder(run / "ponder", dtype=torch.bfloat16)
    bundle = load_bundle(run / "pounce")
    assert (trained.is_random, bundle.is_random, bundle.has_fresh_prefix) == (False, False, False)
    assert bundle.model.config.cognition.cognition_size == config.hidden_size
    carrier = trained.qwen.model.language_model.embed_tokens.weight[trained.format.carrier_ids[0]]
    assert carrier.float().abs().max() > 0.1
    with capsys.disabled():
        for system in ("ponder", "pounce"):
            stored = [each for file in (run / system).glob("*.safetensors") for each in load_file(file).values()]
            dtypes = Counter(str(each.dtype) for each in stored)
            sys.stdout.write(f"\n{name} {system}: {dict(dtypes)}")
            assert dtypes["torch.bfloat16"] > dtypes["torch.float32"] / 2

    played = tmp_path / "played"
    pair = ["--ponder-checkpoint", str(run / "ponder"), "--pounce-checkpoint", str(run / "pounce"), *ON_CPU]
    scenes = ["--tasks", "PickHighlight", "--episodes", "1", "--runs", "1", "--max-steps", "21", "--no-progress"]
    assert evaluate.main([*pair, *scenes, "--out", str(played)]) == 0, capsys.readouterr().err
    (episode,) = json.loads((played / "results.json").read_text())["episodes"]
    assert (episode["steps"], episode["status"]) == (21, "TIMEOUT")
    assert episode["models"]["ponder"]["is_untrained"] is False
