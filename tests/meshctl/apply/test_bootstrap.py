"""A device is identified by its MACs, or by the operator's word where the inventory has no MAC."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from unittest.mock import Mock

import pytest

from meshctl.apply.bootstrap import BenchTarget, Discovered, FoundDevice, identify, require_site, restore_pins
from meshctl.apply.replace import adopt, identity_edits
from meshctl.device.observation import BoardInfo, Observation
from meshctl.device.trust import HostKey, TrustStore
from meshctl.errors import NodeError, Unreachable
from meshctl.model import Fleet, NodeState
from meshctl.nodes.connections import ConnectionPool
from tests.meshctl.plan.support import factory, fleet

MAC = "02:4d:00:00:00:01"


def labelled() -> Fleet:
    """b01 has a MAC, a label and a serial number; b02 and the others nothing."""
    team = fleet()
    b01 = replace(team.nodes["b01"], mac=MAC, label="H1-1", serial="SN1")
    return replace(team, nodes=MappingProxyType({**team.nodes, "b01": b01}))


def device(*macs: str) -> Observation:
    return replace(factory(fleet(), "b01"), macs={f"eth{index}": mac for index, mac in enumerate(macs)})


def test_a_mac_identifies_the_node() -> None:
    assert identify(labelled(), device(MAC.upper()), "").name == "b01"
    label = replace(device(), board=BoardInfo("compex,wpj344-16m", label_mac=MAC))
    assert identify(labelled(), label, "").name == "b01"


def test_an_unknown_device_must_be_named_by_the_operator() -> None:
    with pytest.raises(NodeError, match="cannot identify the node"):
        identify(labelled(), device("02:00:00:00:00:42"), "")
    assert identify(labelled(), device("02:00:00:00:00:42"), "b02").name == "b02"


def test_a_device_with_the_wrong_mac_is_rejected_even_if_named_by_the_operator() -> None:
    with pytest.raises(NodeError, match="expected b02, its MAC belongs to b01") as caught:
        identify(labelled(), device(MAC), "b02")
    assert caught.value.hint == "swap the cables, or omit the node names: devices are then identified by MAC"
    with pytest.raises(NodeError, match="b01 has MAC 02:4d:00:00:00:01, this one has 02:00:00:00:00:42"):
        identify(labelled(), device("02:00:00:00:00:42"), "b01")


def test_the_same_node_at_two_addresses_is_rejected() -> None:
    with pytest.raises(NodeError, match="already found at another address"):
        identify(labelled(), device(MAC), "", identified=["b01"])


def test_a_device_on_the_bench_of_a_site_must_be_of_that_site() -> None:
    b01 = replace(fleet().nodes["b01"], site="north")
    require_site(b01, BenchTarget(site="north"))
    require_site(b01, BenchTarget())
    for node, where in ((b01, "north"), (fleet().nodes["b01"], "none")):
        with pytest.raises(NodeError, match=f"b01 is at site south, and in the inventory at {where}"):
            require_site(node, BenchTarget(site="south"))
    assert str(BenchTarget(node="b01", site="north")) == "b01 at 192.168.1.1 at site north"


def test_a_spare_hands_over_its_mac_label_and_serial_and_retires() -> None:
    team = labelled()
    spare = replace(team.nodes["b02"], mac="02:4d:00:00:00:02", label="S1", state=NodeState.SPARE)
    mine, theirs = identity_edits(team.nodes["b01"], spare, device("02:4d:00:00:00:02"))
    assert mine == {"mac": "02:4d:00:00:00:02", "label": "S1"}
    assert theirs == {"state": "retired"}


def test_the_way_to_a_spare_that_is_still_in_its_factory_state_is_named(tmp_path: Path) -> None:
    team = fleet()
    pool = Mock(spec=ConnectionPool, fleet=team)
    pool.open.side_effect = Unreachable("b02 (10.42.0.102): cannot connect: Connection refused")
    with pytest.raises(Unreachable, match="cannot connect") as caught:
        adopt(
            Mock(),
            pool,
            TrustStore(tmp_path / "known_hosts"),
            team.nodes["b01"],
            spare=team.nodes["b02"],
            target=None,
            has_taken_over=False,
            interrupt=Mock(),
        )
    assert caught.value.hint == "if b02 has its factory settings, say where it is: --interface IF or --at HOST"


def test_rejected_devices_have_their_previous_host_key_pins_restored(tmp_path: Path) -> None:
    trust = TrustStore(tmp_path / "known_hosts")
    old, new = (HostKey("ssh-ed25519", b"\0\0\0\x0bssh-ed25519\0\0\0 " + bytes([number]) * 32) for number in (1, 2))
    trust.replace("b01", old)
    for name in ("b01", "b02"):
        trust.replace(name, new)
    found = {
        name: FoundDevice(BenchTarget(node=name), fleet().nodes[name], device(), new, pins)
        for name, pins in (("b01", (old,)), ("b02", ()))
    }
    restore_pins(trust, Discovered(found, ()), ["b01", "b02"])
    assert (trust.pinned("b01"), trust.pinned("b02")) == ((old,), ())
