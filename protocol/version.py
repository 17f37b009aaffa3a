"""The distribution's version, and those of what a result depends on."""

from __future__ import annotations

import platform
from importlib import metadata

DISTRIBUTION = "ponderpounce-server"


def version() -> str:
    try:
        return metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:  # a source tree that is not installed
        return "0+source"


def versions() -> dict[str, str]:
    """Versions of the software and the machine, for every log and result."""
    found = {DISTRIBUTION: version(), "python": platform.python_version(), "machine": platform.machine()}
    for name in ("mujoco", "numpy", "eclipse-zenoh", "protobuf", "mcap"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
