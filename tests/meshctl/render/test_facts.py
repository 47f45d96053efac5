"""What a board wrote into its own configuration outlives ours; what the inventory writes itself is the inventory's."""

from __future__ import annotations

from dataclasses import replace

import pytest

from meshctl.model import Fleet, Release
from meshctl.render import DeviceFacts, Rendered, Templates, render_node, with_switch
from meshctl.uci import Package, Section, parse
from tests.meshctl.render import fleets

SHARED = Templates.of(fleets.fleet())
NAME = "husky1-front"
# what config_generate writes on a WPJ344 (23.05), shortened; one switch_port as boards with LEDs at the switch have
NETWORK = """
config interface 'loopback'
	option device 'lo'

config globals 'globals'
	option ula_prefix 'fd42::/48'

config device
	option name 'br-lan'
	option type 'bridge'
	list ports 'eth0.1'

config device
	option name 'eth0.1'
	option macaddr '02:00:00:00:00:11'

config device
	option name 'eth0.2'
	option macaddr '02:00:00:00:00:12'

config interface 'lan'
	option device 'br-lan'

config interface 'wan'
	option device 'eth0.2'
	option proto 'dhcp'

config switch
	option name 'switch0'
	option reset '1'
	option enable_vlan '1'

config switch_vlan
	option device 'switch0'
	option vlan '1'
	option ports '3 0t'

config switch_vlan
	option device 'switch0'
	option vlan '2'
	option ports '2 0t'

config switch_port
	option device 'switch0'
	option port '1'
	option led '6'
"""
SYSTEM = """
config system
	option hostname 'OpenWrt'

config rssid 'rssid_wlan0'
	option dev 'wlan0'

config led 'led_lan'
	option name 'LAN'
	option sysfs 'green:lan'
	option trigger 'switch0'

config gpio_switch 'poe_passthrough'
	option gpio_pin '3'
	option value '1'

config something 'else'
	option of 'somebody'
"""
# what `wifi config` adds for a radio that /etc/config/wireless does not name
ADDED = """
config wifi-device 'radio2'
	option type 'mac80211'
	option path 'pci0000:00/0000:00:01.0'
	option channel '36'
	option band '5g'
	option disabled '1'

config wifi-iface 'default_radio2'
	option device 'radio2'
	option network 'lan'
	option mode 'ap'
	option ssid 'OpenWrt'
	option encryption 'none'
"""


def box(release: Release = Release.V23_05, **changes: object) -> Fleet:
    """A node whose inventory does not know its switch."""
    profile = replace(fleets.hardware(release), switch_vlans=())
    return fleets.fleet(replace(fleets.node(release, **changes), hardware=profile))


def render(fleet: Fleet, **packages: str) -> Rendered:
    trees = {name: parse(text, name, name=name) for name, text in packages.items()}
    return render_node(fleet, NAME, fleets.secrets, SHARED, DeviceFacts("", trees))


def package(rendered: Rendered, name: str) -> Package:
    found = rendered.package(name)
    assert found is not None
    return found


def sections(rendered: Rendered, name: str, *kinds: str) -> list[Section]:
    return [section for section in package(rendered, name).sections if section.type in kinds]


@pytest.mark.parametrize("release", Release)
def test_a_switch_keeps_its_vlan_layout(release: Release) -> None:
    kept = sections(render(box(release), network=NETWORK), "network", "switch", "switch_vlan", "switch_port")
    assert [(section.type, section.get("vlan"), section.get("ports")) for section in kept] == [
        ("switch", "", ""),
        ("switch_vlan", "1", "3 0t"),
        ("switch_vlan", "2", "2 0t"),
        ("switch_port", "", ""),
    ]


@pytest.mark.parametrize("release", Release)
def test_a_bridged_port_keeps_the_mac_address_set_by_the_board(release: Release) -> None:
    devices = sections(render(box(release), network=NETWORK), "network", "device")
    assert [section.get("macaddr") for section in devices if section.get("macaddr")] == ["02:00:00:00:00:11"]


