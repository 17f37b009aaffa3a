"""A robot's own program under PonderPounce: send an observation, get this tick's command, its level and its deadline.

This package has no code in common with the server, so that a robot's computer needs Python 3.8, numpy, msgpack and
websockets, and nothing else.
"""

from __future__ import annotations

from ponderpounce_client.client import Client, Command, Lost, Observation, Refused
from ponderpounce_client.program import Robot, Settings, drive, main
from ponderpounce_client.watchdog import Watchdog, leave_holding

__all__ = [
    "Client", "Command", "Lost", "Observation", "Refused", "Robot", "Settings", "Watchdog", "drive", "leave_holding",
    "main",
]  # fmt: skip
