"""Every format of the topology shows every node and marks cut vertices."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.device.observation import MeshNeighbor, Observation, Originator, Station, WirelessLink
from meshctl.inventory import load_fleet
from meshctl.model import Fleet, Secret
from meshctl.resolve import resolve
from meshctl.status.topology_formats import FORMATS, TopologyView, directions
from meshctl.topology import observed_graph, report_of
from meshctl.topology.cells import link_cells, mesh_reports
from tests.meshctl.status.fleets import HEALTHY, INVENTORY, MACS, NAMES, alarms, seen, status_of


@pytest.mark.parametrize("form", list(FORMATS))
def test_each_format_shows_every_node_and_marks_the_cut_vertex(form: str) -> None:
    reports = {name: report_of(name, one) for name, one in HEALTHY.items()}
    picture = TopologyView(
        "main",
        ("base",),
        observed_graph(reports.values()),
        directions(reports, NAMES),
        dict.fromkeys(HEALTHY, 1.0),
        {},
    )
    drawn = FORMATS[form](picture)
    assert all(name in drawn for name in HEALTHY)
    marks = {"table": "cut vertex: b01", "tree": "b01 *", "json": '"cuts_off"', "dot": '"b01" [shape=box]'}
    assert marks.get(form, "NetworkGraph") in drawn
    if form in ("json", "netjson"):
        json.loads(drawn)


_RELAYS = (
    INVENTORY.replace(
        "    radios: {radio0:",
        """    radios:
      radio1: {path: pci0000:00/0000:00:01.0, band: 5g, rated_power_dbm: 20, max_drive_dbm: 20}
      radio0:""",
    )
    .replace("max_drive_dbm: 27}}", "max_drive_dbm: 27}")
    .replace(
        "meshes:\n",
        """meshes:
  back: {ssid: back, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.42.0.0/24}
