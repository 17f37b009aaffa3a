"""Openings that were encoded once and are forked for every further episode that begins with the same bits."""

import hashlib
from collections import OrderedDict

import torch

from ponder_server.contract import Opening
from ponder_server.runner import Prefix, Session


class Prefixes:
    """The most recently used openings, ``max_prefixes`` at most; 0 keeps none.

    Only a whole opening can be shared: a recurrent state says nothing about where its tokens ended.
    """

    def __init__(self, max_prefixes: int) -> None:
        self._max_prefixes = max_prefixes
        self._prefixes: OrderedDict[bytes, Prefix] = OrderedDict()

    def find(self, opening: Opening) -> Prefix | None:
        """An equal opening's context."""
        key = _digest(opening)
        found = self._prefixes.get(key)
        if found is not None:
            self._prefixes.move_to_end(key)
        return found

    def keep(self, opening: Opening, context: Session) -> None:
        """Copies a context that holds exactly ``opening``; does without if the device has no memory for it."""
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
