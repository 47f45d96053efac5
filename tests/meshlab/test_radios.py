"""Radios of 25.12 that keep an interface too long, or lose one (docs/facts/node-assumptions.md, findings 1 and 8)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from meshctl.apply.change_set import reload_script
from meshctl.device.observation import Observation
from meshctl.device.observe import interpret, observation_script
from meshctl.device.parse.sections import split_sections
from meshctl.plan.left_over import left_over
from meshlab.fleet import VirtualFleet, VirtualNode
from tests.meshlab.conftest import MESH, factory_reset
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("radios")]

WIRELESS = "etc/config/wireless"
OPEN = """\
set wireless.mesh0.mode=adhoc
set wireless.mesh0.encryption=none
delete wireless.mesh0.key
delete wireless.mesh0.mesh_id"""
ENCRYPTED = """\
set wireless.mesh0.mode=mesh
set wireless.mesh0.mesh_id=team
set wireless.mesh0.encryption=sae
set wireless.mesh0.key=a-pass-phrase"""


@pytest.fixture
def latest(fleet: VirtualFleet) -> Iterator[VirtualNode]:
    """A node of 25.12 in an open cell. It starts from erased flash: with an interface of an earlier test it would have
    mesh0 before its own is set up."""
    new = fleet.node("new")
    new.wait_up()
    factory_reset(new)
    new.exec(MESH.format(address="10.42.0.9", channel=6)).check("set up")
    until(lambda: index(new) != "", "mesh0")
    yield new
    factory_reset(new)


def index(node: VirtualNode) -> str:
    """The interface index of mesh0; empty where there is none, or while netifd is setting radios up."""
    show = "ubus call network.wireless status | grep -q 'pending.: true' || cat /sys/class/net/mesh0/ifindex"
    return node.exec(show).stdout.strip()


def has_joined(node: VirtualNode) -> bool:
    return "ssid a team" in node.exec("iw dev").stdout


def configure(node: VirtualNode, commands: str) -> None:
    """Change the wireless settings; returns when netifd has done all that `network reload` makes it do."""
    node.exec(f"uci -q batch <<END\n{commands}\ncommit wireless\nEND\nsh /rom/lab/netifd up").check("configure")


@pytest.mark.parametrize("section", ["radio0", "mesh0"])
def test_a_disabled_open_interface_stays_in_its_cell_until_wifi_down(latest: VirtualNode, section: str) -> None:
    before = index(latest)
    configure(latest, f"set wireless.{section}.disabled=1")
    assert index(latest) == before
    assert has_joined(latest)
    latest.exec("wifi down; wifi up")
    until(lambda: latest.exec("[ -e /sys/class/net/mesh0 ]").exit_status != 0, "mesh0 to go")
    assert not has_joined(latest)


# what `mesh: null` renders
OFF = "set wireless.radio0.disabled=1\ndelete wireless.mesh0"


def test_the_open_interface_of_a_removed_section_stays_in_its_cell_until_wifi_down(latest: VirtualNode) -> None:
    """Seen on 25.12.5: `radio0` is down for netifd, and mesh0 is in its cell, outside bat0."""
    before = index(latest)
    configure(latest, OFF)
    assert index(latest) == before
    assert has_joined(latest)
    latest.exec("wifi down; wifi up")
    until(lambda: latest.exec("[ -e /sys/class/net/mesh0 ]").exit_status != 0, "mesh0 to go")
    assert not has_joined(latest)


def test_reenabling_a_disabled_radio_keeps_its_remaining_interface(latest: VirtualNode) -> None:
    before = index(latest)
    configure(latest, "set wireless.radio0.disabled=1")
    configure(latest, "set wireless.radio0.disabled=0")
    assert index(latest) == before


def test_switching_from_encrypted_back_to_the_same_open_cell_loses_the_interface(latest: VirtualNode) -> None:
    before = index(latest)
    configure(latest, ENCRYPTED)
    assert index(latest) not in ("", before)
    configure(latest, OPEN)
    until(lambda: index(latest) == "", "mesh0 to go")
    configure(latest, "set wireless.radio0.txpower=10")
    assert index(latest) == ""
    latest.exec("wifi down; wifi up")
    until(lambda: index(latest) != "", "mesh0")


def test_a_channel_change_recreates_a_lost_interface(latest: VirtualNode) -> None:
    configure(latest, ENCRYPTED)
    configure(latest, OPEN)
    until(lambda: index(latest) == "", "mesh0 to go")
    configure(latest, "set wireless.radio0.channel=11")
    assert index(latest) != ""


def test_the_reload_script_recreates_a_lost_interface(latest: VirtualNode) -> None:
    configure(latest, ENCRYPTED)
    latest.exec(f"uci -q batch <<END\n{OPEN}\ncommit wireless\nEND\n{reload_script({WIRELESS}, ())}").check("reload")
    until(lambda: index(latest) != "" and has_joined(latest), "mesh0 in its cell")


@pytest.mark.parametrize("off", ["set wireless.radio0.disabled=1", OFF], ids=["disabled", "removed"])
def test_the_reload_script_removes_the_interface_of_a_radio_that_is_off(latest: VirtualNode, off: str) -> None:
    latest.exec(f"uci -q batch <<END\n{off}\ncommit wireless\nEND\n{reload_script({WIRELESS}, ())}").check("reload")
    until(lambda: latest.exec("[ -e /sys/class/net/mesh0 ]").exit_status != 0, "mesh0 to go")


def test_an_interface_that_was_left_on_the_air_is_found_and_a_later_reload_removes_it(latest: VirtualNode) -> None:
    assert left_over(observed(latest)) == ()
    configure(latest, OFF)
    assert left_over(observed(latest)) == ("mesh0",)
    latest.exec(reload_script({WIRELESS}, ())).check("reload")
    until(lambda: left_over(observed(latest)) == (), "mesh0 to go")


def test_an_access_point_is_a_port_of_its_networks_bridge(latest: VirtualNode) -> None:
    access_point = """\
