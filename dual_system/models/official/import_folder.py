"""``pp-parity import-official``: the official folder as a PONDER and a POUNCE folder that our servers open.

    ponder/      Qwen3.5's layout; the carriers are rows of the embedding, the conventions are in ponder.json
    pounce/      pi0.5's public names with the cognition interface beside them; conventions, statistics in config.json
    import.json  every decision: prefixes, roles, what is not read, what is assumed

The tokenizers are not in the official folder: they come from a Qwen3.5 folder and PaliGemma's SentencePiece file.
Facts and their grades: docs/official.md.
"""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from transformers.models.qwen3_5 import Qwen3_5Config

from dual_system.models.action_space import ROBOT_DIM
from dual_system.models.config_json import from_json
from dual_system.models.official.halves import PONDER_EMBEDDING, refuse
from dual_system.models.official.header import (
    CONFIG_FILE,
    ITEM_BYTES,
    STATISTICS_FILE,
    WEIGHTS_FILE,
    FolderError,
    read_header,
)
from dual_system.models.official.leftovers import ASK
from dual_system.models.official.plan import (
    ASSUMPTIONS,
    Expected,
    Plan,
    compare_copies,
    expected,
    make_plan,
    ponder_json,
    pounce_config,
    read_config,
    read_roles,
)
from dual_system.models.official.statistics import ReadStatistics, read_statistics
from dual_system.models.official.writing import Entry, raw, read, write
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.pi05.prompt import Tokenizer
from dual_system.models.ponder.checkpoint import OWN_NAME
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.pounce.checkpoint import TOKENIZER_FILE, StoredConfig
from dual_system.models.pounce.configs import pi05_base
from dual_system.models.public_layout import COGNITION
from protocol.command_line import command, parse

IMPORT_FILE = "import.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportOptions:
    """Imports the official PonderPounce folder. Refuses by name what it cannot explain; memory stays below 1 GB."""

    folder: tyro.conf.Positional[Path]
    """Official folder: config.json, model.safetensors, norm_stats.json."""
    out: Path
    """Folder to write; it must not exist yet."""
    qwen: Path
    """Folder with config.json and tokenizer.json of Qwen/Qwen3.5-9B; its weights are not needed."""
    paligemma: Path
    """PaliGemma's SentencePiece file, tokenizer.model."""
    pounce_like: Path | None = None
    """POUNCE folder of ours whose pi0.5 has the sizes to expect. None: the public pi0.5."""
    roles: tuple[str, ...] = ()
    """Pairs ROLE=NAME for tensors that shapes do not tell apart, e.g. age=system1.age.weight. Roles: carriers, null,
    projector, age, state."""


def import_official(
    folder: Path,
    out: Path,
    *,
    qwen: Path,
    paligemma: Path,
    pounce: PounceConfig | None = None,
    roles: Sequence[str] = (),
) -> dict[str, Any]:
    """Writes ``out`` and returns the contents of import.json.

    Args:
        pounce: sizes of pi0.5; None: the public ones.
        roles: ROLE=NAME for tensors that shapes do not tell apart.

    Nothing is left behind if it is refused or interrupted.

    Raises:
        FileNotFoundError: a file is missing.
        FileExistsError: ``out`` exists.
        FolderError: the folder, its statistics or its config do not explain themselves; every fault by name.
    """
    if out.exists():
        raise FileExistsError(f"{out} exists; name a folder that does not.")
    header = read_header(folder / WEIGHTS_FILE)
    if not header.has_numbers:
        raise FolderError(
            f"{header.path}: expected {header.num_bytes} bytes, as its header says; it is cut short. Fetch the whole "
            "file; a beginning is enough for `pp-parity official` only."
        )
    config, statistics = read_config(folder / CONFIG_FILE), read_statistics(folder / STATISTICS_FILE)
    vocabulary, tokenizer = Vocabulary.load(qwen), Tokenizer.from_file(paligemma)
    tables = expected(Qwen3_5Config.from_dict(read_config(qwen / CONFIG_FILE)), pounce or pi05_base())
    plan = make_plan(header, config, tables, read_roles(roles))
    if not plan.faults:
        compare_copies(plan, tables)
        last = vocabulary.num_tokens + plan.num_carriers
        if last > tables.qwen.text_config.vocab_size:
            plan.faults.append(
                f"{plan.num_carriers} carriers do not fit behind the tokenizer's {vocabulary.num_tokens}"
            )
    refuse(str(header.path), plan.faults, ASK)
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        _write_ponder(partial / "ponder", plan, tables, qwen, vocabulary)
        _write_pounce(partial / "pounce", plan, tables, statistics, tokenizer)
        facts = _facts(plan, config, statistics)
        (partial / IMPORT_FILE).write_text(json.dumps(facts, indent=1) + "\n")
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return facts


def sizes_like(folder: Path) -> PounceConfig:
    """The configuration of a POUNCE folder of ours. Raises ValueError if it is none, or not pi0.5."""
    path = folder / CONFIG_FILE
    return from_json(StoredConfig, read_config(path), str(path)).config


