"""Errors of messages, files and links, which build their text from facts."""

from __future__ import annotations

from protocol.messages import Refusal


class CommandError(RuntimeError):
    """What a person can mend; the message says what was expected, what came, where, and the way out."""


class ProtocolError(ValueError):
    """Bytes, shapes or identities that this process cannot accept."""


class FileError(ProtocolError):
    """A file that is not what it should be; the message names it."""


class MalformedMessage(ProtocolError):
    """An invalid message; names message and field, the expected and the actual value."""

    def __init__(self, message: str, field: str, expected: str, came: str) -> None:
        super().__init__(f"{message}.{field}: expected {expected}, came {came}")
        self.message = message
        self.field = field


class EpisodeRefused(ProtocolError):
    """An episode that cannot be opened: a code for programs, a sentence for the user, and whether it may pass."""

    def __init__(self, refusal: Refusal, sentence: str, *, try_again: bool = False) -> None:
        super().__init__(sentence)
        self.refusal = refusal
        self.try_again = try_again


class TransportError(CommandError):
    """A link that cannot be opened or does not answer."""


class CallFailed(TransportError):
    """A request without a reply: no process serves the key, or it took too long."""

    def __init__(self, key: str, timeout_ms: float, why: str) -> None:
        super().__init__(f"no answer on {key} within {timeout_ms:.0f} ms: {why}")
        self.key = key
