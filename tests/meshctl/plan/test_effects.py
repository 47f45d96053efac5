"""What a change interrupts: what the services of each release take down, and what affects logins."""

from __future__ import annotations

import pytest

from meshctl.model import RELEASES, Release
from meshctl.plan import Cut
from meshctl.plan.effects import effects
from meshctl.plan.values import Effect
from meshctl.render import LAN_FILTER_PATH
from meshctl.uci import Package, parse

WIRELESS = """\
config wifi-device 'radio0'
	option channel '6'
	option htmode 'HT20'
	option country 'US'
	option txpower '27'
	option rts '2347'

config wifi-iface 'mesh0'
	option device 'radio0'
	option ifname 'mesh0'
	option mode 'adhoc'
	option encryption 'none'
"""


def wireless(old: str = "", new: str = "") -> Package:
    assert old in WIRELESS
    return parse(WIRELESS.replace(old, new, 1), "wireless")


def cut_by(old: str, new: str, release: Release) -> Effect:
    (effect,) = effects(["etc/config/wireless"], {"wireless": wireless()}, {"wireless": wireless(old, new)}, release)
    return effect


@pytest.mark.parametrize("release", RELEASES)
def test_a_channel_change_restarts_the_radio_on_every_release(release: Release) -> None:
    assert cut_by("channel '6'", "channel '11'", release) == Effect("wifi", Cut.MESH, "radio0 restarts: channel")


@pytest.mark.parametrize("release", RELEASES)
@pytest.mark.parametrize(("old", "new"), [("txpower '27'", "txpower '28'"), ("rts '2347'", "rts '500'")])
def test_some_options_restart_the_radio_only_up_to_22_03(old: str, new: str, release: Release) -> None:
    option = old.partition(" ")[0]
    expected = (
        Effect("wifi", Cut.MESH, f"radio0 restarts: {option}")
        if release < Release.V23_05
        else Effect("wifi", Cut.NOTHING, f"radio0: {option} set without a restart")
    )
    assert cut_by(old, new, release) == expected


@pytest.mark.parametrize(
    ("old", "new"), [("txpower '27'", "txpower '9'"), ("country 'US'", "country 'DE'"), ("option txpower '27'\n", "")]
)
@pytest.mark.parametrize("release", RELEASES)
def test_reduced_range_cuts_weak_links_if_the_radio_does_not_restart(old: str, new: str, release: Release) -> None:
    effect = cut_by(old, new, release)
    if release < Release.V23_05:
        assert effect.cut is Cut.MESH
        assert "restarts" in effect.why
    else:
        assert effect.cut is Cut.WEAK_LINKS
        assert effect.why.endswith("set without a restart")


def test_with_wpa_supplicant_a_country_change_restarts_the_radio() -> None:
    before = WIRELESS.replace("'none'", "'psk2+ccmp'")
    after = before.replace("'US'", "'DE'")
    (effect,) = effects(
        ["etc/config/wireless"],
        {"wireless": parse(before, "wireless")},
        {"wireless": parse(after, "wireless")},
        Release.V24_10,
    )
    assert effect == Effect("wifi", Cut.MESH, "radio0 restarts: country")


def test_an_interface_that_differs_restarts_its_radio() -> None:
    assert cut_by("mode 'adhoc'", "mode 'mesh'", Release.V24_10).cut is Cut.MESH


def test_a_radio_that_is_added_or_removed_restarts() -> None:
    without = parse("config wifi-device 'radio1'\n\toption channel '36'\n", "wireless")
    found = effects(["etc/config/wireless"], {"wireless": wireless()}, {"wireless": without}, Release.V24_10)
    assert {effect.why.partition(" ")[0]: effect.cut for effect in found} == {"radio0": Cut.MESH, "radio1": Cut.LAN}


GUESTS = """
config wifi-device 'radio1'
	option channel '36'
	option txpower '20'

config wifi-iface 'guests'
	option device 'radio1'
	option mode 'ap'
	option ssid 'guests'
"""


@pytest.mark.parametrize("release", RELEASES)
@pytest.mark.parametrize(("old", "new"), [("ssid 'guests'", "ssid 'visitors'"), ("'36'", "'40'"), ("'20'", "'9'")])
def test_a_radio_with_access_points_alone_cuts_no_mesh_link(old: str, new: str, release: Release) -> None:
    before, after = WIRELESS + GUESTS, WIRELESS + GUESTS.replace(old, new)
    was, will_be = ({"wireless": parse(text, "wireless")} for text in (before, after))
    (effect,) = effects(["etc/config/wireless"], was, will_be, release)
    expected = Cut.NOTHING if new == "'9'" and release >= Release.V23_05 else Cut.LAN
    assert effect.cut is expected


