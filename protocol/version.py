"""The distribution's version."""

from __future__ import annotations

from importlib import metadata

DISTRIBUTION = "ponderpounce-server"


def version() -> str:
    try:
        return metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:  # a source tree that is not installed
        return "0+source"
