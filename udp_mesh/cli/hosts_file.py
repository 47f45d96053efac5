"""The block of peers in a hosts(5) file: the daemon's peers -> `HostEntry` entries -> the file's new text. Pure.

Everything outside the block stays byte for byte. A name that another line of the file defines is left out of the block,
because the resolver uses the first line that has it.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

BEGIN = "# BEGIN udp_mesh: peers of the mesh, rewritten by `udp-mesh hosts`"
END = "# END udp_mesh"

_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?")
_RESERVED = ("localhost", "broadcasthost")


class HostEntry(NamedTuple):
    """A peer with its IP address, without a zone."""

    name: str
    address: str


class MergedHosts(NamedTuple):
    """`text` is the file's new content; `conflicts` are the names that another line defines, with their addresses."""

    text: str
    conflicts: tuple[HostEntry, ...]


def hosts_of(peers: Iterable[Mapping[str, object]]) -> tuple[HostEntry, ...]:
    """The peers, as in the daemon's reply to `peers`, that a hosts file can name, in the order of their names.

    Left out are peers without an address, addresses that reach only this computer or one link, legacy peers, whose
    names are not authenticated, names that are not a host name of one label (RFC 1123, section 2.1), and offline peers
    whose address another peer has now, such as a robot that was renamed.
    """
    everyone = tuple(peers)
    in_use = {_ip(peer.get("address")) for peer in everyone if peer.get("online")}
    found = {}
    for peer in everyone:
        name, address = str(peer.get("name", "")), _ip(peer.get("address"))
        if address in in_use and not peer.get("online"):
            continue
        is_host_name = _LABEL.fullmatch(name) is not None and not name.isdigit() and name.lower() not in _RESERVED
        if address and is_host_name and not peer.get("legacy"):
            found[name.lower()] = HostEntry(name, address)
    return tuple(found[name] for name in sorted(found))


def _ip(shown: object) -> str:
    """The IP address of `10.0.0.2:8700` or `[fd00::2]:8700`; empty if it is of no use on other interfaces."""
    if not isinstance(shown, str):
        return ""
    host = shown.rpartition(":")[0].removeprefix("[").removesuffix("]")
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return ""
    if address.is_loopback or address.is_link_local or address.is_multicast or address.is_unspecified:
        return ""
    return str(address)


def merge(text: str, hosts: Iterable[HostEntry]) -> MergedHosts:
    """The hosts file `text` with these hosts as its block, in place of an earlier block or at the end."""
    before, after = _split_around_block(text)
    defined = _names(before) | _names(after)
    entries: list[HostEntry] = []
    conflicts: list[HostEntry] = []
    for host in hosts:
        (conflicts if host.name.lower() in defined else entries).append(host)
    if not entries:
        return MergedHosts(before + after, tuple(conflicts))
    if before and not before.endswith("\n"):
        before += "\n"
    width = max(len(host.address) for host in entries)
    lines = [BEGIN, *(f"{host.address:<{width}} {host.name}" for host in entries), END]
    return MergedHosts(before + "".join(f"{line}\n" for line in lines) + after, tuple(conflicts))


def without_block(text: str) -> str:
    """The hosts file without the block."""
    return "".join(_split_around_block(text))


def _split_around_block(text: str) -> tuple[str, str]:
    """The text before and after the block; ("...", "") without one.

    A block that lost its last line ends at the first line that is not one of its entries.
    """
    lines = text.splitlines(keepends=True)
    start = next((number for number, line in enumerate(lines) if line.rstrip() == BEGIN), None)
    if start is None:
        return text, ""
    end = start + 1
    while end < len(lines) and _is_entry(lines[end]):
        end += 1
    if end < len(lines) and lines[end].rstrip() == END:
        end += 1
    return "".join(lines[:start]), "".join(lines[end:])


def _is_entry(line: str) -> bool:
    words = line.split()
    return len(words) == 2 and _ip(f"[{words[0]}]:0") != "" and _LABEL.fullmatch(words[1]) is not None


def _names(text: str) -> set[str]:
    """The lower-case names that the lines define."""
    words = (line.partition("#")[0].split() for line in text.splitlines())
    return {name.lower() for line in words for name in line[1:]}
