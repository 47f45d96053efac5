"""The status of radios: health, alarms, last known facts."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

import pytest

from meshctl.device.errors import AuthenticationRefused, HostKeyChanged, HostKeyUnknown, Timeout
from meshctl.device.observation import (
    BoardInfo,
    Bridge,
    ChangeStatus,
    LanFilterCounts,
    Load,
    Memory,
    MeshNeighbor,
    RadioState,
    Space,
    Station,
    WirelessLink,
)
from meshctl.errors import ExitCode, NodeError
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, LanFilter, Role
from meshctl.nodes.former_devices import facts_of_former_device
from meshctl.plan import FileChange, NodePlan, Verdict
from meshctl.status import Health
from meshctl.status.json_output import as_json
from meshctl.status.last_known import facts_to_record, merge_by_device, typed
from meshctl.status.preflight import preflight
from meshctl.status.rows import row
from meshctl.status.text import text
from meshctl.status.unreachable import no_answer_of
from meshctl.status.values import NoAnswer
from tests.meshctl.status.fleets import HEALTHY, MACS, NOW, alarms, health, seen, status_of

WITHOUT_ROVER = {name: HEALTHY[name] for name in ("base", "b01")}


def test_carried_devices_that_are_off_raise_no_alarm(fleet: Fleet) -> None:
    status = status_of(fleet)
    off = {"b02": Health.OFF, "shelf": Health.OFF}
    assert health(status) == {"base": Health.OK, "b01": Health.OK, "rover": Health.OK, **off}
    assert status.exit_code is ExitCode.OK


def test_a_carried_beacon_heard_by_others_without_an_answer_is_reported(fleet: Fleet) -> None:
    b01 = seen("b01", {"base": 250, "rover": 200, "b02": 240})
    status = status_of(fleet, {**HEALTHY, "b01": b01}, silent={"b02": NoAnswer("no answer to connect within 5 s")})
    assert "b01 hears it" in alarms(status, "b02")["mute"].text
    assert status.exit_code is ExitCode.FINDINGS


def test_an_unreachable_deployed_node_is_shown_with_who_hears_it(fleet: Fleet) -> None:
    known = {"rover": LastKnown("rover", NOW - 600, {"version": "23.05.5"})}
    status = status_of(fleet, WITHOUT_ROVER, known=known)
    assert health(status)["rover"] is Health.UNREACHABLE
    alarm = alarms(status, "rover")["unreachable"]
    assert "last answered 10 min ago; b01 hears it (-60 dBm, 0.1 s ago)" in alarm.text
    assert status.exit_code is ExitCode.UNREACHABLE


@pytest.mark.parametrize(
    ("state", "inactive_ms", "is_seen"),
    [("BLOCKED", 400, True), ("LISTEN", 400, True), ("BLOCKED", 60_000, False), ("ESTAB", 400, False)],
)
def test_a_node_with_another_key_is_not_looked_for_where_it_was(
    fleet: Fleet, state: str, inactive_ms: int, is_seen: bool
) -> None:
    """Seen on real OpenWrt, after a change of the key that a node had missed: `no node hears it`, check its power."""
    station = Station("mesh0", MACS["rover"], signal_dbm=-60, inactive_ms=inactive_ms, mesh_link=state)
    answered = {"base": HEALTHY["base"], "b01": seen("b01", {"base": 250}, stations=(station,))}
    known = {"rover": LastKnown("rover", NOW - 600, {"hops": "2", "via": "b01"})}
    alarm = alarms(status_of(fleet, answered, known=known), "rover")["unreachable"]
    assert ("b01 hears it (-60 dBm, 0.4 s ago), but their 802.11s link does not come up" in alarm.text) is is_seen
    assert ("--leave-behind all" in alarm.hint) is is_seen


def test_an_unreachable_node_is_reported_with_its_last_position(fleet: Fleet) -> None:
    known = {"rover": LastKnown("rover", NOW - 600, {"hops": "2", "via": "b01"})}
    status = status_of(fleet, {"base": seen("base", {})}, known=known)
    assert alarms(status, "rover")["unreachable"].hint.startswith("it was 2 hops away, behind b01")
    assert "meshctl bootstrap b01" in alarms(status, "b01")["unreachable"].hint


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Timeout("b01 (10.42.0.2): no answer to connect within 5 s", phase="connect"), "unreachable"),
        (HostKeyChanged("b01 (10.42.0.2): the host key changed", fingerprint="x", key_type="y"), "host-key"),
        (HostKeyUnknown("b01 (10.42.0.2): not pinned", fingerprint="x", key_type="y"), "untrusted"),
        (AuthenticationRefused("b01 (10.42.0.2): login refused for root; tried: key", hint="name a key"), "login"),
        (NodeError("b01 (10.42.0.2): odd"), "failed"),
    ],
)
def test_each_reason_for_no_answer_has_its_own_code(fleet: Fleet, error: NodeError, code: str) -> None:
    silence = no_answer_of(error)
    assert not silence.reason.startswith("b01")
    status = status_of(fleet, WITHOUT_ROVER, silent={"rover": silence})
    (found,) = alarms(status, "rover").values()
    assert found.code == code


def test_a_gateway_that_fails_is_named_instead_of_the_device_behind_it(fleet: Fleet) -> None:
    error = Timeout("site.north (192.0.2.1): no answer to connect within 5 s", hint="check the uplink", phase="connect")
    error.gateway_of = "north"
    status = status_of(fleet, WITHOUT_ROVER, silent={"rover": no_answer_of(error)})
    (found,) = alarms(status, "rover").values()
    text = "gateway of north: no answer to connect within 5 s"
    assert (found.code, found.text, found.hint) == ("unreachable", text, "check the uplink")


def test_a_carried_node_that_refuses_login_is_reported(fleet: Fleet) -> None:
    status = status_of(fleet, silent={"b02": NoAnswer("the host key changed", "host-key")})
    assert "meshctl trust b02 --replace" in alarms(status, "b02")["host-key"].hint
    assert health(status)["b02"] is Health.DEGRADED


def test_hops_and_quality_follow_the_path_to_the_base(fleet: Fleet) -> None:
    rover = next(node for node in status_of(fleet).nodes if node.name == "rover")
    assert (rover.hops, rover.via) == (2, "b01")
    assert rover.quality == pytest.approx(250 / 255 * 200 / 255)


def test_a_partial_snapshot_has_no_paths(fleet: Fleet) -> None:
    rover = next(node for node in status_of(fleet, is_partial=True).nodes if node.name == "rover")
    assert (rover.hops, rover.is_path_known, rover.is_cut_vertex) == (None, False, False)
    assert alarms(status_of(fleet, is_partial=True), "b01") == {}


def test_a_node_without_a_path_to_a_base_that_answers_is_reported(fleet: Fleet) -> None:
    apart = {"base": seen("base", {}), "b01": seen("b01", {"rover": 200}), "rover": HEALTHY["rover"]}
    status = status_of(fleet, apart)
    assert "no-path" in alarms(status, "rover")
    assert "alone" in alarms(status, "base")


def test_a_node_of_another_site_has_its_path_to_the_base_there(fleet: Fleet) -> None:
    south = {name: replace(fleet.nodes[name], site="south") for name in ("b01", "rover")}
    nodes = {**fleet.nodes, **south, "b01": replace(south["b01"], role=Role.BASE)}
    apart = {"base": seen("base", {}), "b01": seen("b01", {"rover": 200}), "rover": HEALTHY["rover"]}
    status = status_of(replace(fleet, nodes=nodes), apart)
    rover = next(node for node in status.nodes if node.name == "rover")
    assert (rover.hops, rover.via) == (1, "b01")
    assert "no-path" not in alarms(status, "rover")
    # the base of the south is none of the north
    lost = status_of(replace(fleet, nodes=nodes), {**apart, "b01": seen("b01", {}), "rover": seen("rover", {})})
    assert next(node for node in lost.nodes if node.name == "rover").hops is None


def test_a_cut_vertex_is_reported_without_degrading_the_node(fleet: Fleet) -> None:
    status = status_of(fleet)
    assert list(alarms(status, "b01")) == ["cut-vertex"]
    assert health(status)["b01"] is Health.OK


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"board": BoardInfo("compex,wpj344-16m")}, "board"),
        ({"memory": Memory(64 << 20, 1 << 20, 2 << 20)}, "memory"),
        ({"overlay": Space("/overlay", 4 << 20, 1024)}, "flash"),
        ({"uci_changes": ("network.lan.ipaddr='1.2.3.4'",)}, "foreign"),
        ({"change": ChangeStatus("armed", owner="bob", left_s=40.0)}, "change"),
        ({"change": ChangeStatus("idle", is_reloading_restored=True)}, "change"),
        ({"radios": (RadioState("radio0", False, False, False, True, {}, ()),)}, "radio"),
        ({"links": (WirelessLink("mesh0", "IBSS", MACS["rover"], joined=False),)}, "join"),
        ({"links": (WirelessLink("mesh0", "IBSS", MACS["rover"], channel=11, joined=True),)}, "channel"),
        ({"bridges": (Bridge("br-lan", ("bat0",)),)}, "bridge"),
        ({"neighbors": (), "originators": (), "stations": ()}, "alone"),
    ],
)
def test_a_node_problem_degrades_the_node(fleet: Fleet, change: dict[str, Any], code: str) -> None:
    status = status_of(fleet, {**HEALTHY, "rover": seen("rover", {"b01": 200}, **change)})
    assert code in alarms(status, "rover")
    assert health(status)["rover"] is Health.DEGRADED
    assert status.exit_code is not ExitCode.OK


def test_the_owner_of_a_change_is_named_as_a_person_reads_it(fleet: Fleet) -> None:
    change = ChangeStatus("applied", owner="ada@base:17:4711", left_s=40.0)
    status = status_of(fleet, {**HEALTHY, "rover": seen("rover", {"b01": 200}, change=change)})
    assert alarms(status, "rover")["change"].text == "a change by ada@base (process 17) is applied, 40 s left"


@pytest.mark.parametrize(
    "change",
    [
        ChangeStatus("waiting", owner="bob"),
        ChangeStatus("applied", owner="bob", left_s=40.0),
        ChangeStatus("restoring", owner="bob"),
        ChangeStatus("idle", is_reloading_restored=True),
    ],
)
def test_a_radio_that_restarts_in_a_change_is_no_alarm(fleet: Fleet, change: ChangeStatus) -> None:
    """A monitor called each run of provision an error of every node that it changed."""
    off: dict[str, Any] = {
        "radios": (RadioState("radio0", False, True, False, False, {}, ()),),
        "links": (WirelessLink("mesh0", "IBSS", MACS["rover"], channel=11, joined=False),),
        "neighbors": (),
        "originators": (),
        "stations": (),
    }
    rover = seen("rover", {"b01": 200}, change=change, **off)
    assert set(alarms(status_of(fleet, {**HEALTHY, "rover": rover}), "rover")) == {"change"}
    # one that is not being changed, or whose change has not started
    for other in (ChangeStatus("idle"), ChangeStatus("armed", owner="bob")):
        rover = seen("rover", {"b01": 200}, change=other, **off)
        found = set(alarms(status_of(fleet, {**HEALTHY, "rover": rover}), "rover"))
        assert {"radio", "join", "channel", "alone"} <= found


def test_a_node_that_another_operator_is_changing_is_a_no_go_and_no_error(fleet: Fleet) -> None:
    change = ChangeStatus("idle", lock_owner="bob@laptop:17:4711", lock_left_s=40.0)
    status = status_of(fleet, {**HEALTHY, "rover": seen("rover", {"b01": 200}, change=change)})
    assert health(status)["rover"] is Health.OK
    (changes,) = (check for check in preflight(fleet, status) if check.name == "changes")
    assert (changes.is_go, changes.reason) == (False, "rover: locked by bob@laptop (process 17)")


def test_a_radio_that_is_off_but_on_the_air_is_an_alarm_and_a_no_go(fleet: Fleet) -> None:
    """25.12 leaves it in its cell, and versions before this one did not take it down."""
    wireless = """
