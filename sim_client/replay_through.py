"""``pp-replay through``: a log's invocations through another POUNCE, and how its rows differ from those in the log.

The other checkpoint answers what was asked then: the same observation, cognition, age, committed rows and noise, by the
code that serves. What it would have seen had it driven is another question: nothing here moves a robot.
"""

# N rows of a chunk, A dims of a row

from __future__ import annotations

import csv
import importlib
import json
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from protocol import files
from protocol import messages as m
from protocol.command_line import command, parse
from protocol.errors import CommandError
from protocol.mcap_log import EpisodeRecord, read_log, read_pictures

AGREES, DIFFERS = 0, 1

Answer = Callable[[m.Invocation, m.Observation], m.Floats]
"""The rows (N, A) for an invocation and the observation that it names. Raises ValueError if it cannot read them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ThroughConfig:
    """Answers a log's invocations with another POUNCE and compares row by row. Exit code 0: within the tolerance, 1: a
    row is not, 2: it cannot be done."""

    file: tyro.conf.Positional[Path]
    """Episode log (.mcap, or .mcap.partial of a killed process)."""
    pounce: Path | None = None
    """Checkpoint folder of the other POUNCE, as of pounce-serve. None: what a shadow answered while it was recorded."""
    device: str = "cpu"
    """Device of the network: cpu, cuda or cuda:N."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Number format of weights and activations."""
    tolerance: float = 0.0
    """Largest difference of a number in a row, in its own unit: rad, and the gripper's -1 to 1."""
    rows: Path | None = None
    """File (.csv) for every row's differences."""
    json: bool = False
    """Print one JSON object instead of sentences."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Rows of one log and of another POUNCE for the same invocations."""

    chunks: Sequence[m.ActionChunk]
    """Those of the log that the other POUNCE answered as well."""
    others: Sequence[m.Floats]
    """The other's rows (N, A), chunk by chunk."""
    refused: Mapping[int, str]
    """Invocations that it did not answer, and why."""
    model_hash: str
    pixels: str
    """"exact", "jpeg" if a picture is not what the model saw, or "" if it reads none."""

    @property
    def differences(self) -> m.Floats:
        """(chunks, N, A), absolute."""
        pairs = zip(self.chunks, self.others, strict=True)
        return np.stack([np.abs(rows_NA - chunk.rows_NA) for chunk, rows_NA in pairs])


@command("pp-replay through")
def main(argv: list[str] | None = None, prog: str = "pp-replay through") -> int:
    config = parse(ThroughConfig, argv, prog=prog)
    record = read_log(config.file)
    with files.reading(config.file, "log of an episode"):
        compared = _shadow(record, config.file) if config.pounce is None else _through(record, config)
    if not compared.chunks:
        why = next(iter(compared.refused.values()), "the log has no chunk")
        raise CommandError(f"{config.file}: nothing to compare: {why}")
    found = summary(compared, config.tolerance)
    if config.rows is not None:
        _write(config.rows, compared)
    logged = compared.chunks[0].model_hash
    if config.json:
        facts = {"file": str(config.file), "logged": logged, "through": compared.model_hash, "pixels": compared.pixels}
        sys.stdout.write(json.dumps(facts | found) + "\n")
    else:
        sys.stdout.write("\n".join(_sentences(found, compared, logged)) + "\n")
    return AGREES if found["first"] is None else DIFFERS


def summary(compared: Compared, tolerance: float) -> dict[str, object]:
    """How far rows differ: in all, per dimension, and the first number beyond the tolerance, in the order of rows."""
    differences = compared.differences
    rows_RA = differences.reshape(-1, differences.shape[-1])
    beyond = np.argwhere(differences > tolerance)
    first = None
    if len(beyond):
        chunk, row, dim = (int(each) for each in beyond[0])
        logged = compared.chunks[chunk]
        first = {
            "invocation": logged.invocation,
            "tick": logged.t_row0 + row,
            "row": row,
            "dimension": dim,
            "logged": float(logged.rows_NA[row, dim]),
            "came": float(compared.others[chunk][row, dim]),
        }
    return {
        "chunks": len(differences),
        "rows": len(rows_RA),
        "not_answered": len(compared.refused),
        "max": float(rows_RA.max()),
        "p99": _p99(rows_RA.max(axis=1)),
        "max_per_dimension": [float(each) for each in rows_RA.max(axis=0)],
        "p99_per_dimension": [_p99(rows_RA[:, dim]) for dim in range(rows_RA.shape[1])],
        "rows_beyond": int((rows_RA > tolerance).any(axis=1).sum()),
        "first": first,
    }


def _p99(values: m.Floats) -> float:
    return float(np.percentile(values, 99, method="inverted_cdf"))


def _sentences(found: Mapping[str, object], compared: Compared, logged: str) -> Iterator[str]:
    yield f"logged {logged}, through {compared.model_hash}" + (": the same weights" * (logged == compared.model_hash))
    yield f"{found['rows']} rows of {found['chunks']} chunks, {found['rows_beyond']} beyond the tolerance"
    yield f"largest difference {found['max']:.3g}, p99 over rows {found['p99']:.3g}"
    for name in ("max", "p99"):
        numbers = " ".join(f"{each:.3g}" for each in found[f"{name}_per_dimension"])  # type: ignore[attr-defined]
        yield f"{name} per dimension: {numbers}"
    if (first := found["first"]) is not None:
        where = "invocation {invocation}, row {row} (tick {tick}), dimension {dimension}".format_map(first)  # type: ignore[arg-type]
        yield f"first: {where}: {first['logged']:.6g} in the log, {first['came']:.6g} now"  # type: ignore[index]
    if compared.pixels == "jpeg":
        yield "pictures are JPEGs and not what the model saw: record with --pixels exact to compare weights alone"
    for invocation, why in list(compared.refused.items())[:1]:
        yield f"{len(compared.refused)} invocations were not answered, first {invocation}: {why}"


