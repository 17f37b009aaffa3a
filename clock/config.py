"""Options of ``clock-serve``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from clock.policies import PonderChoice, policy_of, servers_of
from clock.residual import DEFAULT_LOADER, load_head
from clock.service import ServiceConfig
from protocol.options import DaemonOptions, LinkOptions
from protocol.sockets import endpoint


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockOptions:
    """The clock service as its own process: opens episodes, issues every instant, plays rows at 20 Hz."""

    link: LinkOptions = field(
        default_factory=lambda: LinkOptions(
            listen=(endpoint("clock"),), connect=(endpoint("ponder"), endpoint("pounce"))
        )
    )
    ponder: PonderChoice = "serve"
    """Whether this clock is ready (/readyz) only with a PONDER. An episode says itself whether it has one."""
    allow_starved: bool = False
    """Start although the schedule leaves ticks without a row (see docs/clock.md)."""
    max_clock_bound_ms: float = 5.0
    """Refuse to start if the offset to another host's clock is less certain than this [ms]."""
    residual_head: Path | None = None
    """File of a residual head that corrects every row at 20 Hz (see docs/clock.md)."""
    residual_loader: str = DEFAULT_LOADER
    """Loader of --residual-head, as package.module:callable."""

    operations: tyro.conf.OmitArgPrefixes[DaemonOptions] = field(default_factory=DaemonOptions)

    def service(self) -> ServiceConfig:
        """Loads the residual head. Raises ValueError or OSError if that fails."""
        head = None if self.residual_head is None else load_head(self.residual_head, self.residual_loader)
        return ServiceConfig(
            allow_starved=self.allow_starved,
            servers=servers_of(policy_of(self.ponder)),
            max_clock_bound_ns=round(self.max_clock_bound_ms * 1_000_000),
            residual=head,
        )
