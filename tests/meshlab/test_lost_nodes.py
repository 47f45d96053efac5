"""Failures that lost nodes on real OpenWrt 24.10 and 25.12, reproduced in the virtual fleet.

Changes that were confirmed although they lock out all logins, were rolled back although they succeeded, or made the
neighbors of a node drop its unicast frames.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from meshctl.model import Release
from meshlab.fleet import VirtualFleet
from tests.meshctl.proof.rig import Rig
from tests.meshlab.conftest import in_mesh
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

# long enough for a reload on a busy machine
WINDOW_S = 40
ADDRESS = "10.42.1.1"
# the maximum delay of a change's effects after its confirmation: procd's second, the firewall's, and a slow radio
LATE_S = 10.0


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(Release.V24_10, id="24.10"),
        # its stand-ins do not differ from 24.10's here
        pytest.param(Release.V25_12, id="25.12", marks=pytest.mark.proof),
    ],
)
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A base and two nodes that are reached only over the mesh, with inventory `a`."""
    with Rig(tmp_path_factory.mktemp("lost"), 2, window_s=WINDOW_S, release=request.param) as started:
        taken = started.take_in("a")
        assert (taken.code, set(taken.results.values())) == (0, {"done"}), taken.out + taken.err
        for name in started.names:
            started.fleet.node(name).plug(False)
        until(lambda: in_mesh(started.fleet) >= set(started.names), "the mesh")
        until(lambda: greets(started), "the way to n001")
        yield started


def variant(rig: Rig, name: str, more: str) -> str:
    """Inventory `a` with an additional line for n001."""
    text = rig.inventory("a").read_text(encoding="utf-8")
    rig.inventory(name).write_text(f"{text}  n001: {{{more}}}\n", encoding="utf-8")
    return name


def mac(fleet: VirtualFleet, name: str) -> str:
    return fleet.node(name).exec("cat /sys/class/net/mesh0/address").check("its MAC address").stdout.strip()


def greets(rig: Rig) -> bool:
    """Whether an SSH server answers a new connection to n001, which is reached only over the mesh."""
    endpoint = rig.fleet.endpoint(ADDRESS)
    try:
        with socket.create_connection((endpoint.host, endpoint.port), timeout=60) as connection:
            return connection.recv(4) == b"SSH-"
    except OSError:
        return False


def stays_reachable(rig: Rig) -> bool:
    """Whether it still does after all delayed effects."""
    rig.fleet.node("base").exec(f"sleep {LATE_S:g}").check("wait")
    return greets(rig)


def passes(rig: Rig) -> bool:
    """Whether unicast frames to n001 are answered."""
    return rig.fleet.node("base").exec(f"batctl ping -c 3 -t 1 {mac(rig.fleet, 'n001')}").exit_status == 0


@pytest.mark.parametrize(
    "lockout",
    [
        pytest.param("firewall.management.input: REJECT", id="firewall"),
        pytest.param("dropbear.main.enable: '0'", id="dropbear-off"),
        pytest.param("dropbear.main.Port: '2222'", id="dropbear-port"),
    ],
)
def test_a_change_that_locks_out_all_logins_is_not_confirmed(rig: Rig, lockout: str) -> None:
    closed = variant(rig, "closed", f"extra_uci: {{{lockout}}}")
    ended = rig.meshctl("provision", closed, "n001", "--yes", "--json")
    assert ended.results.get("n001") != "done", ended.out + ended.err
    assert stays_reachable(rig)
    assert rig.state_of("n001", "b", "a") == "new"


def test_a_tx_power_change_keeps_a_node_reachable(rig: Rig) -> None:
    before = rig.fleet.node("n001").exec("cat /sys/class/net/mesh0/ifindex").stdout
    weaker = variant(rig, "weaker", "radios: {radio0: {tx_power_dbm: 20}}")
    ended = rig.meshctl("provision", weaker, "n001", "--yes", "--json")
    assert ended.results == {"n001": "done"}, ended.out + ended.err
    until(lambda: "txpower 20.00 dBm" in rig.fleet.node("n001").exec("iw dev mesh0 info").stdout, "the power")
    assert rig.fleet.node("n001").exec("cat /sys/class/net/mesh0/ifindex").stdout == before
    assert stays_reachable(rig)
    assert passes(rig)


def test_a_cell_change_that_changes_radio_macs_is_kept(rig: Rig) -> None:
    before = {name: mac(rig.fleet, name) for name in ("base", *rig.names)}
    ended = rig.meshctl("provision", "split", "--yes", "--json")
    assert ended.results == dict.fromkeys(before, "done"), ended.out + ended.err
    assert "channel 11" in rig.fleet.node("n001").exec("iw dev mesh0 info").stdout
    assert stays_reachable(rig)
