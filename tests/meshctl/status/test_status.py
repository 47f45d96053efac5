"""What the status says of a fleet follows from what was seen: health, alarms, go or no-go, pictures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.device.observation import (
    BoardInfo,
    ChangeStatus,
    Memory,
    MeshNeighbour,
    Observation,
    Originator,
    RadioState,
    ReleaseInfo,
    Space,
    Station,
    WirelessLink,
)
from meshctl.errors import ExitCode
from meshctl.fleet.journal import LastKnown
from meshctl.inventory import load_fleet
from meshctl.model import Fleet
from meshctl.plan import FileChange, NodePlan, Verdict
from meshctl.status import FleetStatus, Health, assess, preflight
from meshctl.status.assess import Look
from meshctl.status.document import as_json
from meshctl.status.picture import FORMATS, Picture, directions
from meshctl.status.text import preflight_text, text
from meshctl.topology import observed_graph, report_of

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
nodes:
  base: {role: base, address: 10.42.0.1}
  b01: {role: beacon, address: 10.42.0.2}
  b02: {role: beacon, address: 10.42.0.3, state: carried}
  rover: {role: robot, robot: rover, address: 10.42.0.4}
robots:
  rover: {nodes: [rover]}
"""
NOW = 1_700_000_000.0
MACS = {
    "base": "02:00:00:00:00:01",
    "b01": "02:00:00:00:00:02",
    "b02": "02:00:00:00:00:03",
    "rover": "02:00:00:00:00:04",
}


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    path = tmp_path / "fleet.yaml"
    path.write_text(INVENTORY)
    return load_fleet(path)


def seen(name: str, hears: dict[str, int], **other: object) -> Observation:
    """A healthy node that hears these nodes with these batman qualities (0..255)."""
    made = Observation(
        asked_at_s=NOW - 1.5,
        answered_at_s=NOW - 1.0,
        release=ReleaseInfo("OpenWrt", "23.05.5", "r24106", "ath79/generic"),
        board=BoardInfo("ubnt,rocket-m"),
        boot_id="one",
        uptime_s=5000.0,
        clock_s=NOW - 1.25,
        memory=Memory(64 << 20, 20 << 20, 30 << 20),
        overlay=Space("/overlay", 4 << 20, 2 << 20),
        macs={"mesh0": MACS[name]},
        radios=(RadioState("radio0", True, False, False, False, {}, (("mesh0", "mesh0"),)),),
        links=(WirelessLink("mesh0", "IBSS", MACS[name], "trio", channel=6, joined=True),),
        stations=tuple(Station("mesh0", MACS[n], signal_dbm=-60) for n in hears),
        neighbours=tuple(MeshNeighbour(MACS[n], "mesh0", 100) for n in hears),
        originators=tuple(Originator(MACS[n], MACS[n], "mesh0", 100, True, tq=tq) for n, tq in hears.items()),
        uci_changes=(),
        change=ChangeStatus("idle"),
    )
    return replace(made, **other)  # type: ignore[arg-type]


HEALTHY = {
    "base": seen("base", {"b01": 250}),
    "b01": seen("b01", {"base": 250, "rover": 200}),
    "rover": seen("rover", {"b01": 200}),
}


def status_of(
    fleet: Fleet,
    observations: dict[str, Observation],
    plans: dict[str, NodePlan] | None = None,
    known: dict[str, LastKnown] | None = None,
) -> FleetStatus:
    macs = {mac: name for name, mac in MACS.items()}
    graph = observed_graph([report_of(name, one) for name, one in observations.items()], known_macs=macs)
    look = Look(
        fleet=fleet, observations=observations, silent={}, plans=plans or {}, graph=graph, known=known or {},
        macs=macs, entry="base",
    )  # fmt: skip
    return assess(look, fleet.managed(), NOW)


def codes(status: FleetStatus, name: str) -> list[str]:
    return [alarm.code for node in status.nodes if node.name == name for alarm in node.alarms]


def health(status: FleetStatus) -> dict[str, Health]:
    return {node.name: node.health for node in status.nodes}


def test_a_carried_beacon_that_is_off_is_fine(fleet: Fleet) -> None:
    status = status_of(fleet, HEALTHY)
    assert health(status) == {"base": Health.OK, "b01": Health.OK, "rover": Health.OK, "b02": Health.OFF}
    assert status.exit_code is ExitCode.OK


def test_a_deployed_node_that_is_silent_is_missed_and_told_by_whom_it_is_heard(fleet: Fleet) -> None:
    known = {"rover": LastKnown("rover", NOW - 600, {"version": "23.05.5"})}
    status = status_of(fleet, {name: HEALTHY[name] for name in ("base", "b01")}, known=known)
    assert health(status)["rover"] is Health.UNREACHABLE
    (alarm,) = next(node for node in status.nodes if node.name == "rover").alarms
    assert "last answered 10 min ago; b01 hears it" in alarm.text
    assert status.exit_code is ExitCode.UNREACHABLE


