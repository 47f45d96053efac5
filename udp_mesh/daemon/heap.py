"""Large buffers are returned to the system when they are freed."""

import ctypes
from contextlib import suppress

_M_MMAP_THRESHOLD = -3
"""malloc.h of the GNU C library."""
MIN_MAPPED_BYTES = 1 << 20
"""Blocks from this size on are mapped, and unmapped when they are freed."""


def map_large_blocks() -> None:
    """Keep the C library from taking large blocks from its heap.

    It does so after the first one was freed (mallopt(3), M_MMAP_THRESHOLD). Backlogs of slow programs, which grow to
    many megabytes, then leave a heap full of holes: it grew with each of them, and nothing of it was returned.
    """
    # another C library, such as musl, has no such function and maps large blocks anyway
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, MIN_MAPPED_BYTES)
