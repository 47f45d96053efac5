"""batman-adv: options, intervals, airtime of originator messages, MTU budget (MC501 to MC517)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key, join_limited
from meshctl.lint.places import first_written
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Backend, Fleet, Mesh, NodeState
from meshctl.resolve import MEASURED_HEAL_S, UnreachableTarget, batman_intervals, heal_s, originator_airtime

# batman-adv's header around a full Ethernet frame (openwrt-facts: 1500 + 32)
_BATMAN_BYTES = 32
# what batman-adv compares the MTU with, network coding's header included: batadv_max_header_len()
_BATMAN_WARNS_BYTES = 60
# IEEE 802.11-2020 9.2.4.7.1: the largest MSDU, less the eight bytes of LLC and SNAP
_MAX_MTU = 2304 - 8
# IPv4 and UDP around a fragment of udp_mesh, and its own header and tag
_DATAGRAM_BYTES = 20 + 8 + 40
# shares of the channel: from the first the cost is shown, from the second it is felt, the third eats the channel
_AIRTIME_NOTE = 0.03
_AIRTIME_WARNING = 0.10
_AIRTIME_ERROR = 0.30


MESHMERIZE = """
meshes: {main: {backend: meshmerize, operator_parts:
  {templates: parts, service: meshmerized, interface: mm0, status_command: mm-status, packages: [meshmerize]}}}
