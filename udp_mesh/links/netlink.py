"""The kernel's interfaces and addresses (rtnetlink, RFC 3549, linux/rtnetlink.h).

A dump request -> the kernel's messages -> `parse` -> `Interface` values. `InterfaceMonitor` reports that something
changed; a new dump then shows what, so a lost notice cannot leave a stale state. Broadcast addresses come from the
kernel and are correct for any netmask.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

_NLMSG = struct.Struct("=IHHII")
_IFINFO = struct.Struct("=BxHiII")
_IFADDR = struct.Struct("=BBBBI")
_RTATTR = struct.Struct("=HH")

NLMSG_ERROR, NLMSG_DONE = 2, 3
RTM_NEWLINK, RTM_GETLINK, RTM_NEWADDR, RTM_GETADDR = 16, 18, 20, 22
NLM_F_REQUEST, NLM_F_DUMP = 1, 0x300
IFLA_IFNAME, IFLA_MTU = 3, 4
IFA_ADDRESS, IFA_LOCAL, IFA_BROADCAST = 1, 2, 4
IFA_F_DADFAILED, IFA_F_TENTATIVE = 0x08, 0x40
IFF_UP, IFF_BROADCAST, IFF_LOOPBACK, IFF_RUNNING, IFF_MULTICAST = 0x1, 0x2, 0x8, 0x40, 0x1000
GROUPS = 0x1 | 0x10 | 0x100
"""RTMGRP_LINK, RTMGRP_IPV4_IFADDR, RTMGRP_IPV6_IFADDR."""

_RECEIVE_BYTES = 1 << 16
_DUMP_TIMEOUT_S = 5.0
"""The kernel answers a dump at once; the timeout keeps a broken sandbox from blocking the start."""


class NetlinkError(OSError):
    """The kernel refused a dump, or its answer is truncated."""


@dataclass(frozen=True, slots=True)
class InterfaceAddress:
    """One address of an interface. `broadcast` is None for IPv6 and for point-to-point addresses."""

    host: str
    prefix_length: int
    broadcast: str | None


@dataclass(frozen=True, slots=True)
class Interface:
    """One network interface. `running` means administratively up and with carrier."""

    name: str
    index: int
    mtu: int
    running: bool
    loopback: bool
    can_broadcast: bool
    can_multicast: bool
    addresses: tuple[InterfaceAddress, ...] = field(default=())


def interfaces() -> tuple[Interface, ...]:
    """Every interface of this network namespace with its addresses, by index. Raises NetlinkError."""
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE) as kernel:
        kernel.settimeout(_DUMP_TIMEOUT_S)
        kernel.bind((0, 0))
        return parse(_dump(kernel, RTM_GETLINK) + _dump(kernel, RTM_GETADDR))


def _dump(kernel: socket.socket, request: int) -> bytes:
    body = _IFINFO.pack(socket.AF_UNSPEC, 0, 0, 0, 0)
    kernel.sendto(_NLMSG.pack(_NLMSG.size + len(body), request, NLM_F_REQUEST | NLM_F_DUMP, 1, 0) + body, (0, 0))
    collected = bytearray()
    while True:
        data = kernel.recv(_RECEIVE_BYTES)
        for kind, payload in split_messages(data):
            if kind == NLMSG_DONE:
                return bytes(collected)
            if kind == NLMSG_ERROR:
                code = -struct.unpack_from("=i", payload)[0]
                raise NetlinkError(code, f"the kernel refused to list interfaces (request {request})")
        collected += data


def split_messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(type, payload) of each netlink message in one or more reads. Raises NetlinkError for an invalid length."""
    place = 0
    while place < len(data):
        if place + _NLMSG.size > len(data):
            raise NetlinkError(0, "truncated netlink message")
        length, kind, _, _, _ = _NLMSG.unpack_from(data, place)
        if length < _NLMSG.size or place + length > len(data):
            raise NetlinkError(0, f"netlink message has invalid length {length}")
        yield kind, data[place + _NLMSG.size : place + length]
        place += (length + 3) & ~3


