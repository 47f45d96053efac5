"""Loopback addresses of a fleet's nodes on this machine. Pure.

A management address a.b.c.d is forwarded from 127.b.c.d, on one port per fleet; a node's LAN port on the bench is
forwarded from 127.255.0.N, where N counts the nodes from 1.
"""

from __future__ import annotations

from ipaddress import IPv4Address

FACTORY_ADDRESS = "192.168.1.1"


def loopback_of(address: str) -> str:
    """The loopback address of a management address: 10.42.0.11 -> 127.42.0.11."""
    return "127." + str(IPv4Address(address)).split(".", 1)[1]


def bench_of(number: int) -> str:
    """The loopback address of the LAN port of node `number` (from 0): 127.255.0.1, 127.255.0.2, ..."""
    return f"127.255.{(number + 1) // 256}.{(number + 1) % 256}"
