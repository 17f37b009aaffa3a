"""The importer: both halves whatever their prefixes, value for value; refused by name what it cannot explain."""

from __future__ import annotations

import json
import math
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from dual_system import commands
from dual_system.models.official.header import FolderError
from dual_system.models.official.import_folder import import_official, sizes_like
from dual_system.models.official.plan import expected
from dual_system.models.ponder.checkpoint import load_ponder
from dual_system.models.ponder.configs import qwen35_9b
from dual_system.models.ponder.text_policy import OFFICIAL_TEXTS
from dual_system.models.pounce.checkpoint import load_bundle
from dual_system.models.pounce.configs import pi05_base

STATISTICS = {
    "state": {"q01": [-1.0] * 8, "q99": [1.0] * 8},
    "action": {"q01": [-1.0] * 8, "q99": [1.0] * 8, "delta_mask": [True] * 7 + [False]},
}
PALIGEMMA_HEAD = "net.paligemma_with_expert.paligemma.lm_head.weight"


def imported(release: Any, out: Path, roles: Sequence[str] = ()) -> dict[str, Any]:
    like = sizes_like(release.pounce_like)
    folder = release.write()
    return import_official(folder, out, qwen=release.qwen, paligemma=release.paligemma, pounce=like, roles=roles)


def as_bfloat16(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.detach().to(torch.bfloat16).float()


@pytest.mark.parametrize(
    ("s1", "s2"),
    [
        ("zq7.policy.", "zq7.mllm.kk."),
        ("", "system2."),
        ("_orig_mod.model.system1.", "_orig_mod.model.system2."),
        ("a.", "b."),
    ],
)
def test_both_halves_are_found_behind_any_prefixes(make_release: Any, tmp_path: Path, s1: str, s2: str) -> None:
    release = make_release(s1=s1, s2=s2)
    facts = imported(release, tmp_path / "out")
    ponder = load_ponder(tmp_path / "out" / "ponder")
    theirs = release.ponder.qwen.state_dict()
    carriers = ponder.format.carrier_ids
    for name, mine in ponder.qwen.state_dict().items():
        expected = as_bfloat16(theirs[name])
        if name == "model.language_model.embed_tokens.weight":
            expected[list(carriers)] = as_bfloat16(theirs[name][list(release.ponder.format.carrier_ids)])
        assert torch.equal(mine, expected), name
    bundle = load_bundle(tmp_path / "out" / "pounce")
    for name, mine in bundle.model.state_dict().items():
        assert torch.equal(mine, as_bfloat16(release.pounce.state_dict()[name])), name
    assert (bundle.is_random, bundle.has_fresh_prefix, ponder.is_random) == (False, False, False)
    assert json.loads((tmp_path / "out" / "import.json").read_text())["prefixes"] == facts["prefixes"]


def test_the_conventions_are_data_in_both_folders(make_release: Any, tmp_path: Path) -> None:
    imported(make_release(num_carriers=2), tmp_path / "out")
    form = load_ponder(tmp_path / "out" / "ponder").format
    assert (form.opening_form, form.texts, form.demonstrations.num_views) == ("bare", OFFICIAL_TEXTS, 1)
    assert (form.num_carriers, form.demonstrations.hz) == (2, 1)
    bundle = load_bundle(tmp_path / "out" / "pounce")
    config: Any = bundle.model.config
    assert (config.state_input, config.stateless_prompt) == ("token", "task")
    assert (config.cognition.age_features, config.cognition.age_bias) == (34, True)
    assert bundle.statistics.action.q99 == (*(0.3,) * 7, 1.0)


def test_a_tensor_keeps_its_dtype_and_memory_holds_one_piece(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    release.write()
    tracemalloc.start()
    imported(release, tmp_path / "out")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    size = (release.folder / "model.safetensors").stat().st_size
    largest = max(each.nbytes for each in release.tensors.values())
    written = sum((tmp_path / "out" / half / "model.safetensors").stat().st_size for half in ("ponder", "pounce"))
    assert written < 1.1 * size
    assert peak < size / 2 + largest


@pytest.mark.parametrize("stores", ["both", "head", "embed_tokens"])
def test_the_embedding_may_be_stored_once_or_twice(make_release: Any, tmp_path: Path, stores: str) -> None:
    release = make_release(stores=stores)
    facts = imported(release, tmp_path / "out")
    assert facts["copies_equal"] == ({release.s1 + PALIGEMMA_HEAD: True} if stores == "both" else {})
    bundle = load_bundle(tmp_path / "out" / "pounce")
    expected = as_bfloat16(release.pounce.pi05.language.embed_tokens.weight)
    assert torch.equal(bundle.model.state_dict()["pi05.language.embed_tokens.weight"], expected)


def test_of_two_different_embeddings_the_one_that_is_read_is_kept_and_said(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    release.tensors[release.s1 + PALIGEMMA_HEAD] += 1
    facts = imported(release, tmp_path / "out")
    assert facts["copies_equal"] == {release.s1 + PALIGEMMA_HEAD: False}
    assert any("differs" in note for note in facts["notes"])
    bundle = load_bundle(tmp_path / "out" / "pounce")
    expected = as_bfloat16(release.pounce.pi05.language.embed_tokens.weight)
    assert torch.equal(bundle.model.state_dict()["pi05.language.embed_tokens.weight"], expected)


def tied_with(head: str) -> Callable[[Any], None]:
    def change(release: Any) -> None:
        (embedding,) = release.names(["vlm.model.language_model.embed_tokens"])
        release.tensors[release.s2 + "vlm.lm_head.weight"] = release.tensors[embedding].clone() + (head == "differs")

    return change


@pytest.mark.parametrize("head", ["absent", "equal", "differs"])
def test_a_tied_head_is_absent_or_equal(make_release: Any, tmp_path: Path, head: str) -> None:
    release = make_release(is_tied=True)
    if head != "absent":
        tied_with(head)(release)
    if head == "differs":
        with pytest.raises(FolderError, match=r"vlm\.lm_head\.weight: config\.json says the head is tied"):
            imported(release, tmp_path / "out")
        return
    imported(release, tmp_path / "out")
    assert load_ponder(tmp_path / "out" / "ponder").qwen.config.tie_word_embeddings


def rename(old: str, new: str) -> Callable[[Any], None]:
    def change(release: Any) -> None:
        (name,) = [name for name in release.tensors if name.endswith(old)]
        release.tensors[name.removesuffix(old) + new] = release.tensors.pop(name)

    return change


def add(name: str, *shape: int, dtype: torch.dtype = torch.bfloat16) -> Callable[[Any], None]:
    def change(release: Any) -> None:
        release.tensors[name] = torch.ones(shape, dtype=dtype)

    return change


def drop(end: str) -> Callable[[Any], None]:
    def change(release: Any) -> None:
        (name,) = [name for name in release.tensors if name.endswith(end)]
        del release.tensors[name]

    return change


def both(*changes: Callable[[Any], None]) -> Callable[[Any], None]:
    def change(release: Any) -> None:
        for each in changes:
            each(release)

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (add("zq7.policy.router.weight", 5, 7), r"unexplained zq7\.policy\.router\.weight: BF16 \(5, 7\), near POUNCE"),
        (add("zq7.mllm.kk.gate", 3), r"unexplained zq7\.mllm\.kk\.gate: BF16 \(3,\), near PONDER"),
        (add("ema.decay", 1), r"unexplained ema\.decay: BF16 \(1,\), near neither"),
        (add("zq7.policy.second", 64, 96), r"projector: expected one tensor, came .*bridge\.weight.*second"),
        (add("zq7.policy.zero", 96), r"null: expected one tensor, came .*nothing_yet.*zero"),
        (drop("soft_tokens"), r"carriers: no tensor has its shape \(\(K, 96\) or \(96,\) in PONDER's half\)"),
        (drop("nothing_yet"), "null: no tensor"),
        (drop("clock.weight"), "age: no tensor"),
        (
            both(drop("joints.weight"), drop("joints.bias"), add("zq7.policy.into_expert.weight", 48, 8)),
            r"unexplained zq7\.policy\.into_expert\.weight(.|\n)*state: no tensor.*cannot be served yet",
        ),
        (
            both(drop("bridge.weight"), add("zq7.policy.b.0.weight", 40, 96), add("zq7.policy.b.2.weight", 64, 40)),
            r"two layers zq7\.policy\.b\.0\.weight \(40, 96\), then zq7\.policy\.b\.2\.weight \(64, 40\).*W_c",
        ),
        (
            both(drop("clock.weight"), drop("joints.weight"), add("zq7.policy.either", 64, 8)),
            r"unexplained zq7\.policy\.either(.|\n)*age: no tensor(.|\n)*state: no tensor",
        ),
        (drop("visual.patch_embed.proj.weight"), r"model\.visual\.\*: expected one patch_embed"),
        (rename("visual.merger.norm.weight", "visual.merger.norm.scale"), r"missing .*merger\.norm\.weight"),
        (drop("vlm.lm_head.weight"), r"missing lm_head\.weight .* not tied"),
        (
            lambda release: release.tensors.update(
                {
                    "ema." + name: release.tensors[name].clone()
                    for name in release.names(["visual.patch_embed.proj.weight"])
                }
            ),
            r"expected one patch_embed\.proj\.weight, came under 'ema\.zq7\..*', 'zq7\.",
        ),
        (
            lambda release: release.tensors.update(
                {"zq7.policy.net.action_in_proj.bias": torch.ones(5, dtype=torch.bfloat16)}
            ),
            r"misshapen zq7\.policy\.net\.action_in_proj\.bias: expected \(48,\), came \(5,\)",
        ),
        (
            lambda release: release.tensors.update({"zq7.policy.bridge.weight": torch.ones(64, 96, dtype=torch.int8)}),
            r"unexplained zq7\.policy\.bridge\.weight: I8",
        ),
        (
            lambda release: release.tensors.update(
                {"zq7.mllm.kk.vlm.lm_head.weight": torch.ones(512, 96, dtype=torch.int8)}
            ),
            r"lm_head\.weight: I8 is no number format",
        ),
        (add("zq7.mllm.kk.vlm.mtp.pre_fc_norm_hidden.weight", 96), r"missing zq7\.mllm\.kk\.vlm\.mtp\.fc\.weight"),
        (
            lambda release: release.config.update({"s2": {"num_cognition_tokens": 4}}),
            r"s2\.num_cognition_tokens is 4, the tensors have 1",
        ),
        (lambda release: release.config.update({"s2": {"max_demo_frames": 9}}), r"max_demo_frames is 9"),
        (lambda release: release.config.update({"s2": {"demo_fps": 3}}), r"demo_fps is 3"),
    ],
)
def test_what_cannot_be_explained_is_refused_by_name_and_nothing_is_written(
    make_release: Any, tmp_path: Path, change: Callable[[Any], None], said: str
) -> None:
    release = make_release()
    change(release)
    with pytest.raises(FolderError, match=said):
        imported(release, tmp_path / "out")
    assert not [path for path in tmp_path.iterdir() if path.name.startswith("out")]


def test_a_null_in_neither_half_is_found_by_elimination(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    rename("zq7.policy.nothing_yet", "top.null")(release)
    assert imported(release, tmp_path / "out")["roles"]["null"]["name"] == "top.null"


def ambiguous(make_release: Any) -> Any:
    """An age of 32 features beside a state of 8 dims: by shape, either may be either."""
    release = make_release()
    release.tensors["zq7.policy.clock.weight"] = release.tensors["zq7.policy.clock.weight"][:, :32].clone()
    return release


def test_what_shapes_do_not_tell_apart_is_refused_until_it_is_given(make_release: Any, tmp_path: Path) -> None:
    release = ambiguous(make_release)
    with pytest.raises(FolderError, match=r"age: expected one tensor, came .*clock.*joints"):
        imported(release, tmp_path / "out")
    roles = ["age=zq7.policy.clock.weight", "state=zq7.policy.joints.weight"]
    facts = imported(release, tmp_path / "out", roles=roles)
    assert facts["roles"]["age"]["name"] == "zq7.policy.clock.weight"
    assert facts["roles"]["age_bias"]["name"] == "zq7.policy.clock.bias"
    config: Any = load_bundle(tmp_path / "out" / "pounce").model.config
    assert config.cognition.age_features == 32


@pytest.mark.parametrize(
    ("role", "said"),
    [
        ("age=zq7.policy.nowhere", "age: given as zq7.policy.nowhere, which is no tensor"),
        ("age=zq7.policy.bridge.weight", r"age: given as zq7\.policy\.bridge\.weight \(64, 96\), expected \(64, F\)"),
        ("clock=zq7.policy.clock.weight", "expected ROLE=NAME with a role of carriers, null"),
    ],
)
def test_a_given_role_must_fit(make_release: Any, tmp_path: Path, role: str, said: str) -> None:
    with pytest.raises(FolderError, match=said):
        imported(ambiguous(make_release), tmp_path / "out", roles=[role])


def test_every_unexplained_tensor_is_named(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    strangers = [f"zq7.policy.w{number}" for number in range(30)]
    for name in strangers:
        add(name, 5, 7)(release)
    with pytest.raises(FolderError) as refused:
        imported(release, tmp_path / "out")
    assert all(f"unexplained {name}: " in str(refused.value) for name in strangers)


def test_buffers_and_the_unused_head_are_listed_as_not_read(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    add("zq7.mllm.kk.vlm.rotary_emb.inv_freq", 16, dtype=torch.float32)(release)
    facts = imported(release, tmp_path / "out")
    assert sorted(facts["not_read"].values()) == ["buffer", "copy_of_embedding", "unused_expert_head"]


def test_multi_token_prediction_is_kept(make_release: Any, tmp_path: Path) -> None:
    from dual_system.models.ponder.checkpoint import mtp_shapes

    release = make_release()
    qwen = release.ponder.qwen
    shapes = {name: tuple(each.shape) for name, each in qwen.named_parameters()}
    for name, shape in mtp_shapes(qwen.config.text_config, shapes).items():
        add(f"{release.s2}vlm.{name}", *shape)(release)
    assert imported(release, tmp_path / "out")["has_mtp"]
    assert load_ponder(tmp_path / "out" / "ponder").mtp


def test_a_padded_state_loses_its_zero_columns(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    weight = release.tensors["zq7.policy.joints.weight"]
    release.tensors["zq7.policy.joints.weight"] = torch.cat([weight, torch.ones(64, 24, dtype=torch.bfloat16)], dim=1)
    facts = imported(release, tmp_path / "out")
    assert any("joints.weight: columns beyond 8" in note for note in facts["notes"])
    bundle = load_bundle(tmp_path / "out" / "pounce")
    assert torch.equal(bundle.model.state_dict()["state_projector.weight"], weight.float())


@pytest.mark.parametrize("bias", ["bridge.bias", "joints.bias"])
def test_a_bias_that_is_not_there_is_zero(make_release: Any, tmp_path: Path, bias: str) -> None:
    release = make_release(age_bias=False)
    drop(bias)(release)
    imported(release, tmp_path / "out")
    name = {"bridge.bias": "cognition_prefix.projector.bias", "joints.bias": "state_projector.bias"}[bias]
    assert not load_bundle(tmp_path / "out" / "pounce").model.state_dict()[name].any()


# -- statistics


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"delta_mask": [True] * 8}, "delta_mask: expected seven true"),
        ({"delta_mask": [False] * 7 + [True]}, "delta_mask: expected seven true"),
        ({"delta_mask": None}, "delta_mask: unknown"),
        ({"clip": 5.0}, r"clip: unknown, came 5\.0"),
        ({"action": {"q01": [0.0] * 8}}, "expected q01 and q99"),
        ({"action": {"q01": [0.0] * 7, "q99": [1.0] * 7}}, r"action\.q01: expected at least 8 dims, came 7"),
        ({"proprio": {"q01": [0.0] * 8}}, r"proprio\.q01: expected one q01"),
        ({"other_mask": [True]}, "one list of booleans"),
    ],
)
def test_statistics_that_do_not_explain_themselves_are_refused(
    make_release: Any, tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    release = make_release()
    release.statistics |= change
    with pytest.raises(FolderError, match=said):
        imported(release, tmp_path / "out")


def test_statistics_may_be_nested_and_padded(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    mask = [True] * 7 + [False] * 25
    action = {"q01": [-0.2] * 32, "q99": [0.3] * 32, "mask": mask}
    release.statistics = {"norm_stats": {"actions": action, "proprio": {"q01": [0.0] * 8, "q99": [1.0] * 8}}}
    facts = imported(release, tmp_path / "out")
    assert any("has 32 dims" in note for note in facts["notes"])
    assert load_bundle(tmp_path / "out" / "pounce").statistics.state.q99 == (1.0,) * 8


# -- the commands


def arguments(release: Any) -> list[str]:
    return [str(release.folder), "--qwen", str(release.qwen), "--pounce-like", str(release.pounce_like)]


def test_the_command_imports_and_says_how_to_serve(
    make_release: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    release = make_release()
    release.write()
    out = ["--out", str(tmp_path / "out"), "--paligemma", str(release.paligemma)]
    assert commands.parity(["import-official", *arguments(release), *out]) == 0
    said = capsys.readouterr().out
    assert "assumed   age" in said
    assert "ponder-serve --checkpoint" in said
    assert commands.parity(["import-official", *arguments(release), *out]) == 2
    assert "exists" in capsys.readouterr().err


@pytest.mark.parametrize("num_bytes_beyond", [0, 1000])
def test_the_beginning_of_the_file_answers_the_unknowns(
    make_release: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], num_bytes_beyond: int
) -> None:
    release = make_release()
    path = release.write() / "model.safetensors"
    with path.open("rb+") as file:
        file.truncate(8 + int.from_bytes(file.read(8), "little") + num_bytes_beyond)
    out = tmp_path / "facts.json"
    assert commands.parity(["official", *arguments(release), "--header-only", "--out", str(out)]) == 0
    facts = json.loads(out.read_text())
    assert facts["U1 config"]["s2"] == {"max_context_tokens": 16384}
    assert facts["U2 statistics"]["file"]["delta_mask"] == [True] * 7 + [False]
    assert facts["U3 tensors"]["dtypes"] == {"BF16": len(release.tensors)}
    assert facts["U4 interface"]["carriers"]["name"] == "zq7.mllm.kk.soft_tokens"
    assert facts["U5 copies"] == "the file ends before its numbers"
    assert "attach it to an issue" in capsys.readouterr().out


def test_faults_are_in_the_report_and_the_rest_is_answered(
    make_release: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    release = make_release()
    add("zq7.policy.router", 5, 7)(release)
    (release.write() / "norm_stats.json").unlink()
    out = tmp_path / "facts.json"
    assert commands.parity(["official", *arguments(release), "--out", str(out)]) == 1
    facts = json.loads(out.read_text())
    assert ["router" in fault for fault in facts["faults"]] == [True]
    assert "norm_stats.json: not there" in facts["U2 statistics"]["error"]
    assert facts["U5 copies"] == {release.s1 + PALIGEMMA_HEAD: True}
    capsys.readouterr()


@pytest.mark.parametrize("content", [b"version https://git-lfs", b"", b"\x05\0\0\0\0\0\0\0{nope", b"\xff" * 40])
def test_a_file_that_is_no_safetensors_file_is_refused(make_release: Any, tmp_path: Path, content: bytes) -> None:
    release = make_release()
    (release.write() / "model.safetensors").write_bytes(content)
    with pytest.raises(FolderError, match=r"model\.safetensors"):
        import_official(release.folder, tmp_path / "out", qwen=release.qwen, paligemma=release.paligemma)


def test_a_file_that_was_cut_short_is_refused(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    path = release.write() / "model.safetensors"
    with path.open("rb+") as file:
        file.truncate(path.stat().st_size - 10)
    with pytest.raises(FolderError, match=r"expected \d+ bytes, as its header says; it is cut short"):
        import_official(release.folder, tmp_path / "out", qwen=release.qwen, paligemma=release.paligemma)


def test_a_header_of_the_real_size_is_explained_and_counts_as_published(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """14B on the hub, about 27 GB on the card: both networks, PaliGemma's embedding twice, the expert's unused head."""
    tables = expected(qwen35_9b().qwen(), pi05_base())
    shapes = {f"m.system2.vlm.{name}": shape for name, shape in tables.ponder_shapes.items()}
    shapes |= {f"m.system1.pi05.{name}": shape for name, shape in tables.pounce_shapes.items()}
    paligemma = "m.system1.pi05.paligemma_with_expert.paligemma."
    shapes[paligemma + "model.language_model.embed_tokens.weight"] = (257_152, 2048)
    shapes["m.system1.pi05.paligemma_with_expert.gemma_expert.lm_head.weight"] = (257_152, 1024)
    shapes |= {"m.system2.carrier": (1, 4096), "m.system1.null_cognition": (1, 4096)}
    shapes |= {"m.system1.cog.weight": (2048, 4096), "m.system1.age.weight": (2048, 256)}
    shapes |= {"m.system1.state.weight": (2048, 8), "m.system1.state.bias": (2048,)}
    header, end = {}, 0
    for name, shape in shapes.items():
        size = 2 * math.prod(shape)
        header[name] = {"dtype": "BF16", "shape": shape, "data_offsets": (end, end + size)}
        end += size
    text = json.dumps(header).encode()
    (tmp_path / "model.safetensors").write_bytes(len(text).to_bytes(8, "little") + text)
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "norm_stats.json").write_text(json.dumps(STATISTICS))
    out = tmp_path / "facts.json"
    assert commands.parity(["official", str(tmp_path), "--header-only", "--out", str(out)]) == 0
    facts = json.loads(out.read_text())
    assert facts["faults"] == []
    assert round(facts["U3 tensors"]["num_parameters"] / 1e9, 2) == 13.56
    assert round(end / 1e9, 1) == 27.1
    capsys.readouterr()


def test_a_file_longer_than_its_header_says_is_refused(make_release: Any, tmp_path: Path) -> None:
    release = make_release()
    with (release.write() / "model.safetensors").open("ab") as file:
        file.write(b"more")
    with pytest.raises(FolderError, match="the header describes"):
        import_official(release.folder, tmp_path / "out", qwen=release.qwen, paligemma=release.paligemma)
