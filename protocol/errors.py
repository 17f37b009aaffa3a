"""What can be wrong with a message or a link, told from the facts."""

from __future__ import annotations

from protocol.messages import Refusal


class ProtocolError(ValueError):
    """Bytes, shapes or identities that this process cannot accept."""


class MalformedMessage(ProtocolError):
    """A message that must not reach anybody: it says which, what was expected and what came."""

    def __init__(self, message: str, field: str, expected: str, came: str) -> None:
        super().__init__(f"{message}.{field}: expected {expected}, came {came}")
        self.message = message
        self.field = field


class EpisodeRefused(ProtocolError):
    """An episode that cannot be opened: a code for programs and a sentence for people."""

    def __init__(self, refusal: Refusal, sentence: str) -> None:
        super().__init__(sentence)
        self.refusal = refusal


class TransportError(RuntimeError):
    """A link that cannot be opened or does not answer."""


class CallFailed(TransportError):
    """A request without an answer: nobody serves the key, or it took too long."""

    def __init__(self, key: str, timeout_ms: float, why: str) -> None:
        super().__init__(f"no answer on {key} within {timeout_ms:.0f} ms: {why}")
        self.key = key