config wifi-device 'radio0'
config wifi-device 'radio1'
	option disabled '1'
config wifi-iface 'mesh0'
	option device 'radio0'
	option ifname 'mesh0'
"""
    links = (
        WirelessLink("mesh0", "IBSS", MACS["rover"], "trio", channel=6, joined=True),
        WirelessLink("mesh1", "IBSS", "02:00:00:00:01:04", "trio", channel=6, joined=True),
    )
    status = status_of(
        fleet, {**HEALTHY, "rover": seen("rover", {"b01": 200}, uci={"wireless": wireless}, links=links)}
    )
    alarm = alarms(status, "rover")["left-over"]
    assert alarm.text == "mesh1 is on the air, although its configuration has turned it off"
    assert alarm.hint == "meshctl provision rover takes it down"
    assert health(status)["rover"] is Health.DEGRADED
    (radios,) = (check for check in preflight(fleet, status) if check.name == "radios")
    assert (radios.is_go, radios.reason) == (False, f"rover: {alarm.text}")


@pytest.mark.parametrize(
    ("change", "code"),
    [({"clock_s": 10.0}, "clock"), ({"uptime_s": 20.0}, "rebooted"), ({"load": Load(9.0, 2)}, "load")],
)
def test_informational_alarms_do_not_degrade_a_node(fleet: Fleet, change: dict[str, Any], code: str) -> None:
    known = {"rover": LastKnown("rover", NOW - 600, {})}
    status = status_of(fleet, {**HEALTHY, "rover": seen("rover", {"b01": 200}, **change)}, known=known)
    assert code in alarms(status, "rover")
    assert health(status)["rover"] is Health.OK


def test_a_factory_device_has_no_change_under_way(fleet: Fleet) -> None:
    rover = seen("rover", {"b01": 200}, change=ChangeStatus("absent", installed=False))
    assert alarms(status_of(fleet, {**HEALTHY, "rover": rover}), "rover") == {}


def test_drift_is_reported_with_the_files_and_the_command_that_fixes_it(fleet: Fleet) -> None:
    plan = NodePlan("rover", Verdict.CHANGE, files=(FileChange("etc/config/wireless", "changed", ""),))
    output = text(status_of(fleet, plans={"rover": plan}))
    assert "rover: configuration differs: wireless" in output
    assert "meshctl provision rover fixes them" in output


def filtering(fleet: Fleet) -> Fleet:
    rover = replace(fleet.nodes["rover"], lan_filter=LanFilter())
    return replace(fleet, nodes=MappingProxyType({**fleet.nodes, "rover": rover}))


def test_a_lan_filter_is_counted_in_table_and_json(fleet: Fleet) -> None:
    rover = replace(HEALTHY["rover"], lan_filter=LanFilterCounts(12, 14_472))
    plan = NodePlan("rover", Verdict.SAME)
    status = status_of(filtering(fleet), {**HEALTHY, "rover": rover}, plans={"rover": plan})
    assert "lan-filter" not in alarms(status, "rover")
    (node,) = [node for node in as_json(status)["nodes"] if node["name"] == "rover"]
    assert node["lan_filter"] == {"dropped_packets": 12, "dropped_bytes": 14_472}
    (shown,) = [row(node)["bridge"] for node in status.nodes if node.name == "rover"]
    assert shown.text.endswith(", 12 dropped")


def test_a_lan_filter_that_is_not_loaded_is_reported_if_the_files_are_right(fleet: Fleet) -> None:
    same = NodePlan("rover", Verdict.SAME)
    assert "lan-filter" in alarms(status_of(filtering(fleet), plans={"rover": same}), "rover")
    differs = replace(same, files=(FileChange("etc/meshctl/lan-filter.sh", "added", ""),))
    assert "lan-filter" not in alarms(status_of(filtering(fleet), plans={"rover": differs}), "rover")
    assert "lan-filter" not in alarms(status_of(fleet, plans={"rover": same}), "rover")


def test_a_stranger_in_the_mesh_is_reported(fleet: Fleet) -> None:
    stranger = MeshNeighbor("66:66:66:66:66:66", "mesh0", 50)
    base = replace(HEALTHY["base"], neighbors=(*(HEALTHY["base"].neighbors or ()), stranger))
    status = status_of(fleet, {**HEALTHY, "base": base})
    assert status.strangers == ("66:66:66:66:66:66",)
    assert status.exit_code is ExitCode.FINDINGS


def test_the_former_device_of_a_replaced_node_is_named_as_that(fleet: Fleet) -> None:
    """It was a MAC that is not in the inventory, with the advice to add it there."""
    mac = "66:66:66:66:66:66"
    key, facts = facts_of_former_device(fleet.nodes["b01"], {"b01": LastKnown("b01", NOW, {"macs": mac})})
    stranger = MeshNeighbor(mac, "mesh0", 50)
    base = replace(HEALTHY["base"], neighbors=(*(HEALTHY["base"].neighbors or ()), stranger))
    status = status_of(fleet, {**HEALTHY, "base": base}, known={key: LastKnown(key, NOW, facts)})
    (alarm,) = [alarm for alarm in status.alarms if alarm.code == "former-device"]
    assert alarm.text == f"{mac} is in the mesh: the former device of b01, which was replaced"
    assert status.strangers == ()
    assert status.exit_code is ExitCode.FINDINGS
    (check,) = [check for check in preflight(fleet, status) if check.name == "strangers"]
    assert (check.is_go, mac in check.reason) == (False, True)
    # it may be the one that answers at the node's address: its key must not be pinned
    apart = {name: seen for name, seen in HEALTHY.items() if name != "b01"} | {"base": base}
    changed = {"b01": NoAnswer("the host key changed", "host-key")}
    status = status_of(fleet, apart, known={key: LastKnown(key, NOW, facts)}, no_answer=changed)
    assert alarms(status, "b01")["host-key"].hint.endswith("may answer in its place: switch that one off first")


def test_nodes_that_could_not_be_compared_are_one_alarm(fleet: Fleet) -> None:
    status = status_of(fleet, unrendered={"base": "env:KEY is not set", "b01": "env:KEY is not set"})
    (alarm,) = status.alarms
    assert alarm.text == "base, b01 not compared with the inventory: env:KEY is not set"
    assert status.exit_code is ExitCode.FINDINGS


def test_recorded_facts_are_shown_for_an_unreachable_node(fleet: Fleet) -> None:
    kept = facts_to_record(status_of(fleet))
    known = {"rover": LastKnown("rover", NOW - 90, {"version": "23.05.4", "macs": MACS["rover"]})}
    known |= {name: LastKnown(name, NOW - 60, facts) for name, facts in kept.items()}
    status = status_of(fleet, WITHOUT_ROVER, known=merge_by_device(known))
    rover = next(node for node in status.nodes if node.name == "rover")
    assert rover.last_known is not None
    facts = typed(rover.last_known)
    assert (facts["version"], facts["hops"], facts["via"], facts["heard"]) == ("23.05.5", 2, "b01", ["b01"])
    assert (facts["macs"], rover.age_s) == ([MACS["rover"]], 60)
    assert "(2 hops)" in text(status)


def test_facts_in_the_format_of_another_version_are_not_an_error() -> None:
    assert typed({"hops": "two", "quality": "", "later": "x"}) == {"hops": None, "quality": None, "later": "x"}


# b02 is carried by the inventory, and lies between b01 and the robot
_DROPPED = {
    "base": seen("base", {"b01": 250}),
    "b01": seen("b01", {"base": 250, "b02": 220}),
    "b02": seen("b02", {"b01": 220, "rover": 220}),
    "rover": seen("rover", {"b02": 220}),
}


def test_a_carried_beacon_that_relays_for_others_is_reported_as_dropped(fleet: Fleet) -> None:
    status = status_of(fleet, _DROPPED)
    alarm = alarms(status, "b02")["dropped"]
    assert alarm.text == "marked as carried, but relays to the base for rover"
    assert alarm.hint == "if it has been dropped: meshctl deployed b02"
    assert "dropped" not in alarms(status, "b01")
    assert status.exit_code is ExitCode.OK


def test_an_unmarked_dropped_beacon_that_dies_raises_an_alarm(fleet: Fleet) -> None:
    kept = facts_to_record(status_of(fleet, _DROPPED))
    known = merge_by_device({name: LastKnown(name, NOW - 600, facts) for name, facts in kept.items()})
    status = status_of(fleet, known=known, silent={"b02": NoAnswer("no answer to connect within 5 s")})
    alarm = alarms(status, "b02")["dropped"]
    assert alarm.text == "no answer to connect within 5 s; rover reached the base through it 10 min ago"
    assert health(status)["b02"] is Health.DEGRADED
    assert status.exit_code is ExitCode.FINDINGS


def test_a_carried_beacon_without_relays_may_be_switched_off(fleet: Fleet) -> None:
    on = {**HEALTHY, "b02": seen("b02", {"b01": 220})}
    kept = facts_to_record(status_of(fleet, on))
    known = merge_by_device({name: LastKnown(name, NOW - 600, facts) for name, facts in kept.items()})
    status = status_of(fleet, known=known, silent={"b02": NoAnswer("no answer to connect within 5 s")})
    assert alarms(status, "b02") == {}
    assert status.exit_code is ExitCode.OK


def test_a_beacon_seen_without_relays_after_a_drop_is_not_missed(fleet: Fleet) -> None:
    first = facts_to_record(status_of(fleet, _DROPPED))
    again = facts_to_record(status_of(fleet, {**HEALTHY, "b02": seen("b02", {"b01": 220})}))
    # the journal keeps the newest facts of each device
    known = merge_by_device({name: LastKnown(name, NOW - 60, facts) for name, facts in {**first, **again}.items()})
    status = status_of(fleet, known=known, silent={"b02": NoAnswer("no answer to connect within 5 s")})
    assert alarms(status, "b02") == {}
