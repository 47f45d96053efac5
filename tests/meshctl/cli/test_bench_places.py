"""Devices on the bench of a site's gateway: which sites have one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import cast

import pytest

from meshctl.apply.bootstrap import BenchTarget
from meshctl.cli.bench_places import named_places, no_answer_hint, places_in_lab, with_site
from meshctl.cli.extensions import LabFleet
from meshctl.device.connection import Endpoint
from meshctl.errors import InputError
from tests.meshctl.inventory.inventories import fleet_of

_SITES = """
    nats: {url: "nats://127.0.0.1:4222"}
    sites: {north: {ssh: {host: north.example.org}}, south: {nats: {}}}
    nodes: {n1: {hardware: rocket, address: 10.42.0.1, site: north}}
    """


def test_a_place_is_on_the_bench_of_a_gateway_that_can_be_logged_in_to(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, _SITES)
    assert with_site(fleet, BenchTarget(node="n1"), "north") == BenchTarget(node="n1", site="north")
    assert with_site(fleet, BenchTarget(node="n1"), "") == BenchTarget(node="n1")
    with pytest.raises(InputError, match="no such site") as caught:
        with_site(fleet, BenchTarget(), "nort")
    assert caught.value.hint == "did you mean 'north'?"
    with pytest.raises(InputError, match="has no login") as caught:
        with_site(fleet, BenchTarget(), "south")
    assert caught.value.hint == "set sites.south.ssh.host"


def test_an_interface_of_this_computer_leads_to_no_other_bench() -> None:
    assert named_places(["192.168.1.1:2222"], [], "north") == [BenchTarget("192.168.1.1", 2222)]
    with pytest.raises(InputError, match="--interface is one of this computer"):
        named_places([], ["lo"], "north")


class _Lab:
    node_names = ("base", "b01")

    def bench_endpoint(self, name: str) -> Endpoint:
        return Endpoint(f"127.255.0.{self.node_names.index(name) + 1}", 20022)


@pytest.mark.parametrize(
    ("given", "found"),
    [
        (BenchTarget("b01"), BenchTarget("127.255.0.2", 20022)),
        (BenchTarget("127.255.0.2", 20022), BenchTarget("127.255.0.2", 20022)),
        (BenchTarget("::1", 20022), BenchTarget("::1", 20022)),
    ],
)
def test_a_place_in_a_lab_is_a_virtual_node(given: BenchTarget, found: BenchTarget) -> None:
    assert places_in_lab([given], cast(LabFleet, _Lab())) == [found]


@pytest.mark.parametrize(
    ("given", "message", "hint"),
    [
        (BenchTarget("192.168.1.1"), "--at 192.168.1.1 is not in the lab", "for example: --at b01"),
        (BenchTarget("b02"), "--at b02 is not in the lab", "did you mean 'b01'?"),
        (BenchTarget(interface="eth1"), "--interface eth1 is not in the lab", "for example: --at b01"),
    ],
)
def test_a_lab_reaches_no_real_device(given: BenchTarget, message: str, hint: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        places_in_lab([given], cast(LabFleet, _Lab()))
    assert caught.value.hint == hint


def test_silence_on_the_bench_names_its_probable_reason(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, _SITES)
    node = fleet.nodes["n1"]
    for place in (BenchTarget(node="n1"), BenchTarget("127.255.0.4", 2022, node="n1")):
        text = no_answer_hint(place, node, is_pinned=True)
        assert "n1 has a pinned host key, so it is probably set up already and answers at 10.42.0.1" in text
        assert "`meshctl status n1`" in text
        assert "--replace-key" in text
        unfinished = no_answer_hint(place, node, is_pinned=True, is_unfinished=True)
        assert unfinished.startswith("the last run left its change of n1 unconfirmed")
        assert "reset it" not in unfinished
    assert "in the network of 192.168.1.1; if another device had this address" in no_answer_hint(
        BenchTarget(), None, is_pinned=False
    )
    assert no_answer_hint(BenchTarget("10.0.0.9"), node, is_pinned=False) == ""
    assert no_answer_hint(BenchTarget(site="north"), None, is_pinned=False) == ""
