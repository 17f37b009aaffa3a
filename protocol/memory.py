"""Freed buffers stay in the process, so that the next picture need not ask the kernel for its pages again.

glibc gives freed memory at the top of its heap back at once. An observation of two raw 256 px views passes through
several buffers of 0.4 MB per tick, and every one of them then faults its pages in anew: measured, 160 page faults and
0.5 ms per observation, more than the transport itself takes.
"""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_KEEP_BYTES = 64 << 20  # this much free memory is kept rather than given back
_LARGE_BYTES = 32 << 20  # only larger blocks are mapped and unmapped one by one; the most that glibc allows


def keep_freed_memory() -> None:
    """For the whole process; does nothing where the C library is not glibc."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
