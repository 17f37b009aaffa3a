"""``pp-parity official``: what an official folder holds, as a file that can be attached to an issue.

It answers five unknowns of docs/official.md: config fields (U1), statistics (U2), tensors (U3), the cognition interface
(U4) and whether the two PaliGemma embeddings are equal (U5). No number of a weight is in the file.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from transformers.models.qwen3_5 import Qwen3_5Config

from dual_system.models.official.header import (
    CONFIG_FILE,
    STATISTICS_FILE,
    WEIGHTS_FILE,
    Header,
    read_header,
)
from dual_system.models.official.import_folder import sizes_like
from dual_system.models.official.plan import (
    Plan,
    compare_copies,
    expected,
    make_plan,
    read_config,
)
from dual_system.models.official.statistics import read_statistics
from dual_system.models.ponder.configs import qwen35_9b
from dual_system.models.pounce.configs import pi05_base
from protocol.command_line import command, parse

EXPLAINED, UNEXPLAINED = 0, 1
COMPARED_BYTES = 2**20


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectOptions:
    """Says what an official PonderPounce folder holds. Exit code 0: all explained, 1: not, 2: unreadable."""

    folder: tyro.conf.Positional[Path]
    """Official folder. The first MB of model.safetensors is enough: its header."""
    header_only: bool = False
    """Compare the first MB of matrices that are stored twice, and not all of them."""
    out: Path = Path("official_header.json")
    """File to write."""
    qwen: Path | None = None
    """Folder with a Qwen3.5 config.json of the sizes to expect. None: Qwen3.5-9B."""
    pounce_like: Path | None = None
    """POUNCE folder of ours whose pi0.5 has the sizes to expect. None: the public pi0.5."""


def inspect(options: InspectOptions) -> dict[str, Any]:
    """Contents of the file. What cannot be read is said under its unknown, and the others are answered nevertheless.

    Raises:
        FileNotFoundError, FolderError: there are no weights to read the header of.
    """
    header = read_header(options.folder / WEIGHTS_FILE)
    config = _or_error(lambda: read_config(options.folder / CONFIG_FILE))
    qwen = (
        qwen35_9b().qwen() if options.qwen is None else Qwen3_5Config.from_dict(read_config(options.qwen / CONFIG_FILE))
    )
    tables = expected(qwen, pi05_base() if options.pounce_like is None else sizes_like(options.pounce_like))
    plan = make_plan(header, {} if "error" in config else config, tables)
    if header.has_numbers:
        compare_copies(plan, tables, COMPARED_BYTES if options.header_only else None)
    return {
        "format": "ponderpounce.official-header/1",
        "U1 config": config,
        "U2 statistics": _or_error(lambda: _statistics(options.folder / STATISTICS_FILE)),
        "U3 tensors": _tensors(header, plan),
        "U4 interface": {
            role: {"name": each.name, "dtype": each.dtype, "shape": each.shape}
            for role, each in sorted(plan.leftovers.roles.items())
        },
        "U5 copies": plan.copies if header.has_numbers else "the file ends before its numbers",
        "faults": plan.faults,
    }


def _statistics(path: Path) -> dict[str, Any]:
    raw = json.loads(path.read_text()) if path.is_file() else None
    read = _or_error(
        lambda: {"read": asdict(r.statistics) | {"notes": r.notes} if (r := read_statistics(path)) else {}}
    )
    return {"file": raw} | read


def _tensors(header: Header, plan: Plan) -> dict[str, Any]:
    tensors = header.tensors.values()
    return {
        "header_sha256": header.sha256,
        "num_tensors": len(tensors),
        "num_parameters": sum(each.num_elements for each in tensors),
        "dtypes": dict(Counter(each.dtype for each in tensors)),
        "prefixes": {"ponder": plan.ponder.prefixes, "pounce": plan.pounce.prefixes},
        "has_mtp": any(name.startswith("mtp.") for name in plan.ponder.found),
        "not_read": plan.leftovers.others,
        "names": {each.name: f"{each.dtype} {list(each.shape)}" for each in tensors},
    }


def _or_error(make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    try:
        return make()
    except (OSError, ValueError) as error:
        return {"error": str(error)}


@command("pp-parity official")
def main(argv: list[str] | None = None, prog: str = "pp-parity official") -> int:
    options = parse(InspectOptions, argv, prog=prog)
    facts = inspect(options)
    options.out.write_text(json.dumps(facts, indent=1) + "\n")
    tensors, faults = facts["U3 tensors"], list(facts["faults"])
    faults += [facts[key]["error"] for key in ("U1 config", "U2 statistics") if "error" in facts[key]]
    lines = [
        f"U1 config      {', '.join(facts['U1 config'])}",
        f"U2 statistics  {'read' if 'error' not in facts['U2 statistics'] else 'not understood'}",
        f"U3 tensors     {tensors['num_tensors']}, {tensors['num_parameters']:,} numbers, {tensors['dtypes']}, "
        f"{'with' if tensors['has_mtp'] else 'without'} multi-token prediction",
        *(f"U4 {role:<11} {each['name']} {list(each['shape'])}" for role, each in facts["U4 interface"].items()),
        f"U5 copies      {facts['U5 copies'] or 'none'}",
        *(f"fault          {fault}" for fault in faults),
        f"written        {options.out}: attach it to an issue",
    ]
    sys.stdout.write("\n".join(lines) + "\n")
    return UNEXPLAINED if faults else EXPLAINED
