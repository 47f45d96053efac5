"""Keeps on a branch of the machine's kernel that its nodes would switch on and off all the time.

The kernel switches such a branch (a static key) by rewriting its code while all processors run it: first to a
breakpoint, whose handler repeats the instruction until the new one is there. Under QEMU's emulation with a thread for
each processor, a processor may keep the translated breakpoint and repeat it forever. Seen with QEMU 7.2 and Linux
6.1.192: both processors hung in `netif_receive_skb_list_internal`, one at the breakpoint, at its branch for time stamps
(`netstamp_needed_key`), which every `ping` switches on as it starts, and off as it ends.
"""

from __future__ import annotations

import socket

# SO_TIMESTAMP_OLD of asm-generic/socket.h, which Python does not name
_SO_TIMESTAMP = 29


def hold_time_stamps() -> socket.socket:
    """A socket for which the kernel stamps received packets for as long as it is open. Create it before any traffic."""
    held = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    held.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMP, 1)
    return held
