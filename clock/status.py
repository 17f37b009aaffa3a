"""What the clock service tells its operators."""

from __future__ import annotations

from collections.abc import Callable

from clock.servers import OPEN_NS
from clock.service import ClockService
from protocol.link import Link
from protocol.messages import Health, ServingState
from protocol.metrics import End
from protocol.version import version


def end_of(service: ClockService, link: Link, silent_ns: Callable[[], int]) -> End:
    """The clock service's end of the bus: it is ready if the model servers are. It may be busy in an opening."""
    build = version()  # reads a file

    def health() -> Health:
        why_not = service.not_ready()
        state = ServingState.UNSPECIFIED if why_not else ServingState.READY
        return Health(state=state, detail=why_not, model_hash=service.models, version=build)

    return End(link=link, health=health, silent_ns=silent_ns, limit_ns=2 * OPEN_NS)
