"""The players of an episode by the name in ``EpisodeInfo.policy``."""

from __future__ import annotations

from typing import Literal

PonderChoice = Literal["serve", "none"]

SERVERS = ("ponder", "pounce")
ALONE = "pounce"
"""The policy of an episode without a PONDER: POUNCE reads null, and is invoked from the first observation on."""


def servers_of(policy: str) -> tuple[str, ...]:
    """The model servers that play: both, POUNCE alone, or none (the oracle)."""
    return {"servers": SERVERS, ALONE: ("pounce",)}.get(policy, ())


def has_ponder(policy: str) -> bool:
    """Whether there is somebody to query."""
    return "ponder" in servers_of(policy)


def policy_of(ponder: PonderChoice) -> str:
    """The policy of an episode that model servers play."""
    return ALONE if ponder == "none" else "servers"
