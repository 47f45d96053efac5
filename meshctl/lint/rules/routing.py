"""batman-adv: options, intervals, airtime of originator messages (MC501 to MC516)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Backend, Fleet, Mesh, NodeState
from meshctl.resolve import (
    LONGEST_MEASURED_MS,
    MEASURED_HEAL_S,
    UnreachableTarget,
    batman_intervals,
    heal_s,
    originator_airtime,
)
from meshctl.wording import counted, join_limited, two_digits

# airtime shares from which MC516, MC502 and MC501 report
_AIRTIME_NOTE = 0.03
_AIRTIME_WARNING = 0.10
_AIRTIME_ERROR = 0.30
_MAX_INTERVAL_MS = 60_000  # of `orig_interval_ms`


MESHMERIZE = """
meshes: {main: {backend: meshmerize, operator_parts:
  {templates: parts, service: meshmerized, interface: mm0, status_command: mm-status, packages: [meshmerize]}}}
"""
PARTS = {"parts/etc/config/meshmerize.j2": "config meshmerize\n\toption enabled '1'\n"}


def batman_meshes(fleet: Fleet) -> Iterator[Mesh]:
    return (mesh for mesh in fleet.meshes.values() if mesh.backend is Backend.BATMAN)


@fleet_rule(
    "MC501",
    Severity.ERROR,
    "Originator messages would saturate the channel",
    why="""Every node sends one originator message per interval and repeats everyone else's, at the multicast rate: the
    cost grows with the square of the number of nodes. Above a third of the channel little is left for data, messages
    collide, and routes flap exactly when all robots are together at the start.""",
    fix="Increase `reconnect_s`, raise `mcast_rate_kbps`, keep `aggregated_ogms` on, or split the mesh.",
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
    yield from _airtime_findings(fleet, _AIRTIME_ERROR, float("inf"))


@fleet_rule(
    "MC502",
    Severity.WARNING,
    "Originator messages take much of the channel",
    why="""At least a tenth of the airtime goes to routing. The worst case is the start, where all nodes hear each
    other, including every beacon in its rack.""",
    fix="Increase `reconnect_s`, raise `mcast_rate_kbps`, or keep `aggregated_ogms` on.",
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
    yield from _airtime_findings(fleet, _AIRTIME_WARNING, _AIRTIME_ERROR)


def _airtime_findings(fleet: Fleet, least: float, most: float) -> Iterator[Finding]:
    on_air = (node for node in fleet.managed() if node.state is not NodeState.SPARE)
    members = group_by_key((mesh, node.name) for node in on_air for mesh in node.meshes)
    for mesh in batman_meshes(fleet):
        nodes = len(members.get(mesh.name, []))
        try:
            interval_ms = batman_intervals(mesh).orig_interval_ms
        except UnreachableTarget:
            continue
        options = mesh.batman
        share = originator_airtime(nodes, interval_ms, mesh.mcast_rate_kbps, is_aggregated=options.aggregated_ogms)
        if least <= share < most:
            message = f"{counted(nodes, 'node')}, one message per {interval_ms} ms, at {mesh.mcast_rate_kbps} kbit/s"
            found = f"{share:.0%} of the channel"
            written = options.orig_interval_ms is not None
            key = ("batman", "orig_interval_ms") if written else ("reconnect_s",)
            path = ("meshes", mesh.name, *key)
            if least == _AIRTIME_NOTE:
                yield Finding(path, message, found=found)
                continue
            # `reconnect_s` has no effect beside `orig_interval_ms`; alone it selects at most the longest measured
            hint = _longer_interval(nodes, interval_ms, mesh) if written or interval_ms == LONGEST_MEASURED_MS else ""
            yield Finding(path, message, f"less than {least:.0%}", found, hint)


def _longer_interval(nodes: int, interval_ms: int, mesh: Mesh) -> str:
    """The advice to set the shortest interval, in steps of 100 ms, with which MC502 does not warn."""
    others = "raise `mcast_rate_kbps`, keep `aggregated_ogms` on, or split the mesh."
    for longer_ms in range(interval_ms // 100 * 100 + 100, _MAX_INTERVAL_MS + 1, 100):
        share = originator_airtime(nodes, longer_ms, mesh.mcast_rate_kbps, is_aggregated=mesh.batman.aggregated_ogms)
        if share < _AIRTIME_WARNING:
            target_s = math.ceil(heal_s(longer_ms) * 10) / 10
            return (
                f"Set `batman: {{orig_interval_ms: {longer_ms}}}` and `reconnect_s: {target_s:g}` or more "
                f"(`reconnect_s` alone selects at most {LONGEST_MEASURED_MS} ms), {others}"
            )
    return others[0].upper() + others[1:]


@fleet_rule(
    "MC503",
    Severity.ERROR,
    "The reconnect time is not achievable",
    why="""The shortest interval measured on the kernel's batman-adv heals a broken link in 0.6 s; no configuration
    exists for a shorter time.""",
    fix="Use at least 0.6 s, and no less than the robots need: every halving doubles the routing airtime.",
    failing="meshes: {main: {reconnect_s: 0.2}}",
    passing="meshes: {main: {reconnect_s: 2.5}}",
)
def reconnect_unreachable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in batman_meshes(fleet):
        try:
            batman_intervals(mesh)
        except UnreachableTarget as target:
            path = ("meshes", mesh.name, "reconnect_s")
            yield Finding(
                path,
                "shorter than any measured reconnect time",
                f"at least {target.fastest_s:g} s",
                f"{mesh.reconnect_s:g} s",
            )


@fleet_rule(
    "MC504",
    Severity.WARNING,
    "`orig_interval_ms` is too long for `reconnect_s`",
    why="`orig_interval_ms` overrides `reconnect_s`: the fleet heals more slowly than the inventory states.",
    fix="Remove `orig_interval_ms`, or adjust `reconnect_s`.",
    failing="meshes: {main: {reconnect_s: 2, batman: {orig_interval_ms: 1000}}}",
    passing="meshes: {main: {reconnect_s: 5, batman: {orig_interval_ms: 1000}}}",
)
def interval_misses_target(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    fastest = min(MEASURED_HEAL_S.values())
    for mesh in batman_meshes(fleet):
        written = mesh.batman.orig_interval_ms
        if written is not None and max(mesh.reconnect_s, fastest) < heal_s(written):
            path = ("meshes", mesh.name, "batman", "orig_interval_ms")
            expected = f"healing within {mesh.reconnect_s:g} s"
            yield Finding(
                path,
                "slower than reconnect_s",
                expected,
                f"{written} ms, which heals in {two_digits(heal_s(written))} s",
            )


@fleet_rule(
    "MC509",
    Severity.WARNING,
    "The hop penalty is extreme",
    why="""Without a penalty, routes flap between paths of equal quality; with a large one, the mesh prefers one long
    weak link over two good ones.""",
    fix="Use 30, or a value from 5 to 100.",
    failing="meshes: {main: {batman: {hop_penalty: 0}}}",
    passing="meshes: {main: {batman: {hop_penalty: 15}}}",
)
def hop_penalty_extreme(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in batman_meshes(fleet):
        if not 5 <= mesh.batman.hop_penalty <= 100:
            path = ("meshes", mesh.name, "batman", "hop_penalty")
            yield Finding(path, "routes flap or prefer long weak links", "5 to 100", str(mesh.batman.hop_penalty))


@fleet_rule(
    "MC510",
    Severity.WARNING,
    "Originator messages are not aggregated",
    why="Each message is sent in its own frame, which costs more airtime than the message.",
    fix="Set `aggregated_ogms: true`.",
    failing="meshes: {main: {batman: {aggregated_ogms: false}}}",
    passing="meshes: {main: {batman: {aggregated_ogms: true}}}",
)
def originators_not_aggregated(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in batman_meshes(fleet):
        if not mesh.batman.aggregated_ogms:
            path = ("meshes", mesh.name, "batman", "aggregated_ogms")
            yield Finding(path, "each message takes its own frame", "true", "false")


@fleet_rule(
    "MC511",
    Severity.WARNING,
    "Every node announces itself as a gateway",
    why="""`gw_mode: server` applies to all nodes of the mesh: each announces an uplink that it does not have, and DHCP
    requests go to the nearest one.""",
    fix="""Use `gw_mode: client`, or `off`, and `extra_uci: {network.bat0.gw_mode: server}` on the nodes with an
    uplink.""",
    failing="meshes: {main: {batman: {gw_mode: server}}}",
    passing="meshes: {main: {batman: {gw_mode: 'off'}}}",
)
def all_gateways(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in batman_meshes(fleet):
        if mesh.batman.gw_mode == "server":
            path = ("meshes", mesh.name, "batman", "gw_mode")
            yield Finding(path, "applies to every node of the mesh", "client or off", mesh.batman.gw_mode)


@fleet_rule(
    "MC512",
    Severity.WARNING,
    "`elp_interval_ms` is set without BATMAN_V",
    why="Only BATMAN_V probes links with ELP. Under BATMAN_IV the option has no effect.",
    fix="Set `routing_algo: BATMAN_V`, or remove `elp_interval_ms`.",
    failing="meshes: {main: {batman: {elp_interval_ms: 250}}}",
    passing="meshes: {main: {batman: {routing_algo: BATMAN_V, elp_interval_ms: 250}}}",
)
def elp_without_batman_v(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in batman_meshes(fleet):
        if mesh.batman.elp_interval_ms is not None and mesh.batman.routing_algo != "BATMAN_V":
            path = ("meshes", mesh.name, "batman", "elp_interval_ms")
            found = mesh.batman.routing_algo
            yield Finding(path, "no effect without BATMAN_V", "routing_algo: BATMAN_V", found)


@fleet_rule(
    "MC513",
    Severity.ERROR,
    "Meshes of one network have different routing options",
    why="""Cells of one network share one batman-adv interface with one set of options: the first mesh's options apply,
    those of the others are ignored.""",
    fix="Use the same `batman` options for both meshes, or separate networks.",
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
    sharing = group_by_key(((mesh.network, mesh.batman.routing_algo), mesh) for mesh in batman_meshes(fleet))
    for first, *others in sharing.values():
        for mesh in others:
            # intervals follow from reconnect_s; the shortest of the group is used
            options = replace(mesh.batman, orig_interval_ms=None, elp_interval_ms=None)
            if options != replace(first.batman, orig_interval_ms=None, elp_interval_ms=None):
                message = f"mesh {first.name} shares the routing interface but has other options"
                yield Finding(("meshes", mesh.name, "batman"), message, "the same options", "others")


@fleet_rule(
    "MC514",
    Severity.ERROR,
    "A node joins meshes with different back ends",
    why="The bridge and the services of a node belong to one back end; two would conflict over the LAN.",
    fix="Use one back end for all meshes of a node.",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}, backend: meshmerize, operator_parts:
               {templates: parts, service: mm, interface: mm0, status_command: mm-status, packages: [mm]}}
    nodes: {base: {radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    robots: {base-station: {computer: {links: [{address: 10.43.0.100}]}}}
    """,
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    robots: {base-station: {computer: {links: [{address: 10.43.0.100}]}}}
    """,
)
def back_ends_mixed(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        names = [name for name in node.meshes if name in fleet.meshes]
        ends = dict.fromkeys(fleet.meshes[name].backend.value for name in names)
        if len(ends) > 1:
            yield Finding(
                ("nodes", node.name, "radios"),
                "meshes have different back ends",
                "one back end",
                join_limited(list(ends)),
            )


@fleet_rule(
    "MC515",
    Severity.ERROR,
    "The operator parts of the back end are incomplete",
    why="""meshmerize has no public package, configuration format or status output: meshctl renders and observes only
    what the operator supplies. Without a service it is never started; without an interface it is not bridged to the
    robots.""",
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
            yield Finding(path, "meshmerize needs more parts", "all parts", f"no {', no '.join(missing)}")


@fleet_rule(
    "MC516",
    Severity.NOTE,
    "Airtime of originator messages",
    why="""Routing takes part of the airtime. The share assumes all nodes in one place, at the intervals that
    `reconnect_s` selects. It grows with the square of the number of nodes, so check it before adding beacons.""",
    fix="No action needed; MC502 warns from a tenth of the channel on.",
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
    yield from _airtime_findings(fleet, _AIRTIME_NOTE, _AIRTIME_WARNING)