""",
    )
    .replace("radios: {radio0: {tx_power_dbm: 20}}}", "radios: {radio0: {tx_power_dbm: 20}, radio1: {mesh: null}}}")
)
_RELAYS = _RELAYS.replace("address: 10.42.0.2}", "address: 10.42.0.2, radios: {radio1: {mesh: back}}}").replace(
    "address: 10.42.0.1}", "address: 10.42.0.1, radios: {radio1: {mesh: back}}}"
)
_BACK = {"base": "02:00:00:00:01:01", "b01": "02:00:00:00:01:02"}


def _relay(name: str, back: Mapping[str, int], main: Mapping[str, int]) -> Observation:
    """A node with radio1 (mesh0) in `back` and radio0 (mesh1) in `main`, under one bat0."""
    both = [("mesh0", _BACK[other], tq) for other, tq in back.items()]
    both += [("mesh1", MACS[other], tq) for other, tq in main.items()]
    return seen(
        name,
        {},
        macs={"mesh0": _BACK[name], "mesh1": MACS[name]},
        links=(
            WirelessLink("mesh0", "IBSS", _BACK[name], "back", channel=149, joined=True),
            WirelessLink("mesh1", "IBSS", MACS[name], "trio", channel=6, joined=True),
        ),
        stations=tuple(Station(ifname, mac, signal_dbm=-60) for ifname, mac, _ in both),
        neighbors=tuple(MeshNeighbor(mac, ifname, 100) for ifname, mac, _ in both),
        originators=tuple(Originator(mac, mac, ifname, 100, True, tq=tq) for ifname, mac, tq in both),
    )


@pytest.fixture
def relays(tmp_path: Path) -> tuple[Fleet, dict[str, Observation], dict[str, str]]:
    """base and b01 hear each other on both channels, the robot is in one of them."""
    (tmp_path / "fleet.yaml").write_text(_RELAYS)
    observations = {
        "base": _relay("base", {"b01": 250}, {"b01": 100}),
        "b01": _relay("b01", {"base": 250}, {"base": 100, "rover": 200}),
        "rover": seen("rover", {"b01": 200}),
    }
    return load_fleet(tmp_path), observations, {**NAMES, **{mac: name for name, mac in _BACK.items()}}


def test_each_mesh_of_dual_radio_relays_is_drawn_with_its_own_links(
    relays: tuple[Fleet, dict[str, Observation], dict[str, str]],
) -> None:
    fleet, observations, names = relays
    drawn = {}
    for mesh in fleet.meshes:
        reports = mesh_reports(fleet, observations, mesh)
        graph = observed_graph(reports.values(), known_macs=names)
        drawn[mesh] = {(link.a, link.b): round(link.quality, 2) for link in graph.links}
    assert drawn == {"back": {("base", "b01"): 0.98}, "main": {("base", "b01"): 0.39, ("b01", "rover"): 0.78}}


@pytest.mark.parametrize("form", ["table", "tree", "json"])
def test_a_link_shows_the_cells_it_uses(
    form: str, relays: tuple[Fleet, dict[str, Observation], dict[str, str]]
) -> None:
    fleet, observations, names = relays
    reports = {name: report_of(name, one) for name, one in observations.items()}
    picture = TopologyView(
        "trio",
        ("base",),
        observed_graph(reports.values(), known_macs=names),
        directions(reports, names),
        dict.fromkeys(observations, 1.0),
        {},
        cells=link_cells(fleet, observations, names, fleet.meshes),
    )
    drawn = FORMATS[form](picture)
    if form == "json":
        cells = {(link["a"], link["b"]): link["cells"] for link in json.loads(drawn)["links"]}
        back, main = (
            {"mesh": mesh.name, "band": mesh.band.value, "channel": mesh.channel} for mesh in fleet.meshes.values()
        )
        assert cells == {("base", "b01"): [back, main], ("b01", "rover"): [main]}
        return
    both = next(line for line in drawn.splitlines() if "b01" in line and "rover" not in line)
    assert "back 5g ch 149, main 2g ch 6" in both
    one = next(line for line in drawn.splitlines() if "rover" in line)
    assert "main 2g ch 6" in one
    assert "back" not in one.replace("back  ", "")


def test_mesh_interface_names_match_the_rendered_ones(
    relays: tuple[Fleet, dict[str, Observation], dict[str, str]],
) -> None:
    fleet, _, _ = relays
    for node in fleet.nodes.values():
        rendered = resolve(fleet, node, lambda _ref: Secret("unused")).interfaces
        assert {interface.name: interface.mesh for interface in rendered} == node.mesh_interfaces
    assert fleet.nodes["b01"].mesh_interfaces == {"mesh0": "back", "mesh1": "main"}


def test_swapped_radios_are_reported_as_two_wrong_channels(
    relays: tuple[Fleet, dict[str, Observation], dict[str, str]],
) -> None:
    fleet, observations, _ = relays
    assert "channel" not in alarms(status_of(fleet, observations), "b01")
    links = observations["b01"].links or ()
    swapped = tuple(replace(link, channel=other.channel) for link, other in zip(links, reversed(links), strict=True))
    observations["b01"] = replace(observations["b01"], links=swapped)
    (b01,) = (node for node in status_of(fleet, observations).nodes if node.name == "b01")
    assert [alarm.text for alarm in b01.alarms if alarm.code == "channel"] == [
        "mesh0 is on channel 6, its mesh on 149",
        "mesh1 is on channel 149, its mesh on 6",
    ]


def test_the_tree_has_a_root_for_the_base_of_each_site() -> None:
    apart = {"base": seen("base", {}), "b01": seen("b01", {"rover": 200}), "rover": HEALTHY["rover"]}
    reports = {name: report_of(name, one) for name, one in apart.items()}
    graph = observed_graph(reports.values(), known_macs=NAMES)
    view = TopologyView("trio", ("base", "b01"), graph, directions(reports, NAMES), dict.fromkeys(apart, 1.0), {})
    lines = FORMATS["tree"](view).splitlines()
    assert lines[:2] == ["base", "b01"]
    assert lines[2].startswith("`- rover  1 hop")
    assert len(lines) == 3
    alone = FORMATS["tree"](replace(view, entries=("base",))).splitlines()
    assert alone[-1] == "no path to base: b01, rover"


def test_a_selection_makes_no_claims_about_nodes_that_were_not_queried() -> None:
    reports = {name: report_of(name, HEALTHY[name]) for name in ("base", "rover")}
    view = TopologyView(
        "main",
        ("base",),
        observed_graph(reports.values(), known_macs=NAMES),
        directions(reports, NAMES),
        dict.fromkeys(reports, 1.0),
        {},
        queried=frozenset(reports),
    )
    shown = FORMATS["tree"](view)
    assert ", not queried" in shown
    assert "does not answer" not in shown
    assert "* cut vertex among the links that the selected nodes report:" in shown
    apart = FORMATS["tree"](replace(view, graph=observed_graph([reports["rover"]], known_macs=NAMES)))
    assert apart == "no path to base among the links that the selected nodes report: rover"
    assert "does not answer" in FORMATS["tree"](replace(view, queried=None))
