"""rpcd's stand-in against what was recorded of rpcd on 24.10.7 and 25.12.5 (docs/facts/openwrt-checked.md)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from meshctl.model import Release
from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.spec import FleetSpec, NodeSpec
from tests.meshlab.luci import SNAPSHOT, await_rollback, call, edit, log_in, save_and_apply, waits

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rpcd")]

NODES = {"old": Release.V23_05, "new": Release.V25_12}
PLAIN = "plain"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualFleet]:
    nodes = [NodeSpec(name, release=release, packages=("rpcd",)) for name, release in NODES.items()]
    spec = FleetSpec("rpcd", (*nodes, NodeSpec(PLAIN)), ())
    with VirtualFleet(spec, tmp_path_factory.mktemp("rpcd") / "fleet") as running:
        yield running


@pytest.fixture(params=NODES)
def node(request: pytest.FixtureRequest, fleet: VirtualFleet) -> VirtualNode:
    found = fleet.node(request.param)
    found.exec("uci set dropbear.@dropbear[0].Port=22 && uci commit && /bin/sync").check("as from the factory")
    # what an earlier test has left in memory is gone
    found.power_cut()
    found.wait_up()
    return found


def port_of(node: VirtualNode) -> str:
    return node.exec("uci -q get dropbear.@dropbear[0].Port").stdout.strip()


def section(node: VirtualNode) -> str:
    return node.exec("uci -X show dropbear | sed -n 's/^dropbear.\\(.*\\)=dropbear$/\\1/p'").stdout.strip()


def test_what_a_session_saves_is_no_uncommitted_change_of_the_command_line(node: VirtualNode) -> None:
    edit(node, log_in(node), "dropbear", section(node), Port="2200")
    assert node.exec("uci changes").stdout == ""
    assert port_of(node) == "22"


def test_an_unconfirmed_apply_is_undone_with_whatever_was_written_since(node: VirtualNode) -> None:
    session = log_in(node)
    edit(node, session, "dropbear", section(node), Port="2200")
    save_and_apply(node, session, rollback_s=4)
    assert port_of(node) == "2200"
    assert waits(node)
    node.exec("uci set dropbear.@dropbear[0].Port=2300 && uci commit").check("edit it")
    await_rollback(node)
    assert port_of(node) == "22"
    # the session has its changes again, and nothing of the snapshot is left
    assert "2200" in node.exec(f"cat /var/run/rpcd/uci-{session}/dropbear").stdout
    assert node.exec(f"ls -A {SNAPSHOT} 2>/dev/null").stdout == ""


def test_no_call_is_answered_while_another_is_at_work(node: VirtualNode) -> None:
    """As by one process: a node that no longer waits has its files back."""
    at_work = "flock /var/run/rpcd.lock sh -c 'touch /tmp/at-work; sleep 3; echo done' >>/tmp/order &"
    begun = "until [ -e /tmp/at-work ]; do sleep 1; done"
    confirm = """ubus call uci confirm '{"ubus_rpc_session":"somebody"}' 2>/dev/null"""
    order = node.exec(f"{at_work} {begun}; {confirm}; echo answered >>/tmp/order; cat /tmp/order").stdout
    assert order.split() == ["done", "answered"]


def test_an_apply_is_confirmed_by_its_own_session_alone(node: VirtualNode) -> None:
    session, other = log_in(node), log_in(node)
    is_new = node.name == "new"
    denied, no_data = (250, 251) if is_new else (6, 5)
    assert call(node, "uci", "confirm", ubus_rpc_session=session)[0] == no_data
    edit(node, session, "dropbear", section(node), Port="2200")
    save_and_apply(node, session, rollback_s=300)
    status, text = call(node, "uci", "confirm", ubus_rpc_session=other)
    assert (status, "Permission denied" in text, "ubus call uci confirm" in text) == (denied, True, is_new)
    assert call(node, "uci", "apply", ubus_rpc_session=other, rollback=True)[0] == denied
    assert call(node, "uci", "confirm", ubus_rpc_session=session) == (0, "")
    assert port_of(node) == "2200"
    assert not waits(node)


def test_an_unchecked_apply_leaves_its_snapshot_until_the_next_boot(node: VirtualNode) -> None:
    session = log_in(node)
    edit(node, session, "dropbear", section(node), Port="2200")
    save_and_apply(node, session, rollback_s=None)
    assert not waits(node)
    assert node.exec(f"ls {SNAPSHOT}").stdout.split() == ["dropbear"]


def test_a_power_cut_makes_an_apply_permanent(node: VirtualNode) -> None:
    """Its snapshot and its timer are in memory: the weakness for which meshctl has a switch of its own."""
    session = log_in(node)
    edit(node, session, "dropbear", section(node), Port="2200")
    save_and_apply(node, session, rollback_s=300)
    node.power_cut()
    node.wait_up()
    assert port_of(node) == "2200"
    assert not waits(node)


def test_a_session_writes_only_what_it_was_granted(node: VirtualNode) -> None:
    session = "0123456789abcdef0123456789abcdef"
    values = {"config": "dropbear", "section": section(node), "values": {"Port": "2200"}}
    assert "Permission denied" in call(node, "uci", "set", ubus_rpc_session=session, **values)[1]


def test_a_node_without_rpcd_has_none_of_its_objects(fleet: VirtualFleet) -> None:
    plain = fleet.node(PLAIN)
    assert call(plain, "uci", "confirm", ubus_rpc_session="x") == (4, "Command failed: Not found\n")
    assert not {"uci", "session"} & set(plain.exec("ubus list").stdout.split())