set wireless.guest=wifi-iface
set wireless.guest.device=radio0
set wireless.guest.mode=ap
set wireless.guest.ssid=guests
set wireless.guest.ifname=ap0
set wireless.guest.network=lan"""
    configure(latest, access_point)
    bridges = {bridge.name: bridge.ports for bridge in observed(latest).bridges or ()}
    assert sorted(bridges["br-lan"]) == ["ap0", "bat0", "eth0"]


def observed(node: VirtualNode) -> Observation:
    output = node.exec(observation_script("NONCE")).stdout_bytes
    return interpret(split_sections(output, "NONCE"), asked_at_s=0.0, answered_at_s=0.0)


@pytest.mark.parametrize(
    ("driver", "kernel_name", "has_ibss"), [("ath9k", "ath9k", True), ("ath10k", "ath10k_pci", False)]
)
def test_a_node_says_what_its_radio_can_do(fleet: VirtualFleet, driver: str, kernel_name: str, has_ibss: bool) -> None:
    node = fleet.node("near")
    node.wait_up()
    exchange = f"""
        mkdir -p /sys/bus/drivers/{kernel_name}
        ln -sfn /sys/bus/drivers/{kernel_name} /sys/devices/platform/ahb/18100000.wmac/driver
    """
    board = fleet.directory / "nodes" / "near" / "board"
    before = board.read_text(encoding="utf-8")
    board.write_text(before.replace(",ath9k", f",{driver}"), encoding="utf-8")
    try:
        node.exec(exchange).check("exchange the radio")
        output = node.exec(observation_script("NONCE")).stdout_bytes
    finally:
        board.write_text(before, encoding="utf-8")
        node.exec(exchange.replace(kernel_name, "ath9k")).check("put the radio back")
    seen = interpret(split_sections(output, "NONCE"), asked_at_s=0.0, answered_at_s=0.0)
    assert output.startswith(b"NONCE gzip\n")
    assert seen.chips is not None
    (chip,) = seen.chips
    assert (chip.path, chip.driver) == ("platform/ahb/18100000.wmac", kernel_name)
    assert ("IBSS" in chip.modes) == has_ibss
    assert "mesh point" in chip.modes
    assert 2437 in chip.frequencies_mhz
