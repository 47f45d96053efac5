"""Names of nodes and topics, `[[links]]`, `[[neighbors]]` and addresses in a configuration."""

from __future__ import annotations

import ipaddress
import re

from udp_mesh.core.setting_checks import is_name
from udp_mesh.core.settings import Address, Neighbour
from udp_mesh.daemon.toml_source import Table
from udp_mesh.links.attachments import LinkConfig
from udp_mesh.wire.limits import MAX_NAME_BYTES, MAX_TOPIC_BYTES

NODE_NAME = f"a name of 1 to {MAX_NAME_BYTES} bytes without spaces or slashes"
TOPIC_NAME = f"a topic of 1 to {MAX_TOPIC_BYTES} bytes without spaces"


def is_node_name(name: str) -> bool:
    """Whether this is a valid node name."""
    return is_name(name, MAX_NAME_BYTES) and "/" not in name


def is_topic_name(name: str) -> bool:
    """Whether this is a valid topic name."""
    return is_name(name, MAX_TOPIC_BYTES)


def read_link(table: Table) -> LinkConfig:
    """An entry of `[[links]]`; reports problems to the table's source."""
    interface, address = table.text("interface"), table.text("address")
    kind = table.choice("kind", "broadcast", ("broadcast", "neighbors"), {"neighbours": "neighbors"})
    mtu = table.integer("mtu", None, 200, 65_535)
    table.finish()
    if (interface is None) == (address is None):
        table.source.report(table.path, "either interface or address", "both" if interface else "neither")
    if address is not None:
        try:
            if ipaddress.ip_address(address).is_link_local and ":" in address:
                table.report("address", "an address that is not link-local (set `interface` instead)", address)
        except ValueError:
            table.report("address", "an IPv4 or IPv6 address", address)
    return LinkConfig(interface, address, kind == "broadcast", mtu)


def read_neighbours(top: Table, port: int) -> tuple[Neighbour, ...]:
    """All of `[[neighbors]]`, or `[[neighbours]]` as it was; reports problems to the table's source."""
    found: dict[Address, Neighbour] = {}
    for entry in (*top.tables("neighbours"), *top.tables("neighbors")):
        neighbour = read_neighbour(entry, port)
        if neighbour is None:
            continue
        if neighbour.address in found:
            entry.report("address", "each neighbor once", neighbour.address[0])
        found[neighbour.address] = neighbour
    return tuple(found.values())


def read_neighbour(table: Table, port: int) -> Neighbour | None:
    """A fixed neighbor from an entry of `[[neighbors]]` or from a request; None, with a problem reported to the
    table's source, if it is invalid."""
    text, name = table.text("address"), table.text("name")
    link, legacy = table.text("link"), table.boolean("legacy", False)
    table.finish()
    if text is None:
        table.source.report(table.path, "an address", "none")
        return None
    if name is not None and not is_node_name(name):
        table.report("name", NODE_NAME, name)
        return None
    if legacy and name is None:
        table.source.report(table.path, "a name (a legacy neighbor's own name is not authenticated)", "none")
        return None
    address = parse_address(text, port)
    if address is None:
        table.report("address", "an IP address, optionally with a port (10.0.0.2, 10.0.0.2:8700, [fd00::2]:8700)", text)
        return None
    if ":" in address[0]:
        if legacy:
            table.report("address", "an IPv4 address (the legacy format has no IPv6)", text)
            return None
        if link is None and ipaddress.ip_address(address[0]).is_link_local:
            table.report("address", 'link = "INTERFACE" with a link-local address', text)
            return None
    return Neighbour(address, name, link, legacy)


def parse_address(text: str, port: int) -> Address | None:
    """Host and port of `10.0.0.2`, `10.0.0.2:8700`, `fd00::2` or `[fd00::2]:8700`; None for anything else."""
    host, number = text, str(port)
    bracketed = re.fullmatch(r"\[(?P<host>[^]]+)\](?::(?P<port>\d+))?", text)
    if bracketed:
        host, number = bracketed["host"], bracketed["port"] or number
    elif text.count(":") == 1:
        host, _, number = text.partition(":")
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return None
    if "%" in host:
        # The interface of a link-local address goes into the neighbor's `link`.
        return None
    if not re.fullmatch("[0-9]{1,5}", number) or not 1 <= int(number) <= 65_535:
        return None
    return host, int(number)
