"""A small fleet, radios that answer, robots that answer, and their snapshot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from meshctl.device.observation import (
    BoardInfo,
    Bridge,
    ChangeStatus,
    ChannelSurvey,
    Load,
    Memory,
    MeshNeighbor,
    Observation,
    Originator,
    RadioState,
    ReleaseInfo,
    Sensors,
    Space,
    Station,
    WirelessLink,
)
from meshctl.fleet.journal import LastKnown
from meshctl.inventory import load_fleet
from meshctl.model import Fleet
from meshctl.nodes.collect import reports_of
from meshctl.plan import NodePlan
from meshctl.robots.facts import ComputerFacts, PeerFacts, QueueFacts, RobotFacts, ServiceFacts, TopicFacts
from meshctl.status import Alarm, FleetStatus, Health, assess
from meshctl.status.assess import Snapshot
from meshctl.status.values import NoAnswer
from meshctl.topology import observed_graph

INVENTORY = """\
meshctl: 1
fleet: trio
country: US
operators: {ssh_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGWzgxmFwBtebEfUvHgyG0To5jOoLtmIA3MQHQjEQWFX alice"]}
hardware:
  rocket:
    board: ubnt,rocket-m
    profile: ubnt_rocket-m
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    memory_mib: 64
    radios: {radio0: {path: pci0000:00/0000:00:00.0, band: 2g, rated_power_dbm: 27, max_drive_dbm: 27}}
meshes:
  main: {ssid: trio, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/24}
defaults: {hardware: rocket, state: deployed, radios: {radio0: {tx_power_dbm: 20}}}
groups:
  beacons: {role: beacon}
nodes:
  base: {role: base, address: 10.42.0.1}
  b01: {groups: [beacons], address: 10.42.0.2}
  b02: {groups: [beacons], address: 10.42.0.3, state: carried}
  rover: {role: robot, address: 10.42.0.4}
  shelf: {role: robot, address: 10.42.0.5, state: carried}
robots:
  station: {is_base: true, nodes: [base], computer: {address: 10.42.0.11/24}}
  rover: {nodes: [rover], computer: {address: 10.42.0.14/24}}
  shelf: {nodes: [shelf], computer: {address: 10.42.0.15/24}}
topics:
  estop: {priority: 0, class: emergency_stop, sources: [station], rate_hz: 0.1}
  commands: {priority: 1, class: command, sources: [station], destinations: [rover, shelf]}
  telemetry: {priority: 3, class: telemetry, rate_hz: 2, deadline_s: 5}
"""
NOW = 1_700_000_000.0
MACS = {
    "base": "02:00:00:00:00:01",
    "b01": "02:00:00:00:00:02",
    "b02": "02:00:00:00:00:03",
    "rover": "02:00:00:00:00:04",
    "shelf": "02:00:00:00:00:05",
}
NAMES = {mac: name for name, mac in MACS.items()}


def trio(directory: Path) -> Fleet:
    """A base, a beacon and a robot in a line, and a beacon and a robot that are not used."""
    path = directory / "fleet.yaml"
    path.write_text(INVENTORY)
    return load_fleet(path)


def seen(name: str, hears: Mapping[str, int], **other: Any) -> Observation:
    """A healthy node that hears these nodes with these batman qualities (0..255)."""
    made = Observation(
        asked_at_s=NOW - 1.5,
        answered_at_s=NOW - 1.0,
        release=ReleaseInfo("OpenWrt", "23.05.5", "r24106", "ath79/generic"),
        board=BoardInfo("ubnt,rocket-m"),
        boot_id="one",
        uptime_s=5000.0,
        clock_s=NOW - 1.25,
        load=Load(0.5, 1),
        memory=Memory(64 << 20, 20 << 20, 30 << 20),
        overlay=Space("/overlay", 4 << 20, 2 << 20),
        macs={"mesh0": MACS[name]},
        radios=(RadioState("radio0", True, False, False, False, {}, (("mesh0", "mesh0"),)),),
        links=(WirelessLink("mesh0", "IBSS", MACS[name], "trio", channel=6, joined=True, phy="phy0"),),
        surveys=(ChannelSurvey("mesh0", 2437, -95, 100_000, 30_000),),
        sensors=Sensors({"phy0": 2}, {}),
        bridges=(Bridge("br-lan", ("eth0", "bat0")),),
        stations=tuple(Station("mesh0", MACS[n], signal_dbm=-60, tx_mcs="MCS 15", rx_mcs="MCS 12") for n in hears),
        neighbors=tuple(MeshNeighbor(MACS[n], "mesh0", 100) for n in hears),
        originators=tuple(Originator(MACS[n], MACS[n], "mesh0", 100, True, tq=tq) for n, tq in hears.items()),
        uci_changes=(),
        change=ChangeStatus("idle"),
    )
    return replace(made, **other)


HEALTHY = {
    "base": seen("base", {"b01": 250}),
    "b01": seen("b01", {"base": 250, "rover": 200}),
    "rover": seen("rover", {"b01": 200}),
}


def peer(name: str, **other: Any) -> PeerFacts:
    return replace(PeerFacts(name, True, heard_ago_s=0.5, round_trip_s=0.012), **other)


def robot_facts(robot: str, *peers: PeerFacts, **other: Any) -> RobotFacts:
    """A robot on which all is well, and whose daemon has run for long."""
    sends = robot == "station"
    made = RobotFacts(
        robot,
        seen_s=NOW - 0.5,
        service=ServiceFacts("active", "enabled", 0, "success"),
        release="one",
        version="0.1.0",
        daemon_uptime_s=4000.0,
        keys=("aa", "bb"),
        peers=peers,
        topics=(
            TopicFacts("estop", 0, 10, 10, 3.0 if sends else None, None if sends else 3.0),
            TopicFacts("commands", 1),
            TopicFacts("telemetry", 3, 10, 10, 0.2, 0.3),
        ),
        computer=ComputerFacts(9000.0, (0.5, 0.5, 0.5), 4, 8 << 20, 4 << 20, 100 << 20, 50 << 20, 0.4),
        status={"version": "0.1.0"},
    )
    return replace(made, **other)


TEAM = {"station": robot_facts("station", peer("rover")), "rover": robot_facts("rover", peer("station"))}


def queue(priority: int, messages: int, oldest_s: float, size: int = 1000) -> QueueFacts:
    return QueueFacts(priority, messages, size, oldest_s)


def look_of(
    fleet: Fleet,
    observations: Mapping[str, Observation] = HEALTHY,
    robots: Mapping[str, RobotFacts] = TEAM,
    *,
    plans: Mapping[str, NodePlan] | None = None,
    known: Mapping[str, LastKnown] | None = None,
    silent: Mapping[str, NoAnswer] | None = None,
    silent_robots: Mapping[str, NoAnswer] | None = None,
    **other: Any,
) -> Snapshot:
    reports = reports_of(observations)
    look = Snapshot(
        fleet=fleet,
        observations=observations,
        no_answer=silent or {},
        plans=plans or {},
        reports=reports,
        graph=observed_graph(reports.values(), known_macs=NAMES),
        known=known or {},
        macs=NAMES,
        entry="base",
        robots=robots,
        no_answer_robots=silent_robots or {},
    )
    return replace(look, **other)


def status_of(
    fleet: Fleet,
    observations: Mapping[str, Observation] = HEALTHY,
    robots: Mapping[str, RobotFacts] = TEAM,
    **other: Any,
) -> FleetStatus:
    """The status of the whole fleet."""
    return assess(look_of(fleet, observations, robots, **other), fleet.managed(), NOW, fleet.robots)


def alarms(status: FleetStatus, name: str, *, robot: bool = False) -> dict[str, Alarm]:
    """By code: those of a radio, or of a robot's computer."""
    devices = status.robots if robot else status.nodes
    return {alarm.code: alarm for one in devices if one.name == name for alarm in one.alarms}


def health(status: FleetStatus) -> dict[str, Health]:
    return {one.name: one.health for one in status.nodes}


def robot_health(status: FleetStatus) -> dict[str, Health]:
    return {one.name: one.health for one in status.robots}
