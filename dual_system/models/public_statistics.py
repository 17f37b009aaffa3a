"""Normalisation statistics that a public folder brings beside its weights: read, or refused with the way out.

openpi's ``norm_stats.json`` has quantiles of one robot and is read. lerobot's processors and NVIDIA's metadata have
other normalisations, of action spaces that they do not name: refused, because other statistics are another policy.
"""

from pathlib import Path
from typing import Any

from dual_system.models.config_json import is_finite
from dual_system.models.normalisation import ROBOMME, Quantiles, RobotStatistics
from protocol.files import read_object

OPENPI_NAME = "norm_stats.json"
_OPENPI_GLOB = f"assets/**/{OPENPI_NAME}"  # assets/ID, where an ID may have slashes
_OTHERS = ("*normalizer_processor.safetensors", "experiment_cfg/metadata.json")
_NUM_DIMS = ROBOMME.action.num_dims
_DELTA_MASK = [True] * (_NUM_DIMS - 1) + [False]  # joints relative to the current state, gripper absolute


def statistics_files(folder: Path) -> list[Path]:
    """Files of a public folder that hold normalisation statistics; its own ``norm_stats.json`` overrules the others."""
    if (folder / OPENPI_NAME).exists():
        return [folder / OPENPI_NAME]
    return [path for pattern in (_OPENPI_GLOB, *_OTHERS) for path in sorted(folder.glob(pattern))]


def read_statistics(folder: Path) -> RobotStatistics | None:
    """The statistics that a public folder brings, in RoboMME's space (`joint_delta`); None if it brings none.

    Raises:
        ValueError: there are several, of another form, of another robot, or broken; the message says the way out.
    """
    found = statistics_files(folder)
    if not found:
        return None
    way_out = f"put those of this robot, in openpi's form, into {folder / OPENPI_NAME}, or measure them with pp-train"
    if len(found) > 1:
        names = ", ".join(str(path.relative_to(folder)) for path in found[:5])
        raise ValueError(f"{folder} brings {len(found)} files of normalisation statistics ({names}); {way_out}")
    (path,) = found
    if path.name != OPENPI_NAME:
        raise ValueError(f"{path} has normalisation statistics of an action space that it does not name; {way_out}")
    values = read_object(path)
    tables = values.get("norm_stats", values)
    if not isinstance(tables, dict):
        raise ValueError(f"{path}: expected norm_stats to be an object, came {tables!r}; {way_out}")
    for name, mask in (*values.items(), *tables.items()):
        if "mask" in name and mask != _DELTA_MASK:
            raise ValueError(f"{path}: {name} is {mask}, expected {_DELTA_MASK}: joint deltas and a gripper; {way_out}")
    try:
        return RobotStatistics(state=_quantiles(tables, "state"), action=_quantiles(tables, "actions"))
    except ValueError as error:
        raise ValueError(f"{path}: {error}; {way_out}") from None


def _quantiles(tables: dict[str, Any], name: str) -> Quantiles:
    table = tables.get(name)
    low, high = (_row(table.get(key) if isinstance(table, dict) else None, f"{name}.{key}") for key in ("q01", "q99"))
    return Quantiles(q01=low, q99=high)


def _row(values: Any, where: str) -> tuple[float, ...]:
    is_row = isinstance(values, list) and all(isinstance(each, int | float) and is_finite(each) for each in values)
    if not is_row or len(values) < _NUM_DIMS or any(values[_NUM_DIMS:]):  # openpi may pad with zeros
        raise ValueError(f"{where}: expected {_NUM_DIMS} finite numbers, came {str(values)[:80]}")
    return tuple(map(float, values[:_NUM_DIMS]))
