"""A node without a dnsmasq section resolves names by netifd's list (docs/facts/node-assumptions.md, finding 20)."""

from __future__ import annotations

import pytest

from meshctl.apply.change_set import reload_script
from meshlab.fleet import VirtualFleet, VirtualNode
from tests.meshlab.conftest import factory_reset
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("radios")]

REMOVE = "uci delete dhcp.@dnsmasq[0]; uci commit dhcp"


def name_servers(node: VirtualNode) -> str:
    """What /etc/resolv.conf is in the end: a path, or the text of a file of its own."""
    return node.exec("readlink /tmp/resolv.conf || cat /tmp/resolv.conf").stdout


@pytest.mark.parametrize(
    ("name", "servers"), [("old", "/tmp/resolv.conf.auto\n"), ("box", "/tmp/resolv.conf.d/resolv.conf.auto\n")]
)
def test_names_are_resolved_without_dnsmasq_after_the_reload_script(
    fleet: VirtualFleet, name: str, servers: str
) -> None:
    node = fleet.node(name)
    node.wait_up()
    until(lambda: "nameserver 127.0.0.1" in name_servers(node), "dnsmasq")
    node.exec(f"{REMOVE}\n{reload_script({'etc/config/dhcp'}, ())}").check("reload")
    assert name_servers(node) == servers
    factory_reset(node)


def test_openwrt_keeps_asking_a_dnsmasq_that_is_gone(node: VirtualNode) -> None:
    node.exec(f"{REMOVE}; reload_config").check("reload")
    until(lambda: "reloaded" in node.exec("logread | grep dnsmasq").stdout, "the reload")
    assert "nameserver 127.0.0.1" in name_servers(node)


def test_a_dnsmasq_that_stays_is_asked_as_before(node: VirtualNode) -> None:
    change = "uci set dhcp.lan.limit=99; uci commit dhcp"
    node.exec(f"{change}\n{reload_script({'etc/config/dhcp'}, ())}").check("reload")
    assert "nameserver 127.0.0.1" in name_servers(node)