def parse(data: bytes) -> tuple[Interface, ...]:
    """The interfaces described by link and address messages."""
    found: dict[int, Interface] = {}
    addresses: dict[int, list[InterfaceAddress]] = {}
    for kind, payload in split_messages(data):
        if kind == RTM_NEWLINK and len(payload) >= _IFINFO.size:
            _, _, index, flags, _ = _IFINFO.unpack_from(payload)
            attributes = dict(_attributes(payload, _IFINFO.size))
            found[index] = Interface(
                name=attributes.get(IFLA_IFNAME, b"").rstrip(b"\0").decode("utf-8", "replace"),
                index=index,
                mtu=int.from_bytes(attributes.get(IFLA_MTU, b"\0"), "little" if _LITTLE else "big"),
                running=flags & (IFF_UP | IFF_RUNNING) == IFF_UP | IFF_RUNNING,
                loopback=bool(flags & IFF_LOOPBACK),
                can_broadcast=bool(flags & IFF_BROADCAST),
                can_multicast=bool(flags & IFF_MULTICAST),
            )
        elif kind == RTM_NEWADDR and len(payload) >= _IFADDR.size:
            family, prefix_length, flags, _, index = _IFADDR.unpack_from(payload)
            if flags & (IFA_F_TENTATIVE | IFA_F_DADFAILED):
                # An IPv6 address that cannot be used yet (RFC 4862, 5.4); the kernel sends a notice when it can.
                continue
            attributes = dict(_attributes(payload, _IFADDR.size))
            # IFA_LOCAL is the local address; on point-to-point links IFA_ADDRESS is the remote one.
            local = attributes.get(IFA_LOCAL, attributes.get(IFA_ADDRESS))
            if local is None or len(local) != {socket.AF_INET: 4, socket.AF_INET6: 16}.get(family):
                continue
            broadcast = attributes.get(IFA_BROADCAST)
            if broadcast is None and family == socket.AF_INET and attributes.get(IFA_ADDRESS) == local:
                broadcast = _network_broadcast(local, prefix_length)
            addresses.setdefault(index, []).append(
                InterfaceAddress(
                    socket.inet_ntop(family, local),
                    prefix_length,
                    socket.inet_ntop(family, broadcast) if broadcast is not None and len(broadcast) == 4 else None,
                )
            )
    return tuple(
        replace(interface, addresses=tuple(addresses.get(index, ()))) for index, interface in sorted(found.items())
    )


def _network_broadcast(address: bytes, prefix_length: int) -> bytes | None:
    """The broadcast address of an IPv4 network. The kernel routes it even if the address was added without one
    (`ip addr add` without `brd`; linux net/ipv4/fib_frontend.c, fib_add_ifaddr). Networks of one or two addresses have
    none (RFC 3021)."""
    if prefix_length >= 31:
        return None
    return (int.from_bytes(address, "big") | (0xFFFFFFFF >> prefix_length)).to_bytes(4, "big")


_LITTLE = struct.pack("=H", 1) == b"\x01\x00"


def _attributes(payload: bytes, start: int) -> Iterator[tuple[int, bytes]]:
    place = start
    while place + _RTATTR.size <= len(payload):
        length, kind = _RTATTR.unpack_from(payload, place)
        if length < _RTATTR.size or place + length > len(payload):
            return
        yield kind & 0x3FFF, payload[place + _RTATTR.size : place + length]
        place += (length + 3) & ~3


class InterfaceMonitor:
    """A socket that becomes readable when an interface or address is added, removed or changed."""

    def __init__(self) -> None:
        self._socket = socket.socket(
            socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK, socket.NETLINK_ROUTE
        )
        self._socket.bind((0, GROUPS))

    def fileno(self) -> int:
        return self._socket.fileno()

    def drain(self) -> bool:
        """Reads all notices; True if something may have changed (also if the kernel lost notices)."""
        changed = False
        while True:
            try:
                self._socket.recv(_RECEIVE_BYTES)
            except BlockingIOError:
                return changed
            except OSError:
                # ENOBUFS: notices were lost. A dump shows the current state anyway.
                return True
            changed = True

    def close(self) -> None:
        self._socket.close()
