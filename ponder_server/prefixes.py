"""Cache of encoded openings, which further episodes with an identical opening fork."""

import hashlib
from collections import OrderedDict

import torch

from ponder_server.contract import Opening
from ponder_server.runner import Prefix, Session


class Prefixes:
    """The ``max_prefixes`` most recently used openings; 0 keeps none.

    Only a whole opening can be shared, because a recurrent state cannot be cut at an earlier token.
    """

    def __init__(self, max_prefixes: int) -> None:
        self._max_prefixes = max_prefixes
        self._prefixes: OrderedDict[bytes, Prefix] = OrderedDict()

    def find(self, opening: Opening) -> Prefix | None:
        """Context of an identical opening; None if there is none."""
        key = _digest(opening)
        found = self._prefixes.get(key)
        if found is not None:
            self._prefixes.move_to_end(key)
        return found

    def keep(self, opening: Opening, context: Session) -> None:
        """Copies a context that holds exactly ``opening``, or drops all copies if the device runs out of memory."""
        while self._prefixes and len(self._prefixes) >= self._max_prefixes:
            self._prefixes.popitem(last=False)
        if self._max_prefixes:
            try:
                self._prefixes[_digest(opening)] = context.copy()
            except torch.OutOfMemoryError:
                self._prefixes.clear()


def _digest(opening: Opening) -> bytes:
    digest = hashlib.sha256(opening.instruction.encode())
    for views in opening.demo_frames:
        digest.update(f"|{len(views)}".encode())
        for view in views:
            digest.update(view.tobytes())
    return digest.digest()