def _write_ponder(folder: Path, plan: Plan, tables: Expected, qwen: Path, vocabulary: Vocabulary) -> None:
    folder.mkdir()
    shutil.copyfile(qwen / CONFIG_FILE, folder / CONFIG_FILE)
    vocabulary.save(folder)
    stored = ponder_json(plan, vocabulary.num_tokens)
    (folder / OWN_NAME).write_text(json.dumps(asdict(stored), indent=2) + "\n")
    path, found = plan.header.path, plan.ponder.found
    carriers = read(path, plan.leftovers.roles["carriers"])
    entries = []
    for name, tensor in found.items():
        if name in tables.ponder_shapes or name in tables.mtp_shapes:  # not a tied head, which is a copy
            entries.append(Entry(name, tensor.dtype, tensor.shape, tensor))
        if name == PONDER_EMBEDDING:
            row_bytes = tensor.shape[1] * ITEM_BYTES[tensor.dtype]
            patch = raw(carriers, tensor.dtype)
            entries[-1] = Entry(
                name, tensor.dtype, tensor.shape, tensor, patch, patch_at=vocabulary.num_tokens * row_bytes
            )
    write(folder / WEIGHTS_FILE, path, entries)


def _write_pounce(folder: Path, plan: Plan, tables: Expected, statistics: ReadStatistics, tokenizer: Tokenizer) -> None:
    folder.mkdir()
    config = pounce_config(plan, tables)
    stored = StoredConfig(is_random=False, has_fresh_prefix=False, config=config, statistics=statistics.statistics)
    (folder / CONFIG_FILE).write_text(json.dumps(asdict(stored), indent=1) + "\n")
    (folder / TOKENIZER_FILE).write_bytes(tokenizer.model_bytes)
    path, roles = plan.header.path, plan.leftovers.roles
    width, carrier = tables.sizes.language, tables.sizes.carrier
    entries = [Entry(name, tensor.dtype, tensor.shape, tensor) for name, tensor in plan.pounce.found.items()]
    for ours, role, shape in (
        (COGNITION + "null_cognition", "null", (plan.num_carriers, carrier)),
        (COGNITION + "projector.weight", "projector", (width, carrier)),
        (COGNITION + "projector.bias", "projector_bias", (width,)),
        (COGNITION + "age_projection.weight", "age", (width, config.cognition.age_features)),
        (COGNITION + "age_projection.bias", "age_bias", (width,)),
        ("state_proj.bias", "state_bias", (width,)),
    ):
        if role in roles:
            tensor = roles[role]
            entries.append(Entry(ours, tensor.dtype, shape, tensor))
        elif role in ("projector_bias", "state_bias"):  # ours has one
            entries.append(Entry(ours, "F32", shape, raw(torch.zeros(shape), "F32")))
    state = roles["state"]  # a padded state is zero beyond the robot's dims
    columns = read(path, state)[..., :ROBOT_DIM].reshape(width, ROBOT_DIM)
    entries.append(Entry("state_proj.weight", state.dtype, (width, ROBOT_DIM), raw(columns, state.dtype)))
    write(folder / WEIGHTS_FILE, path, entries)


def _facts(plan: Plan, config: dict[str, Any], statistics: ReadStatistics) -> dict[str, Any]:
    roles = plan.leftovers.roles
    notes = [*statistics.notes]
    notes += [f"{name} differs from the embedding that is read" for name, same in plan.copies.items() if not same]
    notes += [f"no {role}: zeros" for role in ("projector_bias", "state_bias") if role not in roles]
    if roles["state"].shape[-1] > ROBOT_DIM:
        notes.append(f"{roles['state'].name}: columns beyond {ROBOT_DIM} multiply a padded state's zeros; dropped")
    return {
        "format": "ponderpounce.import/1",
        "header_sha256": plan.header.sha256,
        "num_tensors": len(plan.header.tensors),
        "num_parameters": sum(tensor.num_elements for tensor in plan.header.tensors.values()),
        "prefixes": {"ponder": plan.ponder.prefixes, "pounce": plan.pounce.prefixes},
        "roles": {
            role: {"name": each.name, "dtype": each.dtype, "shape": each.shape} for role, each in sorted(roles.items())
        },
        "not_read": plan.leftovers.others,
        "copies_equal": plan.copies,
        "has_mtp": any(name.startswith("mtp.") for name in plan.ponder.found),
        "notes": notes,
        "assumptions": ASSUMPTIONS,
        "config": config,
    }


@command("pp-parity import-official")
def main(argv: list[str] | None = None, prog: str = "pp-parity import-official") -> int:
    options = parse(ImportOptions, argv, prog=prog)
    pounce = None if options.pounce_like is None else sizes_like(options.pounce_like)
    facts = import_official(
        options.folder,
        options.out,
        qwen=options.qwen,
        paligemma=options.paligemma,
        pounce=pounce,
        roles=options.roles,
    )
    for note in facts["notes"]:
        sys.stdout.write(f"note      {note}\n")
    for what, how in facts["assumptions"].items():
        sys.stdout.write(f"assumed   {what}: {how}\n")
    ponder_folder, pounce_folder = (shlex.quote(str(options.out / name)) for name in ("ponder", "pounce"))
    sys.stdout.write(
        f"imported  {facts['num_tensors']} tensors, {facts['num_parameters']:,} numbers -> {options.out}\n"
        f"serve     ponder-serve --checkpoint {ponder_folder}\n"
        f"          pounce-serve --checkpoint {pounce_folder}\n"
        "before    a robot moves: compare with the official code, `pp-parity answers`; see docs/official.md\n"
    )
    return 0
