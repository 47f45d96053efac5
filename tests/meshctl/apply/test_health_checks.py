"""A change is confirmed only when everything the node had before works again."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import pytest

from meshctl.apply.health_checks import Expectation, expectation, unmet
from meshctl.device.observation import (
    Bridge,
    ChangeStatus,
    MeshInfo,
    MeshNeighbor,
    NetInterface,
    Observation,
    Originator,
    RadioState,
    WirelessLink,
)
from meshctl.uci import dump, parse
from tests.meshctl.plan.support import fleet, running, wanted

BASE = "02:00:00:00:00:01"
OTHER = "02:00:00:00:00:02"
LAN = (NetInterface("lan", True, False, "br-lan", ("10.42.0.101/24",)),)


@cache
def good() -> Observation:
    return running(
        fleet(),
        "b01",
        neighbors=(BASE, OTHER),
        originators=(Originator(BASE, BASE, "mesh0", 200, True, 250),),
        links=(WirelessLink("mesh0", "IBSS", bssid="02:ca:fe:00:00:01", channel=6, joined=True),),
        interfaces=LAN,
        bridges=(Bridge("br-lan", ("bat0", "eth0")),),
        macs={"eth0": "02:00:00:00:00:10", "bat0": "02:00:00:00:00:20"},
        mesh=MeshInfo("2024.3", "BATMAN_IV", hard_interfaces=("mesh0",)),
        change=ChangeStatus("applied", "c1", window_s=60, left_s=40.0, reload_status=0),
    )


def gaps(after: Observation, since_s: float | None = 20.0) -> tuple[str, ...]:
    return unmet(expectation(wanted(fleet(), "b01"), good(), [BASE]), after, since_s=since_s)


def test_a_node_that_regained_everything_passes_the_health_check() -> None:
    assert gaps(good()) == ()


@pytest.mark.parametrize(
    ("after", "gap"),
    [
        (
            replace(good(), change=ChangeStatus("applied", "c1", reload_status=None)),
            "its services are still reloading",
        ),
        (
            replace(good(), change=ChangeStatus("applied", "c1", reload_status=2)),
            "reloading its services failed with exit status 2",
        ),
        (
            replace(good(), change=ChangeStatus("applied", "c1", reload_status=75)),
            "its services had not reloaded within the confirm window: it needs a longer confirm_window_s",
        ),
        (replace(good(), interfaces=()), "its LAN is down"),
        (
            replace(good(), interfaces=(NetInterface("lan", True, False, "br-lan", ("10.42.0.9/24",)),)),
            "its LAN has 10.42.0.9/24, not 10.42.0.101",
        ),
        (replace(good(), bridges=(Bridge("br-lan", ("bat0",)),)), "eth0 not in its bridge br-lan"),
        (replace(good(), links=()), "mesh0 does not exist"),
        # 24.10.7, a radio whose setup ended with an error: retry_setup_failed, and not pending
        (
            replace(good(), links=(), radios=(RadioState("radio0", False, False, False, True, {}, (("mesh0", ""),)),)),
            "mesh0 does not exist: netifd gave up setting up radio0",
        ),
        (
            replace(good(), links=(WirelessLink("mesh0", "IBSS", channel=6, joined=False),)),
            "mesh0 has not joined its cell",
        ),
        (
            replace(good(), links=(WirelessLink("mesh0", "IBSS", channel=1, joined=True),)),
            "mesh0 is on channel 1, not 6",
        ),
        (
            replace(good(), links=(WirelessLink("mesh0", "IBSS", bssid="06:00:00:00:00:07", channel=6),)),
            "mesh0 is in cell 06:00:00:00:00:07, not 02:ca:fe:00:00:01",
        ),
        # 25.12.5: a supplicant that cannot join a mesh, and is restarted every few seconds
        (
            replace(good(), links=(WirelessLink("mesh0", "mesh point", joined=False),)),
            "mesh0 has not joined its cell",
        ),
        # proto.c of netifd: a protocol without a handler
        (
            replace(
                good(),
                interfaces=(*LAN, NetInterface("mesh0", False, False, errors=("INVALID_PROTO",))),
            ),
            "netifd does not know batman-adv: /lib/netifd/proto/batadv_hardif.sh is missing or fails",
        ),
        (replace(good(), macs={"eth0": "02:00:00:00:00:10"}, mesh=None), "bat0 does not exist"),
        (replace(good(), mesh=MeshInfo(hard_interfaces=())), "mesh0 is not part of bat0"),
        (replace(good(), mesh=MeshInfo(hard_interfaces=("mesh1",))), "mesh0 is not part of bat0"),
        (replace(good(), neighbors=()), "it hears 0 mesh neighbors of the 2 it had"),
        (replace(good(), originators=()), "it has no route to the base"),
    ],
)
def test_each_missing_item_is_named(after: Observation, gap: str) -> None:
    assert gaps(after) == (gap,)


def test_half_of_the_previous_neighbors_is_enough() -> None:
    assert gaps(replace(good(), neighbors=(MeshNeighbor("02:00:00:00:00:77", "mesh0", 10),))) == ()


def test_neighbors_last_heard_before_the_change_do_not_count() -> None:
    stale = replace(good(), neighbors=(MeshNeighbor(OTHER, "mesh0", 8000), MeshNeighbor(BASE, "mesh0", 8000)))
    assert gaps(stale, since_s=20.0) == ()
    assert gaps(stale, since_s=5.0) == ("it hears 0 mesh neighbors of the 2 it had",)


def test_a_node_alone_on_the_bench_needs_no_neighbors() -> None:
    alone = replace(good(), neighbors=(), originators=())
    assert unmet(expectation(wanted(fleet(), "b01"), alone, [BASE]), alone) == ()


def test_the_base_counts_only_if_it_was_reached_before() -> None:
    before = replace(good(), originators=())
    assert expectation(wanted(fleet(), "b01"), before, [BASE]).base_macs == frozenset()


def test_the_base_may_be_reached_by_a_mac_acquired_during_the_run() -> None:
    expected = expectation(wanted(fleet(), "b01"), good(), [BASE])
    moved = "42:00:00:00:00:01"
    after = replace(good(), originators=(Originator(moved, moved, "mesh0", 200, True, 250),))
    assert unmet(expected, after) == ("it has no route to the base",)
    assert unmet(expected.with_base_macs(frozenset({moved})), after) == ()
    assert expectation(wanted(fleet(), "b01"), good()).with_base_macs(frozenset({moved})).base_macs == frozenset()


@pytest.mark.parametrize(
    ("encryption", "supplicants", "gaps"),
    [
        ("psk2+ccmp", ("global", "mesh0"), ()),
        ("psk2+ccmp", ("global",), ("mesh0 is not encrypted: wpa_supplicant does not run it",)),
        ("none", ("global",), ()),
        # a release, or a lab, that does not say
        ("psk2+ccmp", None, ()),
    ],
)
def test_an_encrypted_radio_without_wpa_supplicant_fails_the_health_check(
    encryption: str, supplicants: tuple[str, ...] | None, gaps: tuple[str, ...]
) -> None:
    expected = expectation(wanted(fleet(), "b01"), good(), [BASE])
    assert expected.wireless is not None
    text = re.sub("option encryption '.*'", f"option encryption '{encryption}'", dump(expected.wireless))
    assert f"'{encryption}'" in text
    sealed = replace(expected, wireless=parse(text, "wireless"))
    assert unmet(sealed, replace(good(), supplicants=supplicants)) == gaps


ROUTER = parse(
    """
