"""``pp-replay through``: a log's invocations through another POUNCE, and how its rows differ from those in the log.

The other one answers what was asked then: the same observations, cognition, age, committed rows and noise, by the code
that serves. What it would have seen had it driven is another question: nothing here moves a robot.
"""

# N rows of a chunk, A dims of a row

from __future__ import annotations

import csv
import importlib
import json
import sys
import zlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from dual_system.models.ponder.demo_sampling import DemoSampling
from protocol import files
from protocol import messages as m
from protocol.command_line import command, parse
from protocol.errors import CommandError
from protocol.mcap_log import EpisodeRecord, Picture, read_log, read_pictures

AGREES, DIFFERS = 0, 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ThroughConfig:
    """Answers a log's invocations with another POUNCE and compares row by row. Exit code 0: within the tolerance, 1: a
    row is not, 2: it cannot be done."""

    file: tyro.conf.Positional[Path]
    """Episode log (.mcap, or .mcap.partial of a killed process)."""
    pounce: Path | None = None
    """Checkpoint folder of the other POUNCE, as of pounce-serve. None, without --backend: what a shadow answered while
    it was recorded."""
    backend: Literal["own", "openpi", "vla-eval", "groot", "groot-n1.5", "lerobot"] = "own"
    """As of pounce-serve: the others ask a policy server, whose noise is its own."""
    url: str | None = None
    """Address of the policy server, as of pounce-serve."""
    mapping: Path | None = None
    """The policy server's mapping file, as of pounce-serve."""
    key_file: Path | None = None
    """File with the word that the policy server wants, as of pounce-serve."""
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
    padded_otherwise: int = 0
    """Chunks whose window had other instants padded than the other's: something was lost on one way, or came late."""

    @property
    def differences(self) -> m.Floats:
        """(chunks, N, A), absolute."""
        pairs = zip(self.chunks, self.others, strict=True)
        return np.stack([np.abs(rows_NA - chunk.rows_NA) for chunk, rows_NA in pairs])


@command("pp-replay through")
def main(argv: list[str] | None = None, prog: str = "pp-replay through") -> int:
    config = parse(ThroughConfig, argv, prog=prog)
    if config.rows is not None:
        files.make_way(config.rows)
    record = read_log(config.file)
    with files.reading(config.file, "log of an episode"):
        has_other = config.pounce is not None or config.backend != "own"
        compared = _through(record, config) if has_other else _shadow(record, config.file)
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
        "padded_otherwise": compared.padded_otherwise,
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
    if compared.padded_otherwise:
        yield f"{compared.padded_otherwise} windows were padded otherwise: that is no difference of weights"
    for invocation, why in list(compared.refused.items())[:1]:
        yield f"{len(compared.refused)} invocations were not answered, first {invocation}: {why}"


def _through(record: EpisodeRecord, config: ThroughConfig) -> Compared:
    """Raises OSError, ValueError: there is no such POUNCE, or it does not fit."""
    server = importlib.import_module("pounce_server.in_process")
    remote = server.RemoteOptions(url=config.url, mapping=config.mapping, key_file=config.key_file)
    other = server.build_answerer(
        record.info,
        config.pounce,
        remote,
        partial(_demonstration, record.info),
        backend=config.backend,
        device=config.device,
        dtype=config.dtype,
    )
    invocations = {each.invocation: each for each in record.invocations}
    seen = _Observations(record, config.file if other.spec.num_cameras else None)
    chunks, others, refused = [], [], {}
    for chunk in sorted(record.chunks, key=lambda each: each.invocation):
        invocation = invocations.get(chunk.invocation)
        if invocation is None:
            refused[chunk.invocation] = "the log lacks its request"
            continue
        try:
            answer = other.answer(invocation, seen.until(invocation.tick))
        except ValueError as error:
            refused[chunk.invocation] = str(error)
            continue
        chunks.append(chunk)
        others.append(answer)
    pixels = seen.pixels if other.spec.num_cameras else ""
    return _compared(chunks, others, refused, other.spec.model_hash, pixels)


