"""OpenWrt's system settings: clocks, time zones, logs (MC231 to MC239)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.addresses import as_address, is_host, networks, stations
from meshctl.lint.rules.references import suggest
from meshctl.lint.zones import countries_of, is_posix, posix_of, same_clock, standard_offset_s, zones, zones_of
from meshctl.model import Fleet, Node
from meshctl.model.ip import IpAddress
from meshctl.wording import counted, one_of


@fleet_rule(
    "MC231",
    Severity.WARNING,
    "The time zone is not a POSIX time zone string",
    why="""OpenWrt's C library does not know names such as America/Denver: it silently falls back to UTC, and the
    radios' logs are hours off.""",
    fix="Put the POSIX string in `timezone` and the name in `zonename`.",
    failing="system: {timezone: America/Denver}",
    passing="system: {timezone: 'MST7MDT,M3.2.0,M11.1.0', zonename: America/Denver}",
)
def timezone_not_posix(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    written = fleet.system.timezone
    if written and not is_posix(written):
        posix = posix_of(written)
        expected = posix if posix is not None else "a POSIX time zone such as MST7MDT,M3.2.0,M11.1.0"
        hint = f"write `timezone: {posix}` and `zonename: {written}`" if posix is not None else ""
        yield Finding(("system", "timezone"), "OpenWrt would use UTC", expected, written, hint)


@fleet_rule(
    "MC232",
    Severity.WARNING,
    "The time zone name is unknown",
    why="OpenWrt links /tmp/localtime to the zone's file; for an unknown name the link is missing.",
    fix="Use a name from the time zone database, such as America/New_York.",
    failing="system: {timezone: 'MST7MDT,M3.2.0,M11.1.0', zonename: America/Dever}",
    passing="system: {timezone: 'MST7MDT,M3.2.0,M11.1.0', zonename: America/Denver}",
)
def zonename_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    name = fleet.system.zonename
    if name and posix_of(name) is None:
        _, hint = suggest(_near_by(name), name)
        yield Finding(("system", "zonename"), "unknown time zone", "a name of the time zone database", name, hint)


def _near_by(name: str) -> list[str]:
    """Zones of the same continent: comparing with every zone takes too long."""
    continent = name.partition("/")[0]
    same = [zone for zone in zones() if zone.partition("/")[0] == continent]
    return same or [zone for zone in zones() if zone.rpartition("/")[2][:1] == name.rpartition("/")[2][:1]]


@fleet_rule(
    "MC233",
    Severity.WARNING,
    "`timezone` and `zonename` disagree",
    why="""Images with zoneinfo packages use the name, other images the POSIX string: nodes with different images have
    different local times.""",
    fix="Set `timezone` to the POSIX string of `zonename`.",
    failing="system: {timezone: 'CST6CDT,M3.2.0,M11.1.0', zonename: America/Denver}",
    passing="system: {timezone: 'MST7MDT,M3.2.0,M11.1.0', zonename: America/Denver}",
)
def zone_disagrees(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    system = fleet.system
    posix = posix_of(system.zonename)
    if posix is None or not is_posix(system.timezone):
        return
    if not same_clock(posix, system.timezone):
        yield Finding(("system", "timezone"), f"does not match {system.zonename}", posix, system.timezone)


@fleet_rule(
    "MC234",
    Severity.NOTE,
    "A log host or time server has an unknown address",
    why="""The address is in the fleet's network, but no node or computer in the inventory has it. If it is a typo, the
    logs are lost.""",
    fix="Use the address of a computer, or suppress this finding for a server that is not in the inventory.",
    failing="system: {log_host: 10.42.0.77}",
    passing="system: {log_host: 10.42.0.100}",
)
def server_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    known = {address for address, _ in stations(fleet)}
    places: list[tuple[tuple[str, ...], str]] = [(("system", "log_host"), fleet.system.log_host)]
    places += [(("system", "ntp_servers", str(index)), host) for index, host in enumerate(fleet.system.ntp_servers)]
    for path, host in places:
        address = as_address(host)
        if address is None or address in known:
            continue
        if any(address in network for _, network in networks(fleet)):
            yield Finding(path, "no station in the inventory has this address", "the address of a computer", host)


@fleet_rule(
    "MC235",
    Severity.WARNING,
    "A radio is named as log host or time server",
    why="""OpenWrt's logd receives no logs of other devices, and meshctl turns off the time server of the nodes: nothing
    answers there, logs are lost, and clocks stay wrong.""",
    fix="""Name the operator's computer. A radio keeps the time of others with `extra_uci: {system.ntp.enable_server:
    "1"}`, and collects logs with a package such as syslog-ng.""",
    failing="system: {ntp_servers: [10.42.0.1]}",
    passing="""
    system: {ntp_servers: [10.42.0.1]}
    nodes: {base: {extra_uci: {system.ntp.enable_server: '1'}}}
    """,
)
def server_is_radio(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    radios: dict[IpAddress | None, Node] = {address.ip: node for node in fleet.managed() for address in node.addresses}
    addresses = {
        **{robot.name: robot.computer.address.ip for robot in fleet.robots.values() if robot.computer is not None},
        **{node.name: node.address.ip for node in fleet.managed()},
    }
    servers = [(("system", "ntp_servers", str(number)), host) for number, host in enumerate(fleet.system.ntp_servers)]
    for path, host in ((("system", "log_host"), fleet.system.log_host), *servers):
        if host in addresses:
            message = "nodes do not resolve names of the inventory"
            yield Finding(path, message, str(addresses[host]), host, "Write the address.")
    node = radios.get(as_address(fleet.system.log_host))
    if node is not None and not any(package in _LOG_SERVERS for package in (*node.hardware.packages, *node.packages)):
        message = f"{node.name} is a radio, which receives no logs"
        yield Finding(("system", "log_host"), message, "the address of a computer", fleet.system.log_host)
    for index, host in enumerate(fleet.system.ntp_servers):
        node = radios.get(as_address(host))
        if node is not None and node.extra_uci.get("system.ntp.enable_server") != "1":
            message = f"{node.name} is a radio, whose time server is off"
            yield Finding(("system", "ntp_servers", str(index)), message, "the address of a computer", host)


_LOG_SERVERS = frozenset({"syslog-ng", "rsyslog"})


_OFFSET_OF_UTC = re.compile(r"(UTC|GMT)(?P<sign>[+-]?)0*(?P<hours>\d+)")


@fleet_rule(
    "MC236",
    Severity.NOTE,
    "A time zone is an offset in POSIX's direction",
    why="""POSIX counts hours west of Greenwich: with `UTC+2` a clock is two hours behind UTC, and calls that UTC.
    Elsewhere UTC+2 is two hours ahead, so one of its readers is wrong.""",
    fix="Write the offset as the zone's name, too: `<+02>-2` is two hours ahead of UTC, `<-05>5` five hours behind.",
    failing="system: {timezone: UTC+2}",
    passing="system: {timezone: '<-05>5'}",
)
def offset_of_utc(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    written = fleet.system.timezone
    match = _OFFSET_OF_UTC.fullmatch(written)
    if match is not None and match["hours"] and int(match["hours"]):
        hours = int(match["hours"])
        is_west = match["sign"] != "-"
        meant, named = (f"<-{hours:02}>{hours}", "behind") if is_west else (f"<+{hours:02}>-{hours}", "ahead of")
        hint = f"{written} is {counted(hours, 'hour')} {named} UTC; write {meant}, or the opposite if you meant that"
        yield Finding(("system", "timezone"), "counts westward", meant, written, hint)


@fleet_rule(
    "MC237",
    Severity.ERROR,
    "A log host or time server is neither an address nor a host name",
    why="""The name server has no such name, and the daemons of OpenWrt take neither a URL nor a port here: no log
    arrives, and the clocks stay wrong.""",
    fix="Write the address or the name alone; `log_port` is the port of the log host.",
    failing="system: {log_host: '10.42.0.100:514'}",
    passing="system: {log_host: 10.42.0.100}",
)
def server_without_a_name(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    hosts = [(("system", "log_host"), fleet.system.log_host)] if fleet.system.log_host else []
    servers = [(("system", "ntp_servers", str(index)), host) for index, host in enumerate(fleet.system.ntp_servers)]
    for path, host in (*hosts, *servers):
        if not is_host(host):
            yield Finding(path, "not a host", "an address such as 10.42.0.100, or a host name", host)


@fleet_rule(
    "MC238",
    Severity.WARNING,
    "The country and the time zone do not match",
    why="""The country decides which channels and powers the radios may use. If it was left over from another fleet,
    the radios break the rules of the place where they are, and lint checks them against the wrong ones.""",
    fix="Set `country` to where the radios are used, or correct `timezone` and `zonename`.",
    failing="system: {timezone: 'CET-1CEST,M3.5.0,M10.5.0/3', zonename: Europe/Oslo}",
    passing="system: {timezone: 'MST7MDT,M3.2.0,M11.1.0', zonename: America/Denver}",
)
def country_of_other_zone(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    system = fleet.system
    countries = countries_of(system.zonename)
    if countries:
        if fleet.country not in countries:
            yield Finding(("country",), f"{system.zonename} is not in this country", one_of(countries), fleet.country)
        return
    if _OFFSET_OF_UTC.fullmatch(system.timezone):
        # MC236: in the other direction it may match
        return
    offset_s = standard_offset_s(system.timezone)
    own = {standard_offset_s(zones()[name]) for name in zones_of(fleet.country)}
    # clocks in UTC are common everywhere; MC231 reports what is no POSIX time zone
    if offset_s and own and offset_s not in own and is_posix(system.timezone):
        message = f"no time zone of this country matches {system.timezone}"
        yield Finding(("country",), message, "the country where the radios are used", fleet.country)


# logd allocates the whole log at its start, beside everything else that a node keeps in memory
_MAX_LOG_SHARE = 1 / 8


@fleet_rule(
    "MC239",
    Severity.WARNING,
    "The log takes much of a node's memory",
    why="""logd keeps the log in RAM. If too little is left, the kernel ends processes, and a change or a flash, which
    are unpacked in RAM, fails.""",
    fix="Set `log_size_kib` in KiB: 64 to 1024 are usual. A `log_host` keeps everything.",
    failing="system: {log_size_kib: 65536}",
    passing="system: {log_size_kib: 1024}",
)
def log_fills_memory(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    smallest = min((node.hardware for node in fleet.managed()), key=lambda profile: profile.memory_mib, default=None)
    if smallest is None:
        return
    most_kib = int(smallest.memory_mib * 1024 * _MAX_LOG_SHARE)
    if fleet.system.log_size_kib > most_kib:
        message = f"{smallest.name} has {smallest.memory_mib} MiB of memory"
        found = f"{fleet.system.log_size_kib} ({fleet.system.log_size_kib / 1024:g} MiB)"
        yield Finding(("system", "log_size_kib"), message, f"at most {most_kib} (one eighth)", found)
