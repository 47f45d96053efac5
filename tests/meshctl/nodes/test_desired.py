"""The facts kept from an observed device."""

from __future__ import annotations

from dataclasses import replace

from meshctl.device.observation import BoardInfo
from meshctl.nodes.desired import device_facts
from meshctl.uci import Package
from tests.meshctl.plan.support import factory, fleet

TEAM = fleet()
NODE = TEAM.nodes["b01"]
BOARD = BoardInfo("compex,wpj344-16m", lan_ports=("eth0.1",), switch_vlans=(("switch0", "1", "3 0t"),))
SEEN = replace(factory(TEAM, "b01"), board=BOARD)


def kinds(package: Package) -> list[str]:
    return [section.type for section in package.sections]


def test_an_unobserved_device_has_no_facts() -> None:
    assert (device_facts(NODE, None).compat_version, device_facts(NODE, None).packages) == ("", {})


def test_the_board_provides_the_switch_layout_that_vlan_ports_need() -> None:
    facts = device_facts(replace(NODE, lan_ports=("eth0.1",)), SEEN)
    assert kinds(facts.packages["network"]) == ["interface", "switch", "switch_vlan"]


def test_where_no_port_is_a_vlan_a_switch_without_a_layout_is_left_without() -> None:
    assert kinds(device_facts(NODE, SEEN).packages["network"]) == ["interface"]


def test_a_package_that_no_uci_reader_accepts_is_no_fact() -> None:
    broken = replace(SEEN, uci={"network": "config", "system": "config system\n\toption compat_version '1.1'\n"})
    facts = device_facts(NODE, broken)
    assert (facts.compat_version, list(facts.packages)) == ("1.1", ["system"])
