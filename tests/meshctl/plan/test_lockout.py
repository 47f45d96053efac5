"""A plan that would lock the operator out is refused before anything is sent."""

from __future__ import annotations

import base64
from dataclasses import replace

import pytest

from meshctl.device.connection import OwnKey
from meshctl.model import Release
from meshctl.plan import DesiredState, Verdict
from meshctl.plan.lockout import AUTHORIZED_KEYS, firewall_notes, lockout, server_lockout
from meshctl.uci import parse
from tests.meshctl.plan.support import factory, fleet, planned, running, wanted

TEAM = fleet()
AUTHORIZED = TEAM.operators.ssh_keys[0]
OURS = OwnKey("agent key alice", "ssh-ed25519", base64.b64decode(AUTHORIZED.split()[1]))
OTHER = OwnKey("key /home/bob/.ssh/id_ed25519", "ssh-ed25519", b"\0\0\0\x0bssh-ed25519\0\0\0 " + bytes(32))


NODE = TEAM.nodes["b01"]


def contents(want: DesiredState) -> dict[str, bytes]:
    return {file.path: file.content for file in want.files}


def test_a_change_is_planned_if_one_of_our_keys_is_authorized() -> None:
    assert planned(TEAM, "b01", factory(TEAM, "b01"), own_keys=(OTHER, OURS)).verdict is Verdict.CHANGE


def test_a_change_that_locks_out_all_our_keys_is_refused_with_both_lists() -> None:
    plan = planned(TEAM, "b01", factory(TEAM, "b01"), own_keys=(OTHER,))
    assert plan.verdict is Verdict.REFUSED
    assert f"it gets the keys {OURS.fingerprint} (alice)" in plan.reason
    assert f"{OTHER.fingerprint} ({OTHER.name})" in plan.reason
    assert "operators.ssh_keys" in plan.hint
    assert plan.files == ()


def test_a_change_without_any_own_key_is_refused() -> None:
    plan = planned(TEAM, "b01", factory(TEAM, "b01"), own_keys=())
    assert plan.verdict is Verdict.REFUSED
    assert plan.reason.endswith("your keys: none")


def test_an_unchanged_node_needs_none_of_our_keys() -> None:
    assert planned(TEAM, "b01", running(TEAM, "b01"), own_keys=()).verdict is Verdict.SAME


def test_lockout_is_not_checked_without_our_keys() -> None:
    assert planned(TEAM, "b01", factory(TEAM, "b01")).verdict is Verdict.CHANGE


def test_openwrt_19_07_accepts_only_rsa_keys() -> None:
    want = wanted(TEAM, "b01")
    old = replace(want.node, release=Release.V19_07)
    assert lockout(want.node, contents(want), (OURS,)) is None
    refused = lockout(old, contents(want), (OURS,))
    assert refused is not None
    assert "your keys that OpenWrt 19.07 supports: none" in refused.reason


def test_a_user_other_than_root_is_not_checked_for_lockout() -> None:
    want = wanted(TEAM, "b01")
    node = replace(want.node, ssh=replace(want.node.ssh, user="admin"))
    assert lockout(node, contents(want), ()) is None


def test_an_invalid_authorized_keys_line_is_reported() -> None:
    want = wanted(TEAM, "b01")
    refused = lockout(want.node, {AUTHORIZED_KEYS: b"ssh-rsa AAAA! x\n"}, ())
    assert refused is not None
    assert "it gets the keys an unreadable key" in refused.reason


