"""The kernel's interfaces and the operator's wishes -> the attachments this node uses. Pure.

A wish names an interface (a pattern such as `wlan*`; all broadcast interfaces if nothing is wished for) or one own
address. An attachment is what the transport's core calls a link: a name, an own address, perhaps a broadcast address,
an MTU.
"""

from __future__ import annotations

import fnmatch
import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

from udp_mesh.links.netlink import Interface, InterfaceAddress

Address: TypeAlias = tuple[str, int]

MAX_MTU = 65_535
"""The loopback's 65,536 is one byte more than an IP packet can have."""


@dataclass(frozen=True, slots=True)
class LinkWish:
    """What the operator wants: interfaces by pattern, or one own address; broadcast, or fixed neighbours only."""

    interface: str | None = None
    address: str | None = None
    broadcast: bool = True
    mtu: int | None = None
    """Overrides the interface's (a tunnel or mesh below may carry less)."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """One socket's place: bound to `device`, at `address`; `broadcast` is None where neighbours are fixed."""

    name: str
    device: str
    address: Address
    broadcast: Address | None
    mtu: int


EVERY_INTERFACE = (LinkWish(interface="*"),)
"""The default: each running interface that can broadcast."""


def choose(interfaces: Iterable[Interface], wishes: Iterable[LinkWish], port: int) -> tuple[Attachment, ...]:
    """The attachments that exist now, one per interface (or wished address), the first wish that fits an interface
    wins."""
    running = [interface for interface in interfaces if interface.running]
    chosen: dict[str, Attachment] = {}
    for wish in wishes:
        for attachment in _of_address(running, wish, port) if wish.address else _of_interface(running, wish, port):
            chosen.setdefault(attachment.name, attachment)
    return tuple(chosen.values())


def _of_interface(running: list[Interface], wish: LinkWish, port: int) -> Iterable[Attachment]:
    for interface in running:
        if not fnmatch.fnmatchcase(interface.name, wish.interface or "*"):
            continue
        if interface.loopback and wish.interface != interface.name:
            continue
        for address in interface.addresses:
            if ":" in address.host or (wish.broadcast and not (interface.can_broadcast and address.broadcast)):
                continue
            broadcast = (address.broadcast, port) if wish.broadcast and address.broadcast else None
            yield Attachment(interface.name, interface.name, (address.host, port), broadcast, _mtu(interface, wish))
            break


def _of_address(running: list[Interface], wish: LinkWish, port: int) -> Iterable[Attachment]:
    wanted = ipaddress.ip_address(wish.address or "")
    for interface in running:
        for address in interface.addresses:
            # Every address of 127.0.0.0/8 is the loopback's own.
            own = ipaddress.ip_address(address.host) == wanted or (interface.loopback and _within(wanted, address))
            if own:
                broadcast = (address.broadcast, port) if wish.broadcast and address.broadcast else None
                yield Attachment(str(wanted), interface.name, (str(wanted), port), broadcast, _mtu(interface, wish))
                return


def _within(wanted: ipaddress.IPv4Address | ipaddress.IPv6Address, address: InterfaceAddress) -> bool:
    return wanted in ipaddress.ip_network(f"{address.host}/{address.prefix_length}", strict=False)


def _mtu(interface: Interface, wish: LinkWish) -> int:
    return min(wish.mtu or interface.mtu, interface.mtu, MAX_MTU)