def test_hops_and_quality_follow_the_path_to_the_base(fleet: Fleet) -> None:
    rover = next(node for node in status_of(fleet, HEALTHY).nodes if node.name == "rover")
    assert (rover.hops, rover.via) == (2, "b01")
    assert rover.quality == pytest.approx(250 / 255 * 200 / 255)


def test_a_node_that_holds_others_is_named_as_a_cut_vertex_without_degrading_it(fleet: Fleet) -> None:
    status = status_of(fleet, HEALTHY)
    assert codes(status, "b01") == ["cut-vertex"]
    assert health(status)["b01"] is Health.OK


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"board": BoardInfo("compex,wpj344-16m")}, "board"),
        ({"memory": Memory(64 << 20, 1 << 20, 2 << 20)}, "memory"),
        ({"overlay": Space("/overlay", 4 << 20, 1024)}, "flash"),
        ({"uci_changes": ("network.lan.ipaddr='1.2.3.4'",)}, "foreign"),
        ({"change": ChangeStatus("armed", owner="bob", left_s=40.0)}, "change"),
        ({"radios": (RadioState("radio0", False, False, False, True, {}, ()),)}, "radio"),
        ({"links": (WirelessLink("mesh0", "IBSS", MACS["rover"], joined=False),)}, "join"),
        ({"neighbours": (), "originators": (), "stations": ()}, "alone"),
    ],
)
def test_what_is_wrong_with_a_node_degrades_it(fleet: Fleet, change: dict[str, object], code: str) -> None:
    status = status_of(fleet, {**HEALTHY, "rover": seen("rover", {"b01": 200}, **change)})
    assert code in codes(status, "rover")
    assert health(status)["rover"] is Health.DEGRADED
    assert status.exit_code is not ExitCode.OK


@pytest.mark.parametrize(("change", "code"), [({"clock_s": 10.0}, "clock"), ({"uptime_s": 20.0}, "rebooted")])
def test_what_only_informs_does_not_degrade(fleet: Fleet, change: dict[str, object], code: str) -> None:
    known = {"rover": LastKnown("rover", NOW - 600, {})}
    status = status_of(fleet, {**HEALTHY, "rover": seen("rover", {"b01": 200}, **change)}, known=known)
    assert code in codes(status, "rover")
    assert health(status)["rover"] is Health.OK


def test_drift_names_the_files(fleet: Fleet) -> None:
    plan = NodePlan("rover", Verdict.CHANGE, files=(FileChange("etc/config/wireless", "changed", ""),))
    status = status_of(fleet, HEALTHY, {"rover": plan})
    assert "configuration differs: wireless" in text(status)


def test_a_stranger_in_the_mesh_is_reported(fleet: Fleet) -> None:
    stranger = MeshNeighbour("66:66:66:66:66:66", "mesh0", 50)
    base = replace(HEALTHY["base"], neighbours=(*(HEALTHY["base"].neighbours or ()), stranger))
    status = status_of(fleet, {**HEALTHY, "base": base})
    assert status.strangers == ("66:66:66:66:66:66",)
    assert status.exit_code is ExitCode.FINDINGS


def test_preflight_is_a_go_only_when_every_check_is(fleet: Fleet) -> None:
    known = {"b02": LastKnown("b02", NOW - 60, {})}
    good = preflight(fleet, status_of(fleet, HEALTHY, known=known))
    assert preflight_text(good).splitlines()[-1] == "GO"
    never_seen = preflight(fleet, status_of(fleet, HEALTHY))
    assert [check.name for check in never_seen if not check.is_go] == ["beacons"]
    without_robot = preflight(fleet, status_of(fleet, {n: HEALTHY[n] for n in ("base", "b01")}, known=known))
    assert [check.name for check in without_robot if not check.is_go] == ["robot radios"]


def test_json_holds_every_node_and_is_json(fleet: Fleet) -> None:
    told = json.loads(json.dumps(as_json(status_of(fleet, HEALTHY))))
    assert [node["name"] for node in told["nodes"]] == ["base", "b01", "b02", "rover"]
    assert told["exit_code"] == 0


@pytest.mark.parametrize("form", list(FORMATS))
def test_each_picture_shows_every_node_and_marks_the_cut_vertex(fleet: Fleet, form: str) -> None:
    reports = {name: report_of(name, one) for name, one in HEALTHY.items()}
    picture = Picture(
        "main", "base", observed_graph(reports.values()), directions(reports, {m: n for n, m in MACS.items()}),
        dict.fromkeys(HEALTHY, 1.0), {},
    )  # fmt: skip
    drawn = FORMATS[form](picture)
    assert all(name in drawn for name in HEALTHY)
    marks = {"table": "cut vertex: b01", "tree": "b01 *", "json": '"cuts_off"', "dot": '"b01" [shape=box]'}
    assert marks.get(form, "NetworkGraph") in drawn
    if form in ("json", "netjson"):
        json.loads(drawn)
