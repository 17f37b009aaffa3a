"""What a dataset's programs refuse or give up, as sentences for their user."""

from protocol.errors import CommandError


class DatasetError(CommandError):
    """An error that the user can fix; the message says what was expected, what was found, and the way out."""
