"""What the ticks are at which a policy may look, before its own."""

from __future__ import annotations

from itertools import pairwise

MAX_WINDOW = 16  # ticks at which a policy looks
MAX_REACH_TICKS = 100  # raw pictures of so many ticks are 40 MB in a model server


def no_window(offsets: tuple[int, ...]) -> str:
    """Why ``offsets`` are not the ticks at which a policy looks, against the present one; "" if they are."""
    if not offsets or offsets[-1] != 0 or any(after <= before for before, after in pairwise(offsets)):
        return f"{list(offsets)}: they ascend, and end with 0, the present"
    if len(offsets) > MAX_WINDOW or offsets[0] < -MAX_REACH_TICKS:
        return f"{list(offsets)}: at most {MAX_WINDOW} of them, and none before {-MAX_REACH_TICKS}"
    return ""
