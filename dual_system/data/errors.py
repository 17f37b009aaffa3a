"""What a dataset's programs refuse or give up, as sentences for their user."""


class DatasetError(Exception):
    """Something that the user can mend: the message says what was expected, what came, and the way out."""
