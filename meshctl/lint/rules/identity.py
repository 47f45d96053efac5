"""Names and marks that must tell nodes apart: hostnames, MACs, host keys, labels, serials (MC110 to MC121)."""

from __future__ import annotations

import os.path
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from meshctl.device.trust import Pin, parse_pins
from meshctl.diagnostics import Severity
from meshctl.errors import InputError
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates, join_limited
from meshctl.lint.places import is_written
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Fleet, Node, NodeState

# one label of a host name: RFC 1123 section 2.1 and RFC 952, at most 63 octets (RFC 1035 section 2.3.4)
_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?")
_MAC = re.compile(r"[0-9a-f]{2}(:[0-9a-f]{2}){5}")


def normal_mac(mac: str) -> str:
    """Lower case with colons."""
    return mac.strip().lower().replace("-", ":")


def _collisions(fleet: Fleet, marks: Iterable[tuple[str, tuple[str, ...]]], what: str) -> Iterator[Finding]:
    """One finding for every node but one that has a mark of another. A mark stands at a path that begins with the node.

    The one without a finding is the first whose mark is not written (a host name that is the node's own name), or
    else the first of all.
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
                yield Finding(path, f"{innocent[1]} has the same {what}", f"a {what} of its own", mark)


@fleet_rule(
    "MC110",
    Severity.ERROR,
    "Two nodes have the same hostname",
    why="Logs, prompts and `batctl` name nodes by hostname: the operator restarts the wrong one.",
    fix="Give each node a hostname of its own, or leave it out: the node's name serves.",
    failing="nodes: {b01: {hostname: base}}",
    passing="nodes: {b01: {hostname: beacon-1}}",
)
def hostname_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    marks = ((node.hostname.lower(), ("nodes", node.name, "hostname")) for node in fleet.managed())
    yield from _collisions(fleet, marks, "hostname")


@fleet_rule(
    "MC111",
    Severity.ERROR,
    "A hostname is not valid",
    why="""OpenWrt hands the name to the kernel and to syslog; one with an underscore, a dot or an umlaut is refused
    there, cut, or not found by any resolver (RFC 1123).""",
    fix="Use letters, digits and inner hyphens, at most 63 of them.",
    failing="nodes: {b01: {hostname: beacon_1}}",
    passing="nodes: {b01: {hostname: beacon-1}}",
)
def hostname_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        if _LABEL.fullmatch(node.hostname) is None:
            path = ("nodes", node.name, "hostname")
            yield Finding(path, "not a hostname", "letters, digits and inner hyphens, at most 63", node.hostname)


@fleet_rule(
    "MC112",
    Severity.WARNING,
    "Names differ in nothing but capitals",
    why="Hostnames, known_hosts and file systems of laptops treat `B01` and `b01` as one.",
    fix="Rename one of them.",
    failing="nodes: {B01: {address: 10.42.0.99, hostname: other, role: beacon}}",
    passing="nodes: {b99: {address: 10.42.0.99, hostname: other, role: beacon}}",
)
def names_by_case(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for section, every in (("nodes", fleet.nodes), ("robots", fleet.robots), ("meshes", fleet.meshes)):
        for lowered, names in duplicates((name.lower(), name) for name in every):
            for name in names[1:]:
                yield Finding((section, name), f"differs from {names[0]} in capitals only", "another name", lowered)


@fleet_rule(
    "MC113",
    Severity.ERROR,
    "Two nodes have the same MAC address",
    why="""The MAC is how bootstrap knows one factory device from another and how status joins what radios hear to
    names; two alike in one cell also break the mesh itself.""",
    fix="Read the MAC off the device's label.",
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
    """Every MAC with its place; a device's own and its radio's may be one and the same."""
    for node in fleet.nodes.values():
        if node.mac:
            yield normal_mac(node.mac), ("nodes", node.name, "mac")
        for radio in node.radios:
            if radio.mac:
                yield normal_mac(radio.mac), ("nodes", node.name, "radios", radio.name, "mac")


@fleet_rule(
    "MC114",
    Severity.ERROR,
    "A MAC address is no device's",
    why="""A group address (an odd first byte), zero, or text that is no MAC never matches a real device, so bootstrap
    would refuse the right one.""",
    fix="Read the MAC off the device's label.",
    failing="""nodes: {b01: {mac: "01:15:6d:aa:00:01"}}""",
    passing="""nodes: {b01: {mac: "00:15:6d:aa:00:01"}}""",
)
def mac_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        places: list[tuple[tuple[str, ...], str]] = [(("nodes", node.name, "mac"), node.mac)]
        places += [(("nodes", node.name, "radios", radio.name, "mac"), radio.mac) for radio in node.radios]
        for path, mac in places:
            if mac and not is_device_mac(mac):
                yield Finding(path, "not a device's MAC address", "a unicast MAC such as 00:15:6d:12:34:56", mac)


def is_device_mac(mac: str) -> bool:
    """Whether it is six octets, not zero, and unicast (IEEE 802: the lowest bit of the first octet is clear)."""
    normal = normal_mac(mac)
    if _MAC.fullmatch(normal) is None:
        return False
    return not int(normal[:2], 16) & 1 and normal != "00:00:00:00:00:00"


@fleet_rule(
    "MC115",
    Severity.ERROR,
    "Two nodes are pinned to the same SSH host key",
    why="""Either one line was copied, and the other node will be refused, or both run an image with a key baked in, and
    each can pass for the other.""",
    fix="Run `meshctl trust NODE` for each; make new host keys where an image brought its own.",
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
    # a key may stand both in the inventory and in known_hosts: each node counts once
    for key, nodes in duplicates(dict.fromkeys(_host_keys(fleet, context))):
        first, *later = nodes
        for name in later:
            found = f"{key[:24]}...{key[-8:]}"
            pinned = [" ".join(text.split()[:2]) for text in fleet.nodes[name].host_keys]
            element = (str(pinned.index(key)),) if key in pinned else ()
            path = ("nodes", name, "host_keys", *element)
            yield Finding(path, f"{first} has the same host key", "a key of its own", found)


def _host_keys(fleet: Fleet, context: LintContext) -> Iterator[tuple[str, str]]:
    """Every pinned key as `TYPE BASE64`, with the node it is pinned for."""
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
    "Two nodes wear the same label",
    why="""The label is what a person reads off the box in the rack: with two alike, the wrong beacon is dropped,
    flashed or written off.""",
    fix="Print labels that differ.",
    failing="nodes: {base: {label: B1}, b01: {label: B1}}",
    passing="nodes: {base: {label: BASE}, b01: {label: B1}}",
)
def label_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    marks = ((node.label, ("nodes", node.name, "label")) for node in fleet.managed() if node.label)
    yield from _collisions(fleet, marks, "label")


@fleet_rule(
    "MC117",
    Severity.ERROR,
    "Two nodes have the same serial number",
    why="One device cannot be two nodes; `replace` would take the wrong one out of the box.",
    fix="Read the serial number off the device.",
    failing="nodes: {base: {serial: A1}, b01: {serial: A1}}",
    passing="nodes: {base: {serial: A1}, b01: {serial: A2}}",
)
def serial_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    marks = ((node.serial, ("nodes", node.name, "serial")) for node in fleet.nodes.values() if node.serial)
    yield from _collisions(fleet, marks, "serial number")


@fleet_rule(
    "MC118",
    Severity.NOTE,
    "Deployed nodes have no physical identity",
    why="""On the bench all devices answer at 192.168.1.1. Only a MAC or a serial number keeps bootstrap and `replace`
    from writing one node's identity onto another box.""",
    fix="Write down `mac` or `serial` from the sticker.",
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
            "nothing ties them to a device",
            "`mac` or `serial`",
            f"neither for {join_limited(bare)}",
        )


