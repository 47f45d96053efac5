"""Unique identifiers of nodes: hostnames, MAC addresses, host keys, labels, serial numbers (MC110 to MC122)."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace

from meshctl.device.trust import Pin, parse_pins
from meshctl.diagnostics import Severity
from meshctl.errors import InputError
from meshctl.inventory.file_paths import known_hosts_path
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates, group_by_key
from meshctl.lint.places import is_written
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Fleet, Node, NodeState
from meshctl.wording import join_limited

# one label of a host name: RFC 1123 section 2.1 and RFC 952, at most 63 octets (RFC 1035 section 2.3.4)
_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?")
# so many names of robots that are also unrelated nodes' are one scheme of names, not as many mistakes
_SINGLE_NAMES = 2
_MAC = re.compile(r"[0-9a-f]{2}(:[0-9a-f]{2}){5}")


def normal_mac(mac: str) -> str:
    """In lower case, with colons."""
    return mac.strip().lower().replace("-", ":")


def _collisions(fleet: Fleet, marks: Iterable[tuple[str, tuple[str, ...]]], what: str) -> Iterator[Finding]:
    """One finding for each node with the mark of another, except one. `marks` are pairs of a mark and its path.

    The exempt node is the first whose mark is a default (a hostname that is the node's name), else the first.
    """
    for mark, paths in duplicates(marks):
        by_node: dict[str, tuple[str, ...]] = {}
        for path in paths:
            by_node.setdefault(path[1], path)
        innocent = next(
            (path for path in by_node.values() if not is_written(fleet, path)), next(iter(by_node.values()))
        )
        for path in by_node.values():
            if path != innocent:
                yield Finding(path, f"{innocent[1]} has the same {what}", f"a unique {what}", mark)


@fleet_rule(
    "MC110",
    Severity.ERROR,
    "Two nodes have the same hostname",
    why="Logs, prompts and `batctl` identify nodes by hostname: with duplicates, the operator acts on the wrong node.",
    fix="Give each node a unique hostname, or omit it: it defaults to the node's name.",
    failing="nodes: {b01: {hostname: base}}",
    passing="nodes: {b01: {hostname: beacon-1}}",
)
def hostname_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    marks = ((node.hostname.lower(), ("nodes", node.name, "hostname")) for node in fleet.managed())
    yield from _collisions(fleet, marks, "hostname")


@fleet_rule(
    "MC111",
    Severity.ERROR,
    "A hostname is invalid",
    why="""The hostname goes to the kernel and to syslog. A name with an underscore, a dot or a non-ASCII letter is
    rejected, truncated or not resolvable (RFC 1123).""",
    fix="Use at most 63 letters, digits and inner hyphens.",
    failing="nodes: {b01: {hostname: beacon_1}}",
    passing="nodes: {b01: {hostname: beacon-1}}",
)
def hostname_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    wrong = [node for node in fleet.nodes.values() if _LABEL.fullmatch(node.hostname) is None]
    # a range makes many of them
    at = group_by_key((fleet.where("nodes", node.name, "hostname").position, node) for node in wrong)
    for nodes in at.values():
        path = ("nodes", nodes[0].name, "hostname")
        message = "invalid hostname" if len(nodes) == 1 else "invalid hostnames"
        found = join_limited([node.hostname for node in nodes])
        yield Finding(path, message, "letters, digits and inner hyphens, at most 63", found)


@fleet_rule(
    "MC112",
    Severity.WARNING,
    "Names differ only in case",
    why="Hostnames, known_hosts and case-insensitive file systems treat `B01` and `b01` as the same name.",
    fix="Rename one of them.",
    failing="nodes: {B01: {address: 10.42.0.99, hostname: other, role: beacon}}",
    passing="nodes: {b99: {address: 10.42.0.99, hostname: other, role: beacon}}",
)
def names_by_case(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for section, every in (("nodes", fleet.nodes), ("robots", fleet.robots), ("meshes", fleet.meshes)):
        for lowered, names in duplicates((name.lower(), name) for name in every):
            for name in names[1:]:
                yield Finding((section, name), f"differs from {names[0]} only in case", "another name", lowered)


@fleet_rule(
    "MC113",
    Severity.ERROR,
    "Two nodes have the same MAC address",
    why="""Bootstrap identifies factory-fresh devices by MAC address, and status maps observed MAC addresses to names.
    Two equal MAC addresses in one cell also break the mesh.""",
    fix="Read the MAC address from the device's label.",
    failing="""
    nodes:
      base: {mac: "00:15:6d:aa:00:01"}
      b01: {mac: "00:15:6D:AA:00:01"}
    """,
    passing="""
    nodes:
      base: {mac: "00:15:6d:aa:00:01"}
      b01: {mac: "00:15:6d:aa:00:02"}
    """,
)
def mac_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    yield from _collisions(fleet, _macs(fleet), "MAC address")


def _macs(fleet: Fleet) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every MAC address with its path; a device and its radio may have the same one."""
    for node in fleet.nodes.values():
        if node.mac:
            yield normal_mac(node.mac), ("nodes", node.name, "mac")
        for radio in node.radios:
            if radio.mac:
                yield normal_mac(radio.mac), ("nodes", node.name, "radios", radio.name, "mac")


@fleet_rule(
    "MC114",
    Severity.ERROR,
    "A MAC address is not a unicast address",
    why="""A group address (odd first octet), zero or malformed text never matches a real device, so bootstrap would
    refuse the right one.""",
    fix="Read the MAC address from the device's label.",
    failing="""nodes: {b01: {mac: "01:15:6d:aa:00:01"}}""",
    passing="""nodes: {b01: {mac: "00:15:6d:aa:00:01"}}""",
)
def mac_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        places: list[tuple[tuple[str, ...], str]] = [(("nodes", node.name, "mac"), node.mac)]
        places += [(("nodes", node.name, "radios", radio.name, "mac"), radio.mac) for radio in node.radios]
        for path, mac in places:
            if mac and not is_device_mac(mac):
                yield Finding(path, "not a unicast MAC address", "a unicast MAC such as 00:15:6d:12:34:56", mac)


def is_device_mac(mac: str) -> bool:
    """Whether it is six octets, not zero, and unicast (IEEE 802: the lowest bit of the first octet is clear)."""
    normal = normal_mac(mac)
    if _MAC.fullmatch(normal) is None:
        return False
    return not int(normal[:2], 16) & 1 and normal != "00:00:00:00:00:00"


@fleet_rule(
    "MC115",
    Severity.ERROR,
    "Two nodes have the same pinned SSH host key",
    why="""Either a line was copied, and the other node will be refused, or both run an image with a built-in key, and
    each can impersonate the other.""",
    fix="Run `meshctl trust NODE` for each; generate new host keys if the image contains one.",
    failing="""
    nodes:
      base: {host_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f"]}
      b01: {host_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f"]}
    """,
    passing="""
    nodes:
      b01: {host_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f"]}
    """,
)
def host_key_twice(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    # a key may be in both the inventory and known_hosts: count each node once
    for key, nodes in duplicates(dict.fromkeys(_host_keys(fleet, context))):
        first, *later = nodes
        for name in later:
            found = f"{key[:24]}...{key[-8:]}"
            pinned = [" ".join(text.split()[:2]) for text in fleet.nodes[name].host_keys]
            element = (str(pinned.index(key)),) if key in pinned else ()
            path = ("nodes", name, "host_keys", *element)
            yield Finding(path, f"{first} has the same host key", "a unique host key", found)


def _host_keys(fleet: Fleet, context: LintContext) -> Iterator[tuple[str, str]]:
    """Every pinned key as `TYPE BASE64`, with its node."""
    for node in fleet.nodes.values():
        for key in node.host_keys:
            yield " ".join(key.split()[:2]), node.name
    for pin in _pins(fleet, context) or ():
        for name in pin.names:
            if name in fleet.nodes and not pin.marker:
                yield pin.key.text, name


@fleet_rule(
    "MC116",
    Severity.ERROR,
    "Two nodes have the same label",
    why="People identify boxes by their label: with duplicates, the wrong beacon is deployed, flashed or written off.",
    fix="Give each node a unique label.",
    failing="nodes: {base: {label: B1}, b01: {label: B1}}",
    passing="nodes: {base: {label: BASE}, b01: {label: B1}}",
)
def label_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # a person, and a table's row, do not tell b1 from B1
    marks = ((node.label.casefold(), ("nodes", node.name, "label")) for node in fleet.managed() if node.label)
    for finding in _collisions(fleet, marks, "label"):
        yield replace(finding, found=fleet.nodes[finding.path[1]].label)


@fleet_rule(
    "MC117",
    Severity.ERROR,
    "Two nodes have the same serial number",
    why="One device cannot be two nodes; `replace` would pick the wrong one.",
    fix="Read the serial number from the device.",
    failing="nodes: {base: {serial: A1}, b01: {serial: A1}}",
    passing="nodes: {base: {serial: A1}, b01: {serial: A2}}",
)
def serial_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    marks = ((node.serial, ("nodes", node.name, "serial")) for node in fleet.nodes.values() if node.serial)
    yield from _collisions(fleet, marks, "serial number")


@fleet_rule(
    "MC118",
    Severity.NOTE,
    "Deployed nodes have neither MAC address nor serial number",
    why="""All factory-fresh devices answer at 192.168.1.1. Only a MAC address or a serial number prevents bootstrap and
    `replace` from writing a node's identity to the wrong box.""",
    fix="Add `mac` or `serial` from the device's label.",
    failing="nodes: {base: {mac: <removed>}}",
    passing="""nodes: {base: {serial: "UB-1234"}}""",
)
def no_physical_identity(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    bare = [
        node.name
        for node in _deployed(fleet)
        if not (node.mac or node.serial or any(radio.mac for radio in node.radios))
    ]
    if bare:
        yield Finding(
            ("nodes", bare[0]),
            "nodes cannot be matched to devices",
            "`mac` or `serial`",
            f"neither for {join_limited(bare)}",
        )


def _deployed(fleet: Fleet) -> Iterator[Node]:
    return (node for node in fleet.nodes.values() if node.state is NodeState.DEPLOYED)


@fleet_rule(
    "MC119",
    Severity.NOTE,
    "Host keys of deployed nodes are not pinned",
    why="""Without a pinned key, another device at the node's address cannot be detected. meshctl refuses to change a
    node that it cannot authenticate.""",
    fix="Run `meshctl trust NODE` once, over a trusted connection such as a cable on the bench.",
    failing="nodes: {base: {host_keys: <removed>}}",
    passing=Example(
        "nodes: {base: {host_keys: <removed>}}",
        files={"known_hosts": "base ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8A"},
    ),
)
def host_key_not_pinned(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    pinned = _pinned_names(fleet, context)
    strangers = [node.name for node in _deployed(fleet) if not node.host_keys and node.name not in pinned]
    if strangers and _HASHED not in pinned:
        found = f"none for {join_limited(strangers)}"
        expected = f"`host_keys`, or lines in {os.path.normpath(fleet.operators.known_hosts)}"
        yield Finding(("nodes", strangers[0]), "host keys cannot be verified", expected, found)


# prefix of hashed names in known_hosts: any node may be among them
_HASHED = "|1|"


def _pinned_names(fleet: Fleet, context: LintContext) -> set[str]:
    pins = _pins(fleet, context)
    if pins is None:
        return {_HASHED}
    names = (name for pin in pins if not pin.marker for name in pin.names)
    return {_HASHED if name.startswith(_HASHED) else name for name in names}


def _pins(fleet: Fleet, context: LintContext) -> tuple[Pin, ...] | None:
    """The lines of the fleet's known_hosts; None if it is invalid, which MC431 reports."""
    try:
        return parse_pins(context.files.text(known_hosts_path(fleet)) or "")
    except InputError:
        return None


@fleet_rule(
    "MC120",
    Severity.WARNING,
    "A robot and an unrelated node share a name",
    why="Commands accept robots and nodes by name: `meshctl run husky1` would reach a radio on another robot.",
    fix="Rename one of them, or assign the node to the robot.",
    failing="""
    nodes: {husky1: {role: beacon, address: 10.42.0.99}}
    """,
    passing="""
    nodes: {b99: {role: beacon, address: 10.42.0.99}}
    """,
)
def robot_and_node_share_name(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    shared = [name for name, robot in fleet.robots.items() if name in fleet.nodes and name not in robot.nodes]
    if len(shared) > _SINGLE_NAMES:
        # robots and radios with one scheme of names
        yield Finding(("robots", shared[0]), "unrelated nodes have the same names", "other names", join_limited(shared))
        return
    for name in shared:
        yield Finding(("robots", name), "an unrelated node has the same name", "another name", name)


@fleet_rule(
    "MC121",
    Severity.ERROR,
    "A robot's name is not a valid peer name",
    why="udp_mesh identifies peers by the robot's name (at most 63 bytes on the wire), and ROS topic names contain it.",
    fix="Use letters, digits, hyphens and underscores, starting with a letter.",
    failing="""
    nodes: {h2: {role: robot, address: 10.42.0.12}}
    robots: {2nd-husky: {nodes: [h2]}}
    """,
    passing="""
    nodes: {h2: {role: robot, address: 10.42.0.12}}
    robots: {husky2: {nodes: [h2]}}
    """,
)
def robot_name_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name in fleet.robots:
        if re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]{0,62}", name) is None:
            yield Finding(
                ("robots", name), "not a valid peer name", "a letter, then letters, digits, - and _, at most 63", name
            )


@fleet_rule(
    "MC122",
    Severity.WARNING,
    "A label is the name of another device",
    why="""Commands look for a name before a label: `meshctl deployed b02`, typed from the box in hand, marks the other
    node.""",
    fix="Use the node's own name as its label, or a label that no device has as its name.",
    failing="nodes: {base: {label: b01}}",
    passing="nodes: {b01: {label: b01}}",
)
def label_of_other(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    names = {name.casefold(): name for name in (*fleet.robots, *fleet.nodes)}
    for node in fleet.managed():
        other = names.get(node.label.casefold(), node.name) if node.label else node.name
        if other != node.name and other != node.robot:
            path = ("nodes", node.name, "label")
            yield Finding(path, f"{other} has it as its name", "a label that is no other device's name", node.label)
