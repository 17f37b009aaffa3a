"""Why a message was not used: the keys of ``Health.dropped``."""

from __future__ import annotations

from enum import StrEnum


class DropReason(StrEnum):
    """One word for each; programs may rely on them."""

    WRONG_ENCODING = "wrong_encoding"
    """Not the type that its key promises."""
    MALFORMED = "malformed"
    """It does not decode, or breaks a rule of ``checks``."""
    WRONG_ROBOT = "wrong_robot"
    """Its header names another robot than its key."""
    WRONG_EPISODE = "wrong_episode"
    """Its header names another episode than its key."""
    OTHER_EPISODE = "other_episode"
    """It belongs to another episode than the running one."""
    NO_EPISODE = "no_episode"
    """It came between episodes."""
    WRONG_SHAPE = "wrong_shape"
    """An observation of other pictures or joints than the models read."""
    NO_PICTURE = "no_picture"
    """An image that is none."""
    WRONG_REQUEST = "wrong_request"
    """An invocation that does not fit the model."""
    UNKNOWN_CLOCK = "unknown_clock"
    """Its instant is on a clock that nobody has measured."""
    UNASKED = "unasked"
    """An answer to no question."""
    REFUSED_CALL = "refused_call"
    """A call whose request was refused."""
