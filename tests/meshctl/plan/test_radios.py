"""Which radios restart: those whose settings differ, and those whose station entries are all younger."""

from __future__ import annotations

from dataclasses import replace

import pytest

from meshctl.device.observation import Station
from meshctl.plan.radios import EVERY_RADIO, NO_RADIOS, Radios, restarting_radios, started_within
from meshctl.uci import Package, parse
from tests.meshctl.plan.support import fleet, running

WIRELESS = """\
config wifi-device 'radio0'
	option channel '6'

config wifi-iface 'mesh0'
	option device 'radio0'
	option ifname 'mesh0'
	option key 'one'

config wifi-device 'radio1'
	option channel '36'

config wifi-iface 'mesh1'
	option device 'radio1'
	option ifname 'mesh1'
	option key 'two'
"""


def wireless(old: str = "", new: str = "") -> Package:
    assert old in WIRELESS
    return parse(WIRELESS.replace(old, new, 1), "wireless")


@pytest.mark.parametrize(
    ("old", "new", "ifname"),
    [
        ("option channel '36'", "option channel '40'", "mesh1"),
        ("option key 'two'", "option key 'three'", "mesh1"),
        ("option key 'one'", "option key 'four'", "mesh0"),
        ("option channel '6'", "option channel '6'\n\toption disabled '1'", "mesh0"),
    ],
)
def test_only_the_radio_with_changed_settings_or_interface_restarts(old: str, new: str, ifname: str) -> None:
    assert restarting_radios(wireless(), wireless(old, new)) == Radios(frozenset({ifname}))


def test_a_radio_removed_from_the_configuration_restarts() -> None:
    _, _, without = WIRELESS.partition("config wifi-device 'radio1'")
    assert restarting_radios(
        wireless(), parse(WIRELESS.removesuffix("config wifi-device 'radio1'" + without), "wireless")
    ) == (Radios(frozenset({"mesh1"})))


def test_quoting_restarts_no_radio_but_the_order_of_options_may() -> None:
    quoted = wireless("option ifname 'mesh0'\n\toption key 'one'", 'option ifname "mesh0"\n\toption key one')
    assert restarting_radios(wireless(), quoted) == NO_RADIOS
    assert not NO_RADIOS
    # it does up to 22.03
    moved = wireless("option ifname 'mesh0'\n\toption key 'one'", "option key 'one'\n\toption ifname 'mesh0'")
    assert restarting_radios(wireless(), moved) == Radios(frozenset({"mesh0"}))


def test_unknown_interface_names_or_files_count_as_restarting_every_radio() -> None:
    nameless = wireless("\toption ifname 'mesh1'\n", "")
    assert restarting_radios(nameless, wireless()) == EVERY_RADIO
    assert restarting_radios(None, wireless()) == EVERY_RADIO
    assert restarting_radios(wireless(), None) == EVERY_RADIO
    assert "anything" in EVERY_RADIO


def test_a_radio_with_only_recent_station_entries_has_restarted() -> None:
    stations = (
        Station("mesh0", "02:00:00:00:00:01", connected_s=90),
        Station("mesh0", "02:00:00:00:00:02", connected_s=20),
        Station("mesh1", "02:00:00:00:00:03", connected_s=None),
    )
    seen = replace(running(fleet(), "b02"), stations=stations, uptime_s=5000.0)
    assert started_within(seen, 100.0) == Radios(frozenset({"mesh0"}))
    assert started_within(seen, 90.0) == NO_RADIOS
    assert started_within(replace(seen, stations=None), 100.0) == NO_RADIOS
    assert started_within(replace(seen, uptime_s=99.0), 100.0) == EVERY_RADIO
    # that long by the operator's clock, a little longer by its own
    assert started_within(replace(seen, uptime_s=101.0), 100.0) == EVERY_RADIO
