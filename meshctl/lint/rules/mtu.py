"""The MTU budget of batman-adv and of fragments (MC505 to MC517)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.places import first_written
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.routing import batman_meshes
from meshctl.model import Fleet, Mesh

# batman-adv's header on a full Ethernet frame (openwrt-facts: 1500 + 32)
_BATMAN_BYTES = 32


# overhead that batman-adv checks the MTU against, network coding's header included: batadv_max_header_len()
_BATMAN_WARNS_BYTES = 60


# IEEE 802.11-2020 9.2.4.7.1: the largest MSDU, less the eight bytes of LLC and SNAP
_MAX_MTU = 2304 - 8


# headers of IPv4, UDP and udp_mesh, and the AEAD tag
_DATAGRAM_BYTES = 20 + 8 + 40


@fleet_rule(
    "MC505",
    Severity.ERROR,
    "Full frames exceed the MTU, and fragmentation is off",
    why="""batman-adv adds 32 bytes to each frame. With a smaller MTU on the radio and fragmentation off, small packets
    pass and large ones are dropped: ping works, video does not.""",
    fix="Set `mtu: 1560` (minimum 1532), or turn on `fragmentation`.",
    failing="meshes: {main: {mtu: 1500, batman: {fragmentation: false}}}",
    passing="meshes: {main: {mtu: 1560, batman: {fragmentation: false}}}",
)
def mtu_without_fragmentation(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in batman_meshes(fleet):
        if mesh.mtu < mesh.lan_mtu + _BATMAN_BYTES and not mesh.batman.fragmentation:
            yield _mtu_finding(fleet, mesh, "large frames are dropped")


@fleet_rule(
    "MC506",
    Severity.WARNING,
    "Full frames are fragmented",
    why="Every full frame is sent as two, at twice the cost and twice the chance of loss.",
    fix="Remove `mtu` (the default is 1560), or set at least 1532.",
    failing="meshes: {main: {mtu: 1500}}",
    passing="meshes: {main: {mtu: 1560}}",
)
def mtu_with_fragmentation(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in batman_meshes(fleet):
        if mesh.mtu < mesh.lan_mtu + _BATMAN_BYTES and mesh.batman.fragmentation:
            yield _mtu_finding(fleet, mesh, "full frames are fragmented")


def _mtu_finding(fleet: Fleet, mesh: Mesh, message: str) -> Finding:
    expected = f"at least {mesh.lan_mtu + _BATMAN_BYTES} ({mesh.lan_mtu} LAN + {_BATMAN_BYTES} batman-adv)"
    path = first_written(fleet, ("meshes", mesh.name, "mtu"), ("meshes", mesh.name, "lan_mtu"))
    return Finding(path, message, expected, str(mesh.mtu))


@fleet_rule(
    "MC507",
    Severity.ERROR,
    "The MTU exceeds what a radio can carry",
    why="""An 802.11 frame carries at most 2304 bytes: the kernel rejects the MTU, and netifd does not bring up the
    interface.""",
    fix="Remove `mtu` (the default is 1560), or set 1532 to 2296.",
    failing="meshes: {main: {mtu: 4000}}",
    passing="meshes: {main: {mtu: 2000}}",
)
def mtu_too_large(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mtu > _MAX_MTU:
            path = ("meshes", mesh.name, "mtu")
            yield Finding(path, "exceeds an 802.11 frame", f"at most {_MAX_MTU}", str(mesh.mtu))


@fleet_rule(
    "MC508",
    Severity.ERROR,
    "A udp_mesh fragment exceeds the LAN's MTU",
    why="IP splits each datagram again: losing one half loses the whole, and a split broadcast may not arrive at all.",
    fix="Lower `udp_mesh.fragment_bytes` to 1400, or to the LAN's MTU minus 68.",
    failing="udp_mesh: {fragment_bytes: 1480}",
    passing="udp_mesh: {fragment_bytes: 1400}",
)
def fragment_too_large(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if not fleet.meshes or not any(robot.computer is not None for robot in fleet.robots.values()):
        return
    mesh = min(fleet.meshes.values(), key=lambda mesh: mesh.lan_mtu)
    room = mesh.lan_mtu - _DATAGRAM_BYTES
    if fleet.udp_mesh.fragment_bytes > room:
        message = f"IP would fragment it: the LAN of mesh {mesh.name} has an MTU of {mesh.lan_mtu}"
        expected = f"at most {room} ({mesh.lan_mtu} - {_DATAGRAM_BYTES} for IP, UDP and udp_mesh headers)"
        path = first_written(fleet, ("udp_mesh", "fragment_bytes"), ("meshes", mesh.name, "lan_mtu"))
        yield Finding(path, message, expected, str(fleet.udp_mesh.fragment_bytes))


@fleet_rule(
    "MC517",
    Severity.NOTE,
    "batman-adv warns about the MTU",
    why="""Full frames fit, but batman-adv also counts the network coding header: below the LAN's MTU + 60 it logs "The
    MTU of interface mesh0 is too small" at each activation, although nothing is wrong.""",
    fix="Remove `mtu`: the default is 1560, and mac80211 radios such as ath9k carry up to 2304.",
    failing="meshes: {main: {mtu: 1536}}",
    passing="meshes: {main: {mtu: 1560}}",
)
def mtu_warned_of(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in batman_meshes(fleet):
        least = mesh.lan_mtu + _BATMAN_WARNS_BYTES
        if mesh.lan_mtu + _BATMAN_BYTES <= mesh.mtu < least:
            path = first_written(fleet, ("meshes", mesh.name, "mtu"), ("meshes", mesh.name, "lan_mtu"))
            expected = f"at least {least} ({mesh.lan_mtu} LAN + {_BATMAN_WARNS_BYTES})"
            yield Finding(path, "works, but batman-adv logs a warning at each activation", expected, str(mesh.mtu))
