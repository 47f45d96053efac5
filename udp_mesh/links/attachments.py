"""The kernel's interfaces and the link configuration -> the attachments of this node. Pure.

A link configuration selects interfaces by pattern (such as `wlan*`; by default all broadcast interfaces) or one local
address. An attachment is what the core calls a link: a name, a local address, an MTU and, unless the link has fixed
neighbors only, a broadcast address. IPv4 is preferred; if an interface has no IPv4 broadcast address, its link-local
IPv6 address and the all-nodes multicast group are used instead.
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
"""The loopback's MTU of 65,536 is one byte more than an IP packet can have."""

MIN_MTU = 200
"""Smallest MTU that leaves room for headers and a useful payload: interfaces with less are not used."""


ALL_NODES = "ff02::1"
"""All IPv6 nodes on the link (RFC 4291, 2.7.1), the counterpart of an IPv4 broadcast. It needs no joining, and switches
and meshes that prune multicast always forward it (RFC 4541, 3)."""


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """One entry of the link configuration: interfaces by pattern, or one local address."""

    interface: str | None = None
    address: str | None = None
    broadcast: bool = True
    mtu: int | None = None
    """Overrides the interface's MTU (a tunnel or mesh below may carry less)."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """Where one socket is opened: bound to `device`, at `address`; `broadcast` is None on a link with fixed neighbors
    only."""

    name: str
    device: str
    address: Address
    broadcast: Address | None
    mtu: int
    index: int
    """The kernel's index of the device. A device that was deleted and created again has another index, even with the
    same name and addresses, and a socket bound to the old one receives nothing."""


EVERY_INTERFACE = (LinkConfig(interface="*"),)
"""The default: each running interface that can broadcast."""


def select_attachments(
    interfaces: Iterable[Interface], configs: Iterable[LinkConfig], port: int
) -> tuple[Attachment, ...]:
    """The attachments that exist now, one per interface (or configured address); the first entry that matches an
    interface wins."""
    running = [interface for interface in interfaces if interface.running]
    chosen: dict[str, Attachment] = {}
    for config in configs:
        for attachment in (
            _by_address(running, config, port) if config.address else _by_interface(running, config, port)
        ):
            chosen.setdefault(attachment.name, attachment)
    return tuple(chosen.values())


def _by_interface(running: list[Interface], config: LinkConfig, port: int) -> Iterable[Attachment]:
    for interface in running:
        if not fnmatch.fnmatchcase(interface.name, config.interface or "*"):
            continue
        if interface.loopback and config.interface != interface.name:
            continue
        usable = [
            address for address in interface.addresses if not config.broadcast or _broadcast_address(interface, address)
        ]
        if config.broadcast:
            # All nodes on the link are reached from the link-local address, which every IPv6 interface has.
            usable = [own for own in usable if ":" not in own.host or ipaddress.ip_address(own.host).is_link_local]
        if usable:
            address = min(usable, key=_preference)
            to_all = _broadcast_address(interface, address) if config.broadcast else None
            broadcast = None if to_all is None else (to_all, port)
            own = (address.host, port)
            mtu = _mtu(interface, config)
            yield Attachment(interface.name, interface.name, own, broadcast, mtu, interface.index)


def _by_address(running: list[Interface], config: LinkConfig, port: int) -> Iterable[Attachment]:
    wanted = ipaddress.ip_address(config.address or "")
    for interface in running:
        for address in interface.addresses:
            # The loopback owns every address of 127.0.0.0/8.
            own = ipaddress.ip_address(address.host) == wanted or (interface.loopback and _in_network(wanted, address))
            if own:
                to_all = _broadcast_address(interface, address) if config.broadcast else None
                broadcast = None if to_all is None else (to_all, port)
                mtu = _mtu(interface, config)
                yield Attachment(str(wanted), interface.name, (str(wanted), port), broadcast, mtu, interface.index)
                return


def _broadcast_address(interface: Interface, address: InterfaceAddress) -> str | None:
    """The address that reaches all nodes on the link from this address (None: there is none)."""
    if ":" in address.host:
        return ALL_NODES if interface.can_multicast and not interface.loopback else None
    return address.broadcast if interface.can_broadcast else None


def _preference(address: InterfaceAddress) -> int:
    """IPv4 first, then routable IPv6, then link-local; the first among equals."""
    if ":" not in address.host:
        return 0
    return 2 if ipaddress.ip_address(address.host).is_link_local else 1


def _in_network(wanted: ipaddress.IPv4Address | ipaddress.IPv6Address, address: InterfaceAddress) -> bool:
    return wanted in ipaddress.ip_network(f"{address.host}/{address.prefix_length}", strict=False)


def _mtu(interface: Interface, config: LinkConfig) -> int:
    return min(config.mtu or interface.mtu, interface.mtu, MAX_MTU)