def _through(record: EpisodeRecord, config: ThroughConfig) -> Compared:
    """Raises OSError, ValueError: the folder is no checkpoint, or does not fit."""
    build = importlib.import_module("pounce_server.in_process").build_answerer
    answer, model_hash, num_cameras = build(config.pounce, record.info, device=config.device, dtype=config.dtype)
    invocations = {each.invocation: each for each in record.invocations}
    seen = _Observations(record, config.file if num_cameras else None)
    chunks, others, refused = [], [], {}
    for chunk in sorted(record.chunks, key=lambda each: each.invocation):
        invocation = invocations.get(chunk.invocation)
        observation = None if invocation is None else seen.of(invocation)
        if invocation is None or observation is None:
            refused[chunk.invocation] = f"the log lacks its {'request' if invocation is None else 'observation'}"
            continue
        try:
            rows_NA = answer(invocation, observation)
        except ValueError as error:
            refused[chunk.invocation] = str(error)
            continue
        if rows_NA.shape != chunk.rows_NA.shape:
            raise ValueError(f"its chunks have {chunk.rows_NA.shape} numbers, the other POUNCE gives {rows_NA.shape}")
        chunks.append(chunk)
        others.append(rows_NA)
    pixels = seen.pixels if num_cameras else ""
    return Compared(chunks=chunks, others=others, refused=refused, model_hash=model_hash, pixels=pixels)


def _shadow(record: EpisodeRecord, path: Path) -> Compared:
    shadows = {chunk.invocation: chunk for chunk in record.shadow_chunks}
    if not shadows:
        raise CommandError(f"{path}: no shadow of POUNCE answered in it; name a checkpoint with --pounce")
    both = [chunk for chunk in record.chunks if chunk.invocation in shadows]
    missing = {each.invocation: "the shadow did not" for each in record.chunks if each.invocation not in shadows}
    others = [shadows[chunk.invocation].rows_NA for chunk in both]
    for chunk, rows_NA in zip(both, others, strict=True):
        if chunk.rows_NA.shape != rows_NA.shape:
            raise ValueError(f"its chunks have {chunk.rows_NA.shape} numbers, its shadow's {rows_NA.shape}")
    (model_hash, *_) = {each.model_hash for each in shadows.values()}
    return Compared(chunks=both, others=others, refused=missing, model_hash=model_hash, pixels="")


class _Observations:
    """The observations of a log as POUNCE got them. ``path``: the log, if pictures are wanted."""

    def __init__(self, record: EpisodeRecord, path: Path | None) -> None:
        self._of_tick: dict[int, list[m.Observation]] = {}
        for each in record.observations:
            self._of_tick.setdefault(each.tick, []).append(each)
        self._logged = iter(()) if path is None else read_pictures(path)
        self._wants_pictures = path is not None
        self.pixels = "exact"

    def of(self, invocation: m.Invocation) -> m.Observation | None:
        """The observation that an invocation names; ask in the order of invocations."""
        named = self._of_tick.get(invocation.tick, [])
        if not self._wants_pictures:
            return named[-1] if named else None
        named = [each for each in named if each.images]
        return self._with_pictures(named[-1]) if named else None

    def _with_pictures(self, observation: m.Observation) -> m.Observation:
        missing = [image for image in observation.images if image.codec == m.ImageCodec.ELSEWHERE]
        found: dict[str, m.Image] = {}
        while len(found) < len(missing):
            picture = next(self._logged, None)
            if picture is None:
                raise ValueError(f"it has no pictures of tick {observation.tick}; record with cameras")
            if picture.source_ns != observation.source_ns:
                continue
            (announced,) = (image for image in missing if image.camera == picture.camera)
            if zlib.crc32(picture.data) != announced.crc32:
                self.pixels = "jpeg"
            found[picture.camera] = replace(
                announced, codec=m.ImageCodec[picture.format.upper()], data=picture.data, crc32=zlib.crc32(picture.data)
            )
        return replace(observation, images=tuple(found.get(image.camera, image) for image in observation.images))


def _write(path: Path, compared: Compared) -> None:
    with files.writing(path), path.open("w", newline="") as file:
        writer = csv.writer(file)
        dims = range(compared.others[0].shape[1])
        writer.writerow(
            ["invocation", "tick", "row", *(f"logged_{dim}" for dim in dims), *(f"came_{dim}" for dim in dims)]
        )
        for chunk, rows_NA in zip(compared.chunks, compared.others, strict=True):
            for row, (logged_A, came_A) in enumerate(zip(chunk.rows_NA, rows_NA, strict=True)):
                writer.writerow([chunk.invocation, chunk.t_row0 + row, row, *map(float, logged_A), *map(float, came_A)])


if __name__ == "__main__":
    sys.exit(main())