"""
PARTS = {"parts/etc/config/meshmerize.j2": "config meshmerize\n\toption enabled '1'\n"}


def _batman_meshes(fleet: Fleet) -> Iterator[Mesh]:
    return (mesh for mesh in fleet.meshes.values() if mesh.backend is Backend.BATMAN)


@fleet_rule(
    "MC501",
    Severity.ERROR,
    "Originator messages would eat the channel",
    why="""Every node sends its originator message once an interval and repeats everyone else's: the cost grows with the
    square of the number of nodes, at the broadcast rate. Past a third of the channel little is left for data, messages
    collide, and routes flap exactly when all robots stand together at the start.""",
    fix="Ask for a longer `reconnect_s`, raise `mcast_rate_kbps`, keep `aggregated_ogms` on, or split the mesh.",
    failing="""
    meshes: {main: {reconnect_s: 0.6}}
    nodes: {"c[01-60]": {state: carried, address: {from: 10.42.0.121}}}
    robots: {husky1: {carries: ["c[01-60]", b01]}}
    """,
    passing="""
    meshes: {main: {reconnect_s: 5}}
    nodes: {"c[01-05]": {state: carried, address: {from: 10.42.0.121}}}
    robots: {husky1: {carries: ["c[01-05]", b01]}}
    """,
)
def originators_eat_channel(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    yield from _airtime(fleet, _AIRTIME_ERROR, float("inf"))


@fleet_rule(
    "MC502",
    Severity.WARNING,
    "Originator messages take much of the channel",
    why="""A tenth of the air and more goes to routing before anybody says anything. It is worst where all nodes hear
    each other: at the start, with every beacon still in its rack.""",
    fix="Ask for a longer `reconnect_s`, raise `mcast_rate_kbps`, or keep `aggregated_ogms` on.",
    failing="""
    meshes: {main: {reconnect_s: 5}}
    nodes: {"c[01-40]": {state: carried, address: {from: 10.42.0.121}}}
    robots: {husky1: {carries: ["c[01-40]", b01]}}
    """,
    passing="""
    meshes: {main: {reconnect_s: 5}}
    nodes: {"c[01-05]": {state: carried, address: {from: 10.42.0.121}}}
    robots: {husky1: {carries: ["c[01-05]", b01]}}
    """,
)
def originators_take_much(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    yield from _airtime(fleet, _AIRTIME_WARNING, _AIRTIME_ERROR)


def _airtime(fleet: Fleet, least: float, most: float) -> Iterator[Finding]:
    on_air = (node for node in fleet.managed() if node.state is not NodeState.SPARE)
    members = group_by_key((mesh, node.name) for node in on_air for mesh in node.meshes)
    for mesh in _batman_meshes(fleet):
        nodes = len(members.get(mesh.name, []))
        try:
            interval_ms = batman_intervals(mesh).orig_interval_ms
        except UnreachableTarget:
            continue
        options = mesh.batman
        share = originator_airtime(nodes, interval_ms, mesh.mcast_rate_kbps, is_aggregated=options.aggregated_ogms)
        if least <= share < most:
            message = f"{nodes} nodes, each {interval_ms} ms, at {mesh.mcast_rate_kbps} kbit/s"
            found = f"{share:.0%} of the channel"
            written = options.orig_interval_ms is not None
            key = ("batman", "orig_interval_ms") if written else ("reconnect_s",)
            path = ("meshes", mesh.name, *key)
            expected = "" if least == _AIRTIME_NOTE else f"less than {least:.0%}"
            yield Finding(path, message, expected, found)


@fleet_rule(
    "MC503",
    Severity.ERROR,
    "The wanted reconnect time cannot be had",
    why="""The fastest interval that was measured on the kernel's batman-adv heals a cut in 0.6 s; nothing can be
    rendered for a shorter wish.""",
    fix="Ask for at least 0.6 s, and for no less than the robots need: every halving doubles the routing's airtime.",
    failing="meshes: {main: {reconnect_s: 0.2}}",
    passing="meshes: {main: {reconnect_s: 2.5}}",
)
def reconnect_unreachable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in _batman_meshes(fleet):
        try:
            batman_intervals(mesh)
        except UnreachableTarget as target:
            path = ("meshes", mesh.name, "reconnect_s")
            yield Finding(path, "never measured", f"at least {target.fastest_s:g} s", f"{mesh.reconnect_s:g} s")


@fleet_rule(
    "MC504",
    Severity.WARNING,
    "The written interval misses the wanted reconnect time",
    why="`orig_interval_ms` overrules `reconnect_s`: the fleet heals more slowly than the inventory promises.",
    fix="Take `orig_interval_ms` away, or bring `reconnect_s` in line with it.",
    failing="meshes: {main: {reconnect_s: 2, batman: {orig_interval_ms: 1000}}}",
    passing="meshes: {main: {reconnect_s: 5, batman: {orig_interval_ms: 1000}}}",
)
def interval_misses_target(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    fastest = min(MEASURED_HEAL_S.values())
    for mesh in _batman_meshes(fleet):
        written = mesh.batman.orig_interval_ms
        if written is not None and max(mesh.reconnect_s, fastest) < heal_s(written):
            path = ("meshes", mesh.name, "batman", "orig_interval_ms")
            expected = f"healing within {mesh.reconnect_s:g} s"
            yield Finding(
                path, "slower than reconnect_s", expected, f"{written} ms, which heals in {heal_s(written):.2g} s"
            )


@fleet_rule(
    "MC505",
    Severity.ERROR,
    "Full frames do not fit and may not be split",
    why="""batman-adv puts 32 bytes around each frame. With a smaller MTU on the radio and fragmentation off, small
    messages pass and large ones vanish: ping works, the video does not.""",
    fix="Set `mtu: 1560` (1532 is the minimum), or turn `fragmentation` on.",
    failing="meshes: {main: {mtu: 1500, batman: {fragmentation: false}}}",
    passing="meshes: {main: {mtu: 1560, batman: {fragmentation: false}}}",
)
def mtu_without_fragmentation(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in _batman_meshes(fleet):
        if mesh.mtu < mesh.lan_mtu + _BATMAN_BYTES and not mesh.batman.fragmentation:
            yield _mtu_finding(fleet, mesh, "large frames vanish")


@fleet_rule(
    "MC506",
    Severity.WARNING,
    "Full frames are split in two",
    why="Every full frame goes over the air as two, at twice the cost and twice the chance of loss.",
    fix="Remove `mtu` (the default is 1560), or set 1532 at least.",
    failing="meshes: {main: {mtu: 1500}}",
    passing="meshes: {main: {mtu: 1560}}",
)
def mtu_with_fragmentation(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in _batman_meshes(fleet):
        if mesh.mtu < mesh.lan_mtu + _BATMAN_BYTES and mesh.batman.fragmentation:
            yield _mtu_finding(fleet, mesh, "full frames are split")


def _mtu_finding(fleet: Fleet, mesh: Mesh, message: str) -> Finding:
    expected = f"at least {mesh.lan_mtu + _BATMAN_BYTES} ({mesh.lan_mtu} LAN + {_BATMAN_BYTES} batman-adv)"
    path = first_written(fleet, ("meshes", mesh.name, "mtu"), ("meshes", mesh.name, "lan_mtu"))
    return Finding(path, message, expected, str(mesh.mtu))


@fleet_rule(
    "MC507",
    Severity.ERROR,
    "The MTU is larger than a radio can carry",
    why="""An 802.11 frame holds at most 2304 bytes: the kernel refuses the MTU, and netifd does not bring the interface
    up.""",
    fix="Remove `mtu` (the default is 1560), or set 1532 to 2296.",
    failing="meshes: {main: {mtu: 4000}}",
    passing="meshes: {main: {mtu: 2000}}",
)
def mtu_too_large(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mtu > _MAX_MTU:
            path = ("meshes", mesh.name, "mtu")
            yield Finding(path, "no 802.11 frame holds it", f"at most {_MAX_MTU}", str(mesh.mtu))


@fleet_rule(
    "MC508",
    Severity.ERROR,
    "A fragment of udp_mesh does not fit the LAN's MTU",
    why="""Each fragment is split again by IP; one lost half loses the whole, and a broadcast of it may not arrive at
    all.""",
    fix="Lower `udp_mesh.fragment_bytes` to 1400, or to the LAN's MTU less 68.",
    failing="udp_mesh: {fragment_bytes: 1480}",
    passing="udp_mesh: {fragment_bytes: 1400}",
)
def fragment_too_large(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if not fleet.meshes or not any(robot.computer is not None for robot in fleet.robots.values()):
        return
    mesh = min(fleet.meshes.values(), key=lambda mesh: mesh.lan_mtu)
    room = mesh.lan_mtu - _DATAGRAM_BYTES
    if fleet.udp_mesh.fragment_bytes > room:
        message = f"IP would split it: mesh {mesh.name} has a LAN of {mesh.lan_mtu} bytes"
        expected = f"at most {room} ({mesh.lan_mtu} - {_DATAGRAM_BYTES} for IP, UDP and the seal)"
        path = first_written(fleet, ("udp_mesh", "fragment_bytes"), ("meshes", mesh.name, "lan_mtu"))
        yield Finding(path, message, expected, str(fleet.udp_mesh.fragment_bytes))


@fleet_rule(
    "MC509",
    Severity.WARNING,
    "The hop penalty is extreme",
    why="""Without a penalty routes wander between ways of equal quality; with a large one the mesh prefers one long
    weak link to two good ones.""",
    fix="Keep 30, or stay between 5 and 100.",
    failing="meshes: {main: {batman: {hop_penalty: 0}}}",
    passing="meshes: {main: {batman: {hop_penalty: 15}}}",
)
def hop_penalty_extreme(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in _batman_meshes(fleet):
        if not 5 <= mesh.batman.hop_penalty <= 100:
            path = ("meshes", mesh.name, "batman", "hop_penalty")
            yield Finding(path, "routes wander or reach too far", "5 to 100", str(mesh.batman.hop_penalty))


@fleet_rule(
    "MC510",
    Severity.WARNING,
    "Originator messages are not aggregated",
    why="Each goes out in a frame of its own, and the frame costs more air than the message.",
    fix="Set `aggregated_ogms: true`.",
    failing="meshes: {main: {batman: {aggregated_ogms: false}}}",
    passing="meshes: {main: {batman: {aggregated_ogms: true}}}",
)
def originators_not_aggregated(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in _batman_meshes(fleet):
        if not mesh.batman.aggregated_ogms:
            path = ("meshes", mesh.name, "batman", "aggregated_ogms")
            yield Finding(path, "each message takes a frame of its own", "true", "false")


@fleet_rule(
    "MC511",
    Severity.WARNING,
    "Every node announces itself as a gateway",
    why="""`gw_mode: server` holds for all nodes of the mesh: each offers an uplink it does not have, and DHCP requests
    go to the nearest of them.""",
    fix="Leave `gw_mode: off`; give nodes a `gateway` where there is one.",
    failing="meshes: {main: {batman: {gw_mode: server}}}",
    passing="meshes: {main: {batman: {gw_mode: 'off'}}}",
)
def all_gateways(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in _batman_meshes(fleet):
        if mesh.batman.gw_mode == "server":
            path = ("meshes", mesh.name, "batman", "gw_mode")
            yield Finding(path, "holds for every node of the mesh", "off", mesh.batman.gw_mode)


@fleet_rule(
    "MC512",
    Severity.WARNING,
    "ELP intervals without BATMAN_V",
    why="""Only BATMAN_V probes links with ELP. Under BATMAN_IV the option is read and does nothing: whoever set it
    meant another algorithm.""",
    fix="Set `routing_algo: BATMAN_V`, or take `elp_interval_ms` away.",
    failing="meshes: {main: {batman: {elp_interval_ms: 250}}}",
    passing="meshes: {main: {batman: {routing_algo: BATMAN_V, elp_interval_ms: 250}}}",
)
def elp_without_batman_v(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in _batman_meshes(fleet):
        if mesh.batman.elp_interval_ms is not None and mesh.batman.routing_algo != "BATMAN_V":
            path = ("meshes", mesh.name, "batman", "elp_interval_ms")
            found = mesh.batman.routing_algo
            yield Finding(path, "does nothing without BATMAN_V", "routing_algo: BATMAN_V", found)


@fleet_rule(
    "MC513",
    Severity.ERROR,
    "Meshes of one network have different routing options",
    why="""Cells of one network share one batman-adv interface, which has one set of options: the first mesh's hold, and
    what is written at the other is not done.""",
    fix="Write the same `batman` options at both meshes, or give them networks of their own.",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.42.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}, batman: {hop_penalty: 50}}
    nodes: {base: {radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    """,
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.42.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    """,
)
def options_of_one_interface(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    sharing = group_by_key(((mesh.network, mesh.batman.routing_algo), mesh) for mesh in _batman_meshes(fleet))
    for first, *others in sharing.values():
        for mesh in others:
            # intervals follow from reconnect_s, the shortest of the group is taken
            options = replace(mesh.batman, orig_interval_ms=None, elp_interval_ms=None)
            if options != replace(first.batman, orig_interval_ms=None, elp_interval_ms=None):
                message = f"mesh {first.name} shares its routing interface and has other options"
                yield Finding(("meshes", mesh.name, "batman"), message, "the same options", "others")


@fleet_rule(
    "MC514",
    Severity.ERROR,
    "A node joins meshes of different back ends",
    why="The bridge and the services of a node belong to one back end; two would fight over the LAN.",
    fix="Use one back end for all meshes of a node.",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}, backend: meshmerize, operator_parts:
               {templates: parts, service: mm, interface: mm0, status_command: mm-status, packages: [mm]}}
    nodes: {base: {radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    """,
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    """,
)
def back_ends_mixed(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        names = [name for name in node.meshes if name in fleet.meshes]
        ends = dict.fromkeys(fleet.meshes[name].backend.value for name in names)
        if len(ends) > 1:
            yield Finding(
                ("nodes", node.name, "radios"), "meshes of one back end only", "one", join_limited(list(ends))
            )


@fleet_rule(
    "MC515",
    Severity.ERROR,
    "The operator's parts of the back end are incomplete",
    why="""meshmerize has no public package, configuration or status: meshctl renders and observes only what the
    operator supplies. Without a service it is never started, without an interface the robots are not bridged to it.""",
    fix="Fill in `operator_parts`: templates, service, interface, status_command, and packages or package_files.",
    failing="meshes: {main: {backend: meshmerize, operator_parts: {service: meshmerized}}}",
    passing=Example(MESHMERIZE, files=PARTS),
)
def operator_parts_incomplete(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        parts = mesh.operator_parts
        if mesh.backend is not Backend.MESHMERIZE:
            continue
        given = {
            "templates": parts.templates,
            "service": parts.service,
            "interface": parts.interface,
            "status_command": parts.status_command,
            "packages or package_files": parts.packages or parts.package_files,
        }
        missing = [name for name, value in given.items() if not value]
        if missing:
            path = ("meshes", mesh.name, "operator_parts")
            yield Finding(path, "meshmerize needs more", "all parts", f"no {', no '.join(missing)}")


@fleet_rule(
    "MC516",
    Severity.NOTE,
    "What originator messages cost",
    why="""Routing needs some of the air. The share is for all nodes in one place, at the intervals that `reconnect_s`
    asks for; it grows with the square of the number of nodes, so it is worth knowing before beacons are added.""",
    fix="Nothing needs to be done; MC502 warns from a tenth of the channel on.",
    failing="""
    nodes: {"c[01-20]": {state: carried, address: {from: 10.42.0.121}}}
    robots: {husky1: {carries: ["c[01-20]", b01]}}
    """,
    passing="""
    nodes: {"c[01-05]": {state: carried, address: {from: 10.42.0.121}}}
    robots: {husky1: {carries: ["c[01-05]", b01]}}
    """,
)
def originators_cost(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    yield from _airtime(fleet, _AIRTIME_NOTE, _AIRTIME_WARNING)


@fleet_rule(
    "MC517",
    Severity.NOTE,
    "batman-adv warns of the MTU",
    why="""Full frames fit, but batman-adv also counts the header of network coding: below the LAN's MTU + 60, it logs
    "The MTU of interface mesh0 is too small" at each activation, and the next operator looks for a fault that is
    none.""",
    fix="Remove `mtu`: the default is 1560, and mac80211 radios such as ath9k carry up to 2304.",
    failing="meshes: {main: {mtu: 1536}}",
    passing="meshes: {main: {mtu: 1560}}",
)
def mtu_warned_of(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in _batman_meshes(fleet):
        least = mesh.lan_mtu + _BATMAN_WARNS_BYTES
        if mesh.lan_mtu + _BATMAN_BYTES <= mesh.mtu < least:
            path = first_written(fleet, ("meshes", mesh.name, "mtu"), ("meshes", mesh.name, "lan_mtu"))
            expected = f"at least {least} ({mesh.lan_mtu} LAN + {_BATMAN_WARNS_BYTES})"
            yield Finding(path, "works, with a warning at each activation", expected, str(mesh.mtu))
