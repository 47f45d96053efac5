"""The frequency of this host's time stamp counter, which an emulated kernel cannot measure reliably.

Under TCG the guest's counter is the host's. On a busy host the kernel's own measurement, over 10 ms of an emulated
timer, was wrong by a factor of 4.5: its clocks ran fast, so that confirm windows of ten minutes were over after two.
"""

from __future__ import annotations

import ctypes
import mmap
import platform
import time
from collections.abc import Callable

# rdtsc; shl rdx, 32; or rax, rdx; ret
_READ_COUNTER = bytes.fromhex("0f31 48c1e220 4809d0 c3")
_INTERVAL_S = 0.05
_MAX_ERROR = 1e-4


def counter_khz() -> int | None:
    """The frequency in kHz within 0.01 %; None if the counter cannot be read."""
    if platform.machine() != "x86_64":
        return None
    try:
        page = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    except OSError:
        return None
    with page:
        page.write(_READ_COUNTER)
        at = ctypes.c_char.from_buffer(page)
        counter = ctypes.CFUNCTYPE(ctypes.c_uint64)(ctypes.addressof(at))
        found = measured_khz(counter, time.monotonic_ns, time.sleep)
        # the page cannot be closed while something refers to it
        del at
    return found


def measured_khz(counter: Callable[[], int], clock_ns: Callable[[], int], sleep: Callable[[float], None]) -> int:
    """Counts per millisecond between two readings, each enclosed by the clock; a reading that was interrupted for too
    long is repeated, as the interval grows."""
    start_ns, start, start_gap_ns = _reading(counter, clock_ns)
    sleep(_INTERVAL_S)
    while True:
        at_ns, at, gap_ns = _reading(counter, clock_ns)
        if start_gap_ns + gap_ns <= _MAX_ERROR * (at_ns - start_ns):
            return round((at - start) * 1e6 / (at_ns - start_ns))
        sleep(_INTERVAL_S)


def _reading(counter: Callable[[], int], clock_ns: Callable[[], int]) -> tuple[int, int, int]:
    """The clock and the counter at one moment, and the uncertainty of that moment."""
    before_ns = clock_ns()
    count = counter()
    gap_ns = clock_ns() - before_ns
    return before_ns + gap_ns // 2, count, gap_ns
