"""Which program this is: the distribution's version."""

from __future__ import annotations

from importlib import metadata

DISTRIBUTION = "ponderpounce-server"


def version() -> str:
    try:
        return metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:  # run from a source tree that was never installed
        return "0+source"