NETWORK = """\
config interface 'loopback'
	option proto 'static'

config interface 'lan'
	option proto 'static'

config interface 'wan'
	option proto 'dhcp'
"""


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ("", ""),
        ("\toption Interface 'lan'\n", ""),
        ("\toption enable '0'\n", "its dropbear is disabled"),
        ("\toption enable 'off'\n", "its dropbear is disabled"),
        ("\toption Interface 'nosuch'\n", "dropbear would wait for Interface nosuch"),
        # a network that is there, whose address may never come
        ("\toption Interface 'wan'\n", "dropbear would wait for Interface wan"),
        ("\toption DirectInterface 'nosuch'\n", "dropbear would wait for DirectInterface nosuch"),
    ],
)
def test_a_dropbear_that_would_not_listen_after_a_boot_is_refused(options: str, reason: str) -> None:
    packages = {
        "network": parse(NETWORK, "network"),
        "dropbear": parse(f"config dropbear 'main'\n\toption Port '22'\n{options}", "dropbear"),
    }
    found = server_lockout(NODE, packages)
    assert (found is not None) == bool(reason)
    assert found is None or reason in found.reason
    assert found is None or "extra_uci" in found.hint


@pytest.mark.parametrize(
    "missing", ["\toption Interface 'nosuch'\n", "\toption Interface 'nosuch'\n\toption DirectInterface 'nosuch'\n"]
)
def test_one_listening_dropbear_instance_is_enough(missing: str) -> None:
    text = f"config dropbear 'main'\n\toption enable '1'\n\nconfig dropbear 'other'\n{missing}"
    assert server_lockout(NODE, {"network": parse(NETWORK, "network"), "dropbear": parse(text, "dropbear")}) is None


@pytest.mark.parametrize(
    ("options", "host", "reason"),
    [
        ("", "", ""),
        ("\toption Port '22'\n", "", ""),
        ("\tlist Port '2222'\n\tlist Port '22'\n", "", ""),
        ("\toption Port '2222'\n", "", "would listen on port 2222, and ssh.port is 22"),
        # a host in front of the node forwards to any port
        ("\toption Port '2222'\n", "10.0.0.9", ""),
    ],
)
def test_a_dropbear_on_another_port_is_refused(options: str, host: str, reason: str) -> None:
    packages = {
        "network": parse(NETWORK, "network"),
        "dropbear": parse(f"config dropbear 'main'\n{options}", "dropbear"),
    }
    found = server_lockout(replace(NODE, ssh=replace(NODE.ssh, host=host)), packages)
    assert (found is not None) == bool(reason)
    assert found is None or reason in found.reason


ZONE = "config zone 'management'\n\toption name 'mgmt'\n\tlist network 'lan'\n\toption input '{}'\n"
RULE = "\nconfig rule\n\toption src '{}'\n\toption dest_port '{}'\n\toption target '{}'\n"


@pytest.mark.parametrize(
    ("firewall", "is_noted"),
    [
        (ZONE.format("ACCEPT"), False),
        (ZONE.format("REJECT"), True),
        (ZONE.format("drop"), True),
        (ZONE.format("REJECT") + RULE.format("mgmt", "22", "ACCEPT"), False),
        (ZONE.format("REJECT") + RULE.format("*", "20-30", "ACCEPT"), False),
        (ZONE.format("REJECT") + RULE.format("mgmt", "80 ssh", "ACCEPT"), False),
        (ZONE.format("REJECT") + RULE.format("mgmt", "80", "ACCEPT"), True),
        (ZONE.format("REJECT") + RULE.format("mgmt", "22", "ACCEPT") + "\toption enabled '0'\n", True),
        # the rule for ping
        (
            ZONE.format("REJECT") + "config rule\n\toption src '*'\n\toption proto 'icmp'\n\toption target 'ACCEPT'\n",
            True,
        ),
        (ZONE.format("REJECT") + RULE.format("wan", "22", "ACCEPT"), True),
        (ZONE.format("REJECT") + RULE.format("mgmt", "22", "DROP"), True),
        # a zone of other networks
        (ZONE.format("REJECT").replace("'lan'", "'wan'"), False),
    ],
)
def test_a_firewall_that_refuses_ssh_is_noted(firewall: str, is_noted: bool) -> None:
    packages = {"network": parse(NETWORK, "network"), "firewall": parse(firewall, "firewall")}
    assert bool(firewall_notes(NODE, packages)) == is_noted