config interface 'lan'
	option proto 'static'
	option ipaddr '10.43.1.1'

config interface 'backbone'
	option device 'bat0'
	option proto 'static'
	option ipaddr '10.42.0.101'
""",
    "network",
)


@pytest.mark.parametrize(
    ("is_up", "addresses", "gaps_found"),
    [
        (True, ("10.42.0.101/24",), ()),
        (True, (), ("its mesh interface has no address, not 10.42.0.101",)),
        (False, ("10.42.0.101/24",), ("its mesh interface is down",)),
    ],
)
def test_a_router_needs_its_address_on_the_mesh_too(
    is_up: bool, addresses: tuple[str, ...], gaps_found: tuple[str, ...]
) -> None:
    wanted_state = replace(expectation(wanted(fleet(), "b01"), good(), [BASE]), network=ROUTER)
    lan = NetInterface("lan", True, False, "br-lan", ("10.43.1.1/24",))
    backbone = NetInterface("backbone", is_up, False, "bat0", addresses)
    assert unmet(wanted_state, replace(good(), interfaces=(lan, backbone)), since_s=20.0) == gaps_found


MESH1 = """
config wifi-iface 'mesh1'
	option device 'radio0'
	option network 'mesh1'
	option ifname 'mesh1'
	option mode 'adhoc'