def _deployed(fleet: Fleet) -> Iterator[Node]:
    return (node for node in fleet.nodes.values() if node.state is NodeState.DEPLOYED)


@fleet_rule(
    "MC119",
    Severity.NOTE,
    "Host keys of deployed nodes are not pinned",
    why="Whoever answers first at the address is believed. meshctl refuses to change a node it cannot recognise.",
    fix="Run `meshctl trust NODE` once, on the bench, where nobody can stand between.",
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
        expected = f"`host_keys`, or lines in {fleet.operators.known_hosts}"
        yield Finding(("nodes", strangers[0]), "any device is believed", expected, found)


# stands for names that known_hosts holds as hashes only: any node may be among them
_HASHED = "|1|"


def _pinned_names(fleet: Fleet, context: LintContext) -> set[str]:
    pins = _pins(fleet, context)
    if pins is None:
        return {_HASHED}
    names = (name for pin in pins if not pin.marker for name in pin.names)
    return {_HASHED if name.startswith(_HASHED) else name for name in names}


def _pins(fleet: Fleet, context: LintContext) -> tuple[Pin, ...] | None:
    """The lines of the fleet's known_hosts, None when it cannot be read (a rule of its own says why)."""
    try:
        return parse_pins(context.files.text(known_hosts_path(fleet)) or "")
    except InputError:
        return None


def known_hosts_path(fleet: Fleet) -> Path:
    """Where the fleet's pinned host keys are: beside the inventory, unless the path is absolute."""
    return Path(fleet.base or ".", os.path.expanduser(fleet.operators.known_hosts))


@fleet_rule(
    "MC120",
    Severity.WARNING,
    "A robot and a node share a name, and the node is not the robot's",
    why="Commands take robots and nodes by name: `meshctl run husky1` would reach a radio that rides elsewhere.",
    fix="Rename one of them, or put the node on the robot.",
    failing="""
    nodes: {husky1: {role: beacon, address: 10.42.0.99}}
    """,
    passing="""
    nodes: {b99: {role: beacon, address: 10.42.0.99}}
    """,
)
def robot_and_node_share_name(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, robot in fleet.robots.items():
        if name in fleet.nodes and name not in robot.nodes:
            yield Finding(("robots", name), "a node that is not this robot's has the same name", "another name", name)


@fleet_rule(
    "MC121",
    Severity.ERROR,
    "A robot's name cannot be a peer's name",
    why="udp_mesh knows peers by the robot's name, at most 63 bytes on the wire, and ROS topics are named after it.",
    fix="Use letters, digits, hyphens and underscores, a letter first.",
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
                ("robots", name), "not a peer's name", "a letter, then letters, digits, - and _, at most 63", name
            )