def _demonstration(info: m.EpisodeInfo, sampling: DemoSampling) -> Sequence[m.DemoFrame]:
    """The episode's demonstration, which no log holds: rendered again, from the seed of its scene.

    Raises ValueError if there is no such scene here.
    """
    if not info.robot.is_simulated:
        raise ValueError("its memory reads the demonstration, which a log of a real robot does not hold")
    tasks, robot = importlib.import_module("dual_system.tasks.environment"), importlib.import_module("sim_client.robot")
    with tasks.make_environment(info.task, render=True) as environment:
        environment.reset(info.seed, info.difficulty)
        frames: Sequence[m.DemoFrame] = robot.demonstration(environment, m.ImageCodec.RAW, sampling)
    return frames


def _shadow(record: EpisodeRecord, path: Path) -> Compared:
    shadows = {chunk.invocation: chunk for chunk in record.shadow_chunks}
    if not shadows:
        raise CommandError(f"{path}: no shadow of POUNCE answered in it; name a checkpoint with --pounce")
    both = [chunk for chunk in record.chunks if chunk.invocation in shadows]
    missing = {each.invocation: "the shadow did not" for each in record.chunks if each.invocation not in shadows}
    (model_hash, *_) = {each.model_hash for each in shadows.values()}
    return _compared(both, [shadows[chunk.invocation] for chunk in both], missing, model_hash, "")


def _compared(
    chunks: Sequence[m.ActionChunk],
    others: Sequence[m.ActionChunk],
    refused: Mapping[int, str],
    model_hash: str,
    pixels: str,
) -> Compared:
    """Raises ValueError if the other's chunks have another shape."""
    padded_otherwise = 0
    for chunk, other in zip(chunks, others, strict=True):
        if chunk.rows_NA.shape != other.rows_NA.shape:
            raise ValueError(
                f"its chunks have {chunk.rows_NA.shape} numbers, the other POUNCE gives {other.rows_NA.shape}"
            )
        ours, theirs = ((each.padded_video_ticks, each.padded_state_ticks) for each in (chunk, other))
        padded_otherwise += ours != theirs
    return Compared(
        chunks=chunks,
        others=[other.rows_NA for other in others],
        refused=refused,
        model_hash=model_hash,
        pixels=pixels,
        padded_otherwise=padded_otherwise,
    )


class _Observations:
    """The observations of a log as POUNCE got them. ``path``: the log, if pictures are wanted."""

    def __init__(self, record: EpisodeRecord, path: Path | None) -> None:
        self._left = deque(sorted(record.observations, key=lambda each: each.tick))  # of one tick as they were logged
        self._logged = iter(()) if path is None else read_pictures(path)
        self._ahead: Picture | None = None
        self.pixels = "exact"

    def until(self, tick: int) -> Iterator[m.Observation]:
        """Those up to a tick that were not given before; ask in the order of invocations."""
        while self._left and self._left[0].tick <= tick:
            yield self._with_pictures(self._left.popleft())

    def _with_pictures(self, observation: m.Observation) -> m.Observation:
        """With its pictures from the cameras' channels, where they were logged there; without any if one is lost."""
        missing = {image.camera: image for image in observation.images if image.codec == m.ImageCodec.ELSEWHERE}
        found: dict[str, m.Image] = {}
        for picture in self._pictures_of(observation.source_ns):
            announced = missing.get(picture.camera)
            if announced is None:
                continue
            if zlib.crc32(picture.data) != announced.crc32:
                self.pixels = "jpeg"
            found[picture.camera] = replace(
                announced, codec=m.ImageCodec[picture.format.upper()], data=picture.data, crc32=zlib.crc32(picture.data)
            )
        if found.keys() != missing.keys():
            return replace(observation, images=())
        return replace(observation, images=tuple(found.get(image.camera, image) for image in observation.images))

    def _pictures_of(self, source_ns: int) -> Iterator[Picture]:
        """The log's next pictures up to those of an instant, and these alone are given."""
        while (picture := self._ahead or next(self._logged, None)) is not None:
            self._ahead = picture if picture.source_ns > source_ns else None
            if self._ahead is not None:
                return
            if picture.source_ns == source_ns:
                yield picture


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