"""


def with_a_second_interface() -> Observation:
    """A node with an interface that the inventory turns off, and that hears most of its neighbors over it."""
    node = good()
    assert node.uci is not None
    return replace(
        node,
        uci={**node.uci, "wireless": node.uci["wireless"] + MESH1},
        links=(*(node.links or ()), WirelessLink("mesh1", "IBSS", bssid="02:ca:fe:00:00:01", channel=6, joined=True)),
        neighbors=(
            *(node.neighbors or ()),
            *(MeshNeighbor(f"02:00:00:00:01:{number:02x}", "mesh1", 100) for number in range(5)),
        ),
    )


def test_an_interface_that_is_turned_off_must_be_gone() -> None:
    """25.12.5: netifd reports the radio as down, and it continues in its cell."""
    before = with_a_second_interface()
    expected = expectation(wanted(fleet(), "b01"), before, [BASE])
    after = replace(before, neighbors=good().neighbors)
    assert unmet(expected, after) == ("mesh1 should be off, but still exists",)
    assert unmet(expected, replace(after, links=good().links)) == ()


def test_neighbors_that_only_an_interface_heard_that_is_turned_off_are_not_waited_for() -> None:
    expected = expectation(wanted(fleet(), "b01"), with_a_second_interface(), [BASE])
    assert expected.neighbors == {BASE, OTHER}


def test_an_interface_that_is_not_ours_may_stay() -> None:
    monitor = (*(good().links or ()), WirelessLink("mon0", "monitor"))
    assert gaps(replace(good(), links=monitor)) == ()


GUEST_AP = WirelessLink("phy1-ap0", "AP", ssid="guests", channel=6)


def with_an_access_point(**options: str) -> Expectation:
    expected = expectation(wanted(fleet(), "b01"), good(), [BASE])
    assert expected.wireless is not None
    section = "".join(f"\toption {name} '{value}'\n" for name, value in {"device": "radio0", **options}.items())
    text = f"{dump(expected.wireless)}\nconfig wifi-iface 'guest'\n{section}"
    return replace(expected, wireless=parse(text, "wireless"))


def test_an_interface_that_openwrt_names_itself_is_found_by_its_mode_and_ssid() -> None:
    expected = with_an_access_point(mode="ap", ssid="guests")
    assert unmet(expected, good()) == ("the interface of guest does not exist",)
    for found in (GUEST_AP, replace(GUEST_AP, ssid=None)):
        assert unmet(expected, replace(good(), links=(*(good().links or ()), found))) == ()
    other = replace(GUEST_AP, ssid="others")
    assert unmet(expected, replace(good(), links=(*(good().links or ()), other))) != ()


def test_an_encrypted_access_point_is_not_one_of_wpa_supplicant() -> None:
    expected = with_an_access_point(mode="ap", ssid="guests", encryption="owe", ifname="phy1-ap0")
    after = replace(good(), links=(*(good().links or ()), GUEST_AP), supplicants=("mesh0",))
    assert unmet(expected, after) == ()
