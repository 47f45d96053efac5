"""Where the nodes of a fleet on this machine are reached from it; pure, and free of other packages' code.

Every management address a.b.c.d appears as 127.b.c.d, all on one port per fleet; a node's LAN port on the bench is
127.255.0.N, where N counts the nodes from 1.
"""

from __future__ import annotations

from ipaddress import IPv4Address

FACTORY_ADDRESS = "192.168.1.1"


def loopback_of(address: str) -> str:
    """Where a management address is reached on this machine: 10.42.0.11 -> 127.42.0.11."""
    return "127." + str(IPv4Address(address)).split(".", 1)[1]


def bench_of(number: int) -> str:
    """Where the LAN port of the `number`-th node (from 0) is reached: 127.255.0.1, 127.255.0.2, ..."""
    return f"127.255.{(number + 1) // 256}.{(number + 1) % 256}"
