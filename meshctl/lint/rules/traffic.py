"""Load, ports and timers of the transport (MC731 to MC742)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.places import first_written
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.addresses import as_address
from meshctl.model import Fleet, Mesh, NodeState, Topic, TopicClass
from meshctl.regdb import width_mhz
from meshctl.resolve import has_routed_lans

_ALL = "all"
# IEEE 802.11-2020 table 21-29: MCS 7 and MCS 3 of one stream, long guard interval, by width; 40 MHz has 108 data
# subcarriers for 52, 80 MHz has 234, 160 MHz has 468
_MCS7_MBPS = {20: 65.0, 40: 135.0, 80: 292.5, 160: 585.0}
_MCS3_SHARE = 26.0 / 65.0
# share of the physical rate left by preambles, contention, acknowledgments and headers
_EFFICIENCY = 0.6
# a message crosses about two links of the channel on its way through a chain of beacons
_USUAL_HOPS = 2
# above this share queueing delays grow without bound, regardless of priorities
_USUAL_LIMIT = 0.5
# registered or used on robots and radios: SSH, DNS, DHCP, NTP, syslog, mDNS, ROS 1 master, Zenoh
_KNOWN_PORTS = {
    22: "SSH",
    53: "DNS",
    67: "DHCP",
    68: "DHCP",
    123: "NTP",
    514: "syslog",
    5353: "mDNS",
    7400: "DDS discovery",
    7447: "Zenoh",
    11311: "the ROS master",
}
_UDP_PORTS = frozenset({53, 67, 68, 123, 514, 5353, 7400, 7447})
_TCP_PORTS = frozenset({22, 53, 7447, 11311})
_SYSLOG_PORT = 514
# the kernel's default net.ipv4.ip_local_port_range
_EPHEMERAL_PORTS = range(32_768, 61_000)


@dataclass(frozen=True, slots=True)
class OfferedLoad:
    """Offered load of the topics on one mesh: unicast and broadcast bytes per second."""

    unicast_bytes_per_s: float
    broadcast_bytes_per_s: float
    largest: Topic

    def share(self, mesh: Mesh, *, unicast_mbps: float, hops: float, repeats: float) -> float:
        """Share of airtime: unicasts at their rate over `hops` links, broadcasts at the multicast rate, sent by
        `repeats` nodes."""
        unicast = self.unicast_bytes_per_s * 8 / (unicast_mbps * 1e6) * hops
        broadcast = self.broadcast_bytes_per_s * 8 / (mesh.mcast_rate_kbps * 1e3) * repeats
        return unicast + broadcast


def offered_load(fleet: Fleet) -> dict[str, OfferedLoad]:
    """The topics' load on every mesh: rate x size x sources x destinations, by the meshes of the sources' radios."""
    peers = [robot.name for robot in fleet.robots.values() if robot.computer is not None]
    meshes_of = {
        robot.name: {mesh for name in robot.nodes if name in fleet.nodes for mesh in fleet.nodes[name].meshes}
        for robot in fleet.robots.values()
    }
    # no broadcast reaches a robot behind a router: the daemons send to each robot
    can_broadcast = fleet.udp_mesh.broadcast and not has_routed_lans(fleet)
    sums: dict[str, list[float]] = {}
    largest: dict[str, tuple[float, Topic]] = {}
    for topic in fleet.topics:
        sources = [name for name in topic.sources if name in meshes_of] or ([] if topic.sources else peers)
        for source in sources:
            bytes_per_s = topic.sent_rate_hz * topic.size_bytes
            if topic.rate_limit_bytes_per_s is not None:
                bytes_per_s = min(bytes_per_s, topic.rate_limit_bytes_per_s)
            is_broadcast = _ALL in topic.destinations and can_broadcast
            receivers = len(peers) - 1 if _ALL in topic.destinations else len(set(topic.destinations) - {source})
            total = bytes_per_s if is_broadcast else bytes_per_s * max(receivers, 0)
            for mesh in meshes_of[source]:
                sums.setdefault(mesh, [0.0, 0.0])[is_broadcast] += total
                if total >= largest.get(mesh, (0.0, topic))[0]:
                    largest[mesh] = (total, topic)
    return {mesh: OfferedLoad(unicast, broadcast, largest[mesh][1]) for mesh, (unicast, broadcast) in sums.items()}


def _best_mbps(fleet: Fleet, mesh: Mesh) -> float:
    """Best throughput of a link: MCS 7 on all chains."""
    chains = [
        radio.hardware.chains for node in fleet.members(mesh.name) for radio in node.radios if radio.mesh == mesh.name
    ]
    try:
        width = width_mhz(mesh.htmode)
    except ValueError:
        width = 20
    return _MCS7_MBPS[width] * max(chains, default=1) * _EFFICIENCY


def _channel_shares(fleet: Fleet) -> Iterator[tuple[Mesh, OfferedLoad, float, float]]:
    """Every loaded mesh with its share of airtime: best case, and usual."""
    for name, load in offered_load(fleet).items():
        mesh = fleet.meshes.get(name)
        if mesh is None:
            continue
        best_mbps = _best_mbps(fleet, mesh)
        relays = sum(1 for node in fleet.members(name) if node.state is not NodeState.SPARE)
        best = load.share(mesh, unicast_mbps=best_mbps, hops=1, repeats=1)
        usual = load.share(mesh, unicast_mbps=best_mbps * _MCS3_SHARE, hops=_USUAL_HOPS, repeats=max(relays, 1))
        yield mesh, load, best, usual


def _format_load(load: OfferedLoad) -> str:
    kbps = (load.unicast_bytes_per_s * 8 / 1000, load.broadcast_bytes_per_s * 8 / 1000)
    return f"{kbps[0]:.0f} kbit/s unicast and {kbps[1]:.0f} kbit/s broadcast, mostly {load.largest.name}"


@fleet_rule(
    "MC731",
    Severity.ERROR,
    "The topics offer more load than the channel can carry",
    why="""Even with all robots next to each other at the highest rate, there is not enough airtime. Low-priority
    messages are never delivered, and their queues fill.""",
    fix="Send smaller messages or fewer, limit a topic's rate, or use a wider channel.",
    failing="topics: {video: {rate_hz: 30, size_bytes: 1000000, reliable: false, repair: true}}",
    passing="topics: {video: {rate_hz: 1, size_bytes: 5000}}",
)
def load_above_channel(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh, load, best, _ in _channel_shares(fleet):
        if best > 1.0:
            path = ("topics", load.largest.name, "rate_hz")
            message = f"mesh {mesh.name} cannot carry {_format_load(load)}"
            yield Finding(path, message, "at most 100% of the channel in the best case", f"{best:.0%}")


@fleet_rule(
    "MC732",
    Severity.WARNING,
    "The topics need most of the channel",
    why="""At the usual rate, over two hops, with broadcasts repeated by every node, more than half the airtime is used:
    delays grow with every lost frame, and distant robots drop out first.""",
    fix="""Send smaller messages or fewer, limit a topic's rate, or name destinations instead of `all` for large
    messages.""",
    failing="topics: {map: {rate_hz: 20, size_bytes: 20000, destinations: [all]}}",
    passing="topics: {map: {rate_hz: 0.1, size_bytes: 20000, destinations: [base-station]}}",
)
def load_high(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh, load, best, usual in _channel_shares(fleet):
        if best <= 1.0 and usual > _USUAL_LIMIT:
            path = ("topics", load.largest.name, "rate_hz")
            message = f"mesh {mesh.name} must carry {_format_load(load)}"
            expected = f"at most {_USUAL_LIMIT:.0%} of the channel in the usual case"
            yield Finding(path, message, expected, f"{usual:.0%}")


@fleet_rule(
    "MC733",
    Severity.NOTE,
    "A bulk topic's load is not given",
    why="Without `rate_hz` and `size_bytes`, lint cannot check whether the channel carries the fleet's load.",
    fix="Set both to the maximum that one source offers.",
    failing="topics: {video: {rate_hz: 0}}",
    passing="topics: {video: {rate_hz: 1}}",
)
def load_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        bulk = topic.topic_class in (TopicClass.MAP, TopicClass.VIDEO, TopicClass.TELEMETRY, TopicClass.ARTIFACT)
        if bulk and not (topic.rate_hz and topic.size_bytes):
            path = ("topics", topic.name)
            found = f"rate_hz {topic.rate_hz:g}, size_bytes {topic.size_bytes}"
            yield Finding(path, "load unknown", "rate_hz and size_bytes", found)


@fleet_rule(
    "MC734",
    Severity.WARNING,
    "Video is sent to all robots",
    why="""Messages to `all` are sent at the multicast rate and repeated by every node: one camera can fill the whole
    mesh.""",
    fix="Name the robots that use it, usually the base station.",
    failing="topics: {video: {destinations: [all]}}",
    passing="topics: {video: {destinations: [base-station]}}",
)
def video_to_all(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.topic_class is TopicClass.VIDEO and _ALL in topic.destinations:
            path = ("topics", topic.name, "destinations")
            yield Finding(path, "every node repeats it", "the robots that use it", _ALL)


@fleet_rule(
    "MC735",
    Severity.WARNING,
    "A topic's rate limit is below its load",
    why="""The topic offers more than it may send: the queue grows until messages are dropped, and messages always
    arrive late.""",
    fix="Raise the limit, reduce the load, or keep only the latest message with `keep_last`.",
    failing="topics: {video: {rate_hz: 10, size_bytes: 5000, rate_limit_bytes_per_s: 20000, keep_last: 0}}",
    passing="topics: {video: {rate_hz: 2, size_bytes: 5000, rate_limit_bytes_per_s: 20000}}",
)
def limit_below_load(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        offered = topic.sent_rate_hz * topic.size_bytes
        limit = topic.rate_limit_bytes_per_s
        if limit is not None and offered > limit and not topic.keep_last:
            path = ("topics", topic.name, "rate_limit_bytes_per_s")
            expected = f"at least {offered:g} ({topic.sent_rate_hz:g} Hz x {topic.size_bytes} bytes)"
            yield Finding(path, "its queue grows without bound", expected, str(limit))


@fleet_rule(
    "MC736",
    Severity.ERROR,
    "The transport's port is used by another service",
    why="udp_mesh cannot bind the port, or takes it from a service that the robots need.",
    fix="Use a free port above 1024, such as 8700.",
    failing="udp_mesh: {port: 5353}",
    passing="udp_mesh: {port: 8700}",
)
def port_taken(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    settings = fleet.udp_mesh
    places = [("port", settings.port, _UDP_PORTS)]
    if settings.metrics_port is not None:
        places.append(("metrics_port", settings.metrics_port, _TCP_PORTS))
    for key, port, taken in places:
        if port in taken:
            yield Finding(("udp_mesh", key), f"used by {_KNOWN_PORTS[port]}", "a free port above 1024", str(port))


@fleet_rule(
    "MC737",
    Severity.ERROR,
    "The log host's port is used by another service",
    why="""Logs are sent by UDP. They arrive at the service that has the port: at the daemon, log lines are counted as
    forged datagrams, and no log is kept.""",
    fix="Use the log server's port, usually 514, and another one for the transport.",
    failing="""
    udp_mesh: {port: 5140}
    system: {log_host: 10.42.0.100, log_port: 5140}
    """,
    passing="""
    udp_mesh: {port: 8700}
    system: {log_host: 10.42.0.100, log_port: 5140}
    """,
)
def log_port_shared(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    port = fleet.system.log_port
    if fleet.system.log_host and port in _UDP_PORTS and port != _SYSLOG_PORT:
        yield Finding(("system", "log_port"), f"used by {_KNOWN_PORTS[port]}", "the log server's port", str(port))
    hosts = {robot.computer.address.ip for robot in fleet.robots.values() if robot.computer is not None}
    if as_address(fleet.system.log_host) in hosts and fleet.system.log_port == fleet.udp_mesh.port:
        path = first_written(fleet, ("system", "log_port"), ("udp_mesh", "port"))
        yield Finding(path, "also the udp_mesh port of that computer", "another port", str(fleet.system.log_port))


@fleet_rule(
    "MC738",
    Severity.ERROR,
    "The metrics port is an SSH port",
    why="sshd listens on this port on one of the computers: the service that starts second fails, possibly sshd.",
    fix="Use another metrics port, such as 9700.",
    failing="""
    udp_mesh: {metrics_port: 2222}
    robots: {husky1: {computer: {ssh: {port: 2222}}}}
    """,
    passing="""
    udp_mesh: {metrics_port: 9700}
    robots: {husky1: {computer: {ssh: {port: 2222}}}}
    """,
)
def metrics_port_shared(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        port = fleet.udp_mesh.metrics_port
        if (
            robot.computer is not None
            and port is not None
            and port not in _TCP_PORTS
            and robot.computer.ssh.port == port
        ):
            message = f"sshd of {robot.name} listens on it"
            yield Finding(("udp_mesh", "metrics_port"), message, "another port", str(port))


_USUAL_OFFLINE_S = 10


@fleet_rule(
    "MC739",
    Severity.ERROR,
    "A peer counts as offline after fewer than three heartbeats",
    why="""On a lossy link one heartbeat in five is lost. With fewer than three heartbeats, peers flap between online
    and offline, and their outboxes with them.""",
    fix="Lower `heartbeat_s`, or set `offline_after_s` to at least three heartbeats; ten is usual.",
    failing="udp_mesh: {heartbeat_s: 5, offline_after_s: 10}",
    passing="udp_mesh: {heartbeat_s: 1, offline_after_s: 10}",
)
def offline_too_soon(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    settings = fleet.udp_mesh
    if settings.offline_after_s < 3 * settings.heartbeat_s:
        paths = (("udp_mesh", "offline_after_s"), ("udp_mesh", "heartbeat_s"))
        # the one that is farther from what is usual, so that milliseconds are found where they are written
        path = first_written(fleet, *(reversed(paths) if settings.heartbeat_s > _USUAL_OFFLINE_S else paths))
        expected = f"at least {3 * settings.heartbeat_s:g} s (3 heartbeats)"
        yield Finding(path, "offline after fewer than 3 heartbeats", expected, f"{settings.offline_after_s:g} s")


@fleet_rule(
    "MC740",
    Severity.WARNING,
    "A peer counts as offline only after minutes",
    why="Until then its messages are sent but do not arrive, and the operator sees it as online.",
    fix="Set `offline_after_s` to 10 or 20.",
    failing="udp_mesh: {offline_after_s: 300}",
    passing="udp_mesh: {offline_after_s: 10}",
)
def offline_too_late(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if fleet.udp_mesh.offline_after_s > 120:
        found = f"{fleet.udp_mesh.offline_after_s:g} s"
        yield Finding(("udp_mesh", "offline_after_s"), "a silent peer appears online", "at most 120 s", found)


@fleet_rule(
    "MC741",
    Severity.WARNING,
    "A port of the transport is in the ephemeral range",
    why="""Linux assigns ports from 32768 on to any program that requests one: occasionally this port is taken before
    udp_mesh starts.""",
    fix="Use a port from 1024 to 32767, such as 8700.",
    failing="udp_mesh: {port: 40000}",
    passing="udp_mesh: {port: 8700}",
)
def port_ephemeral(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for key, port in (("port", fleet.udp_mesh.port), ("metrics_port", fleet.udp_mesh.metrics_port)):
        if port in _EPHEMERAL_PORTS:
            yield Finding(("udp_mesh", key), "may be in use at boot", "1024 to 32767", str(port))


# ten a second notice a lost peer within a second, even if most are lost
_MIN_HEARTBEAT_S = 0.1


@fleet_rule(
    "MC742",
    Severity.WARNING,
    "Heartbeats are sent too often",
    why="""Each robot broadcasts its heartbeats at the multicast rate, and every node of the mesh repeats them: they
    take the airtime of the topics.""",
    fix="Set `heartbeat_s` in seconds; 1 is usual, 0.5 for robots that move fast.",
    failing="udp_mesh: {heartbeat_s: 0.001}",
    passing="udp_mesh: {heartbeat_s: 1}",
)
def heartbeat_too_often(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    interval_s = fleet.udp_mesh.heartbeat_s
    if interval_s < _MIN_HEARTBEAT_S:
        message = f"{1 / interval_s:.0f} broadcasts a second from each robot"
        yield Finding(("udp_mesh", "heartbeat_s"), message, f"at least {_MIN_HEARTBEAT_S:g} s", f"{interval_s:g} s")
