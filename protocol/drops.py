"""Reasons for dropping a message: the keys of ``Health.dropped``."""

from __future__ import annotations

from enum import StrEnum


class DropReason(StrEnum):
    """Stable names of the reasons."""

    WRONG_ENCODING = "wrong_encoding"
    """Its encoding is not its topic's type."""
    MALFORMED = "malformed"
    """It does not decode, or breaks a rule of ``checks``."""
    WRONG_ROBOT = "wrong_robot"
    """Its header names another robot than its key."""
    WRONG_EPISODE = "wrong_episode"
    """Its header names another episode than its key."""
    OTHER_EPISODE = "other_episode"
    """It belongs to another episode than the running one."""
    NO_EPISODE = "no_episode"
    """It arrived between episodes."""
    WRONG_SHAPE = "wrong_shape"
    """An observation with other pictures or joints than the models read."""
    NO_PICTURE = "no_picture"
    """An image that cannot be decoded."""
    WRONG_REQUEST = "wrong_request"
    """An invocation that does not fit the model."""
    UNKNOWN_CLOCK = "unknown_clock"
    """Its instant is on a clock whose offset was not measured."""
    WRONG_INSTANT = "wrong_instant"
    """A tick or an instant that the episode cannot have reached."""
    OTHER_MODEL = "other_model"
    """An answer of other weights than those that the episode was opened with."""
    OUT_OF_LIMITS = "out_of_limits"
    """A command that this robot must not get."""
    FAILED = "failed"
    """Handling it raised an unexpected error: a bug, which the log has with its traceback."""
    UNASKED = "unasked"
    """An answer without a request."""
    REFUSED_CALL = "refused_call"
    """A call with a refused request."""
