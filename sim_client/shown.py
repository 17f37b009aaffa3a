"""How demonstrations are shown: as the PONDER that is served has learned from them, unless one is told otherwise."""

from __future__ import annotations

from pathlib import Path

from dual_system.models.ponder.showing import Showing, declared
from protocol.errors import TransportError


def how_shown(demo_hz: int | None, video_end: bool, ponder_checkpoint: Path | None) -> Showing:
    """What ``--demo-hz``, ``--video-end`` and the checkpoint say together.

    Raises TransportError, with the folder, if the checkpoint says nothing that can be read.
    """
    try:
        said = declared(ponder_checkpoint)
    except ValueError as error:
        raise TransportError(f"--ponder-checkpoint {ponder_checkpoint}: {error}") from None
    return Showing(hz=said.hz if demo_hz is None else demo_hz, to_its_end=video_end or said.to_its_end)
