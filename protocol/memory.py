"""Keeps freed buffers in the process, so that the next picture need not get its pages from the kernel again.

glibc immediately returns freed memory at the top of its heap. An observation of two raw 256 px views passes through
several buffers of 0.4 MB per tick, each of which would fault in its pages again: 160 page faults and 0.5 ms per
observation were measured, more than the transport itself takes.
"""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_KEEP_BYTES = 64 << 20  # free memory to keep
_LARGE_BYTES = 32 << 20  # only larger blocks are mapped individually; glibc's maximum


def keep_freed_memory() -> None:
    """Applies to the whole process; does nothing if the C library is not glibc."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
