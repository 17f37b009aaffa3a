"""A borrowed GPU's day: what is right, then how fast, how many robots, how fast it trains; one JSON at the end of it.

    python -m benchmarks.gpu_day --stage all --seconds 570          # on the GPU; the next call does what is left
    python -m benchmarks.gpu_day --stage all --device cpu --size tiny

A stage has a budget and starts only if that much time is left. Its file is written after every row, so a call that is
killed leaves what it measured; a stage that ended is not run again without ``--again``. A row that fails says why and
ends nothing. Predictions are in the file before the first stage runs. Nothing is needed but torch, transformers, numpy
and, for the fused path, Triton: a GPU's image may lack the rest.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.gpu_stages import PREDICTED_MS, STAGES, Day
from dual_system.models.gpu import current, settle


@dataclass(frozen=True, slots=True, kw_only=True)
class DayOptions:
    """One call. A command line without tyro, which a GPU's image lacks, so the help texts are ``main``'s."""

    stage: str = "all"
    device: str = "cuda"
    size: str = "full"
    seconds: float = 570.0
    out: Path = Path("out/gpu_day")
    again: bool = False


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="gpu-day", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.set_defaults(**asdict(DayOptions()))
    parser.add_argument("--stage", help=f"all, or some of {','.join(STAGES)}")
    parser.add_argument("--device", help="cuda, cuda:N or cpu")
    parser.add_argument("--size", choices=("full", "tiny"), help="networks; tiny is for a CPU")
    parser.add_argument("--seconds", type=float, help="time of this call [s]")
    parser.add_argument("--out", type=Path, help="folder of the stages' files and the JSON")
    parser.add_argument("--again", action="store_true", help="run stages again that ended before")
    options = DayOptions(**vars(parser.parse_args(argv)))
    names = list(STAGES) if options.stage == "all" else options.stage.split(",")
    if unknown := set(names) - set(STAGES):
        parser.error(f"--stage {','.join(sorted(unknown))}: expected all, or some of {','.join(STAGES)}")
    return run(options, names)


def run(options: DayOptions, names: list[str]) -> int:
    """Runs stages that have not ended; returns 1 if a row failed or a stage had no time, else 0."""
    device, size, out = torch.device(options.device), options.size, options.out
    settle(device)
    out.mkdir(parents=True, exist_ok=True)
    report = out / "gpu_day.json"
    end_s = time.monotonic() + options.seconds
    _gather(report, device, size)
    for name in names:
        path, left_s = out / f"{name}.json", end_s - time.monotonic()
        if not options.again and _has_ended(path, device, size):
            print(f"{name}: ended before; --again runs it again")
            continue
        if device.type == "cuda" and left_s < STAGES[name].budget_s:
            print(f"{name}: {left_s:.0f} s are left of --seconds, it may take {STAGES[name].budget_s}; the next call")
            continue
        print(f"{name}: {(STAGES[name].run.__doc__ or '').splitlines()[0]}", flush=True)
        day = Day(device, size, path)
        with torch.inference_mode(), current(device):
            try:
                STAGES[name].run(day)
            except Exception as error:  # what a stage builds for all of its rows
                day.fail("stage", error)
            finally:
                day.write()
                _gather(report, device, size)
        day.write(is_over=True)
        if device.type == "cuda":
            gc.collect()
            torch.cuda.empty_cache()
        _gather(report, device, size)
    stages = json.loads(report.read_text())["stages"]
    failed = [
        f"{stage}: {name}"
        for stage, found in stages.items()
        for name, row in found["rows"].items()
        if isinstance(row, dict) and "FAILED" in row
    ]
    lacking = [name for name in names if not _has_ended(out / f"{name}.json", device, size)]
    print(f"written: {report.name}. Failed: {failed or 'nothing'}. Without time: {lacking or 'none'}")
    return int(bool(failed or lacking))


def _has_ended(path: Path, device: torch.device, size: str) -> bool:
    """Whether this stage ended, of this size and on this kind of device."""
    stage = json.loads(path.read_text()) if path.exists() else {}
    return bool(stage.get("is_over")) and stage["of"] == f"{size} on {device.type}"


def _gather(report: Path, device: torch.device, size: str) -> None:
    """Writes the day's one JSON from the stages' files."""
    found = {name: path for name in STAGES if (path := report.parent / f"{name}.json").exists()}
    day = {
        "name": "gpu_day",
        "question": "What is right, how fast, for how many robots, and how fast does it train, on a GPU?",
        "device": str(device),
        "size": size,
        "predicted_p50_ms": PREDICTED_MS,
        "stages": {name: json.loads(path.read_text()) for name, path in found.items()},
    }
    report.write_text(json.dumps(day, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