def test_the_switch_layout_of_the_inventory_replaces_that_of_the_node() -> None:
    mine = fleets.fleet(fleets.node(hardware=replace(fleets.hardware(Release.V23_05), switch_vlans=(("1", "2 3 0t"),))))
    written = render(mine, network=NETWORK)
    assert [section.get("ports") for section in sections(written, "network", "switch_vlan")] == ["2 3 0t"]
    assert sections(written, "network", "switch_port") == []


def test_extra_uci_switch_sections_replace_those_of_the_node() -> None:
    written = render(box(extra_uci={"network.switch0": "switch", "network.switch0.name": "switch0"}), network=NETWORK)
    assert [section.name for section in sections(written, "network", "switch", "switch_vlan")] == ["switch0"]


def test_an_equal_switch_layout_renders_the_same_from_inventory_and_node() -> None:
    known, kept = render(fleets.fleet(), network=NETWORK), render(box(), network=NETWORK)
    both = [sections(item, "network", "switch", "switch_vlan") for item in (known, kept)]
    assert both[0] == both[1]


LAYOUT = (("switch0", "1", "3 0t"), ("switch0", "2", "2 0t"))


def test_a_missing_switch_layout_is_restored_as_config_generate_writes_it() -> None:
    stock = parse(NETWORK, "network")
    lost = Package("network", tuple(s for s in stock.sections if not s.type.startswith("switch")))
    found = with_switch(lost, LAYOUT)
    kept = [s for s in stock.sections if s.type in ("switch", "switch_vlan")]
    assert [s for s in found.sections if s.type.startswith("switch")] == kept
    assert with_switch(lost, ()) == lost


def test_an_existing_switch_layout_overrides_the_board_layout() -> None:
    stock = parse(NETWORK, "network")
    assert with_switch(stock, (("switch0", "1", "0 1 2 3"),)) == stock


def test_only_led_rssid_and_gpio_switch_sections_of_system_are_kept() -> None:
    written = render(box(), system=SYSTEM)
    assert [section.name for section in package(written, "system").sections] == [
        None,
        "ntp",
        "rssid_wlan0",
        "led_lan",
        "poe_passthrough",
    ]


def test_a_radio_not_in_the_inventory_is_kept_as_wifi_config_wrote_it() -> None:
    written = package(render(box(), wireless=ADDED), "wireless")
    assert written.sections[-2:] == parse(ADDED, "wireless").sections


def test_a_manually_enabled_radio_is_disabled_and_loses_its_interface() -> None:
    written = package(render(box(), wireless=ADDED.replace("disabled '1'", "disabled '0'")), "wireless")
    radio = written.section("radio2")
    assert radio is not None
    assert radio.get("disabled") == "1"
    assert written.section("default_radio2") is None


def test_an_inventory_radio_is_not_kept_under_another_name() -> None:
    other = ADDED.replace("pci0000:00/0000:00:01.0", fleets.RADIO_2G.path)
    assert package(render(box(), wireless=other), "wireless").section("radio2") is None


def test_an_extra_radio_sharing_a_device_path_is_kept() -> None:
    other = ADDED.replace("pci0000:00/0000:00:01.0", fleets.RADIO_2G.path).replace(
        "option disabled", "option radio '1'\n\toption disabled"
    )
    written = package(render(box(), wireless=other), "wireless")
    assert written.sections[-2:] == parse(other, "wireless").sections


@pytest.mark.parametrize("release", Release)
def test_rendering_with_its_own_output_as_facts_is_idempotent(release: Release) -> None:
    first = render(box(release), network=NETWORK, system=SYSTEM, wireless=ADDED)
    live = {name: package(first, name) for name in ("network", "system", "wireless")}
    again = render_node(box(release), NAME, fleets.secrets, SHARED, DeviceFacts("", live))
    assert again.files == first.files
    assert again.config_hash == first.config_hash == render(box(release)).config_hash