def test_an_access_point_takes_the_mesh_on_its_radio_down_with_it() -> None:
    texts = [WIRELESS + GUESTS.replace("device 'radio1'", "device 'radio0'").replace("'guests'", name) for name in "ab"]
    was, will_be = ({"wireless": parse(text, "wireless")} for text in texts)
    assert effects(["etc/config/wireless"], was, will_be, Release.V24_10)[0].cut is Cut.MESH


def test_dropbear_and_firewall_changes_cut_logins() -> None:
    empty = {"firewall": Package("firewall"), "dropbear": Package("dropbear")}
    for package in empty:
        (effect,) = effects([f"etc/config/{package}"], empty, empty, Release.V24_10)
        assert effect.cut is Cut.LOGIN


def test_a_changed_lan_filter_reloads_the_firewall() -> None:
    (effect,) = effects([LAN_FILTER_PATH], {}, {}, Release.V24_10)
    assert (effect.service, effect.cut) == ("firewall", Cut.LOGIN)


BRIDGED = """\
config device 'br_lan'
	option name 'br-lan'
	list ports 'eth0'
	list ports 'bat0'

config interface 'lan'
	option device 'br-lan'
	option proto 'static'
	option ipaddr '10.42.0.11'

config interface 'bat0'
	option proto 'batadv'

config route
	option interface 'lan'
	option target '10.43.2.0'
	option netmask '255.255.255.0'
	option gateway '10.42.0.12'
"""
BACKBONE = """
config interface 'backbone'
	option device 'bat0'
	option proto 'static'
	option ipaddr '10.42.0.11'
"""


def network_effects(before: str, after: str) -> list[tuple[Cut, str]]:
    old, new = ({"network": parse(text, "network")} for text in (before, after))
    return [(effect.cut, effect.why) for effect in effects(["etc/config/network"], old, new, Release.V23_05)]


def test_changed_routes_leave_every_interface_up() -> None:
    other = BRIDGED.replace("10.43.2.0", "10.43.3.0")
    assert network_effects(BRIDGED, other) == [(Cut.LOGIN, "routes to the robots' LANs change")]
    without = BRIDGED[: BRIDGED.index("config route")]
    assert network_effects(without, BRIDGED) == [(Cut.LOGIN, "routes to the robots' LANs change")]


def test_a_bridge_that_becomes_a_router_cuts_its_lan_and_keeps_its_management_address() -> None:
    routed = BRIDGED.replace("\tlist ports 'bat0'\n", "").replace("10.42.0.11", "10.43.1.1") + BACKBONE
    assert network_effects(BRIDGED, routed) == [(Cut.LAN, "it routes its LAN, which leaves the mesh's network")]
    assert network_effects(routed, BRIDGED) == [(Cut.LAN, "it bridges its LAN into the mesh's network")]


IN_DEVICE = ("option htmode 'HT20'\n\toption country 'US'", "option country 'US'\n\toption htmode 'HT20'")
IN_INTERFACE = ("option ifname 'mesh0'\n\toption mode 'adhoc'", "option mode 'adhoc'\n\toption ifname 'mesh0'")
NO_CHANGE = Effect("wifi", Cut.NOTHING, "no radio changes")
RESTART = Effect("wifi", Cut.MESH, "radio0 restarts: order of options")
REJOIN = Effect("wifi", Cut.MESH, "the interfaces of radio0 leave their networks and return: order of options")


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        (IN_DEVICE, [RESTART, RESTART, RESTART, NO_CHANGE, NO_CHANGE, NO_CHANGE]),
        (IN_INTERFACE, [RESTART, RESTART, RESTART, REJOIN, REJOIN, NO_CHANGE]),
    ],
    ids=["radio", "interface"],
)
def test_options_in_another_order_cut_what_netifd_takes_down_for_them(
    place: tuple[str, str], expected: list[Effect]
) -> None:
    # an edit by hand has moved an option; meshctl writes the file for another reason, such as another radio
    assert [cut_by(*place, release) for release in RELEASES] == expected


def test_a_change_in_place_names_the_order_of_options_where_that_reconnects_the_interface() -> None:
    moved = wireless(*IN_INTERFACE)
    louder = parse(WIRELESS.replace("'27'", "'28'"), "wireless")
    (effect,) = effects(["etc/config/wireless"], {"wireless": moved}, {"wireless": louder}, Release.V24_10)
    assert effect.cut is Cut.MESH
    assert effect.why == "the interfaces of radio0 leave their networks and return: txpower, order of options"
