"""The firewall's stand-ins against fw3 and fw4 as read and run (openwrt-facts.md, sections 11 and 12)."""

from __future__ import annotations

import re

import pytest

from meshlab.fleet import VirtualFleet, VirtualNode
from tests.meshlab.conftest import answers, connect, run
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

CLOSE = "uci set firewall.@zone[0].input=REJECT; uci commit firewall"
LOADED = "nft -a list chain inet fw4 input"


def test_a_rejecting_zone_blocks_new_connections_once_loaded(node: VirtualNode) -> None:
    transport = connect(node.bench)
    before = node.exec(LOADED).check("list").stdout
    node.exec(f"{CLOSE}; reload_config").check("close")
    assert answers(node.bench)
    assert node.exec(LOADED).stdout == before
    until(lambda: not answers(node.bench), "the firewall")
    assert node.exec(LOADED).stdout != before
    assert run(transport, "echo still here") == "still here\n"
    transport.close()


def test_an_ssh_rule_takes_precedence_over_its_zone(node: VirtualNode) -> None:
    rule = "uci add firewall rule; " + "".join(
        f"uci set firewall.@rule[-1].{option}; "
        for option in ("name=Allow-SSH", "src=lan", "proto=tcp", "dest_port=22", "target=ACCEPT")
    )
    node.exec(f"{rule}{CLOSE}; fw4 reload").check("close all but SSH")
    assert answers(node.bench)
    node.exec("uci set firewall.@rule[-1].dest_port=80; uci commit; fw4 reload").check("close")
    until(lambda: not answers(node.bench), "the firewall")


def test_fw4_reload_exits_0_and_keeps_the_old_rules_when_nft_fails(node: VirtualNode) -> None:
    node.exec("mkdir -p /etc/nftables.d; echo 'chain broken {' >/etc/nftables.d/own.nft").check("break it")
    before = node.exec(LOADED).stdout
    state = node.exec("ls -li /var/run/fw4.state").stdout
    assert node.exec(f"{CLOSE}; fw4 reload").exit_status == 0
    assert node.exec("ls -li /var/run/fw4.state").stdout != state
    assert node.exec(LOADED).stdout == before
    assert answers(node.bench)
    assert node.exec("fw4 check").exit_status == 1


def test_rule_handles_change_on_every_load_but_table_and_chain_handles_do_not(node: VirtualNode) -> None:
    def handles() -> list[int]:
        return [int(found) for found in re.findall(r"# handle (\d+)", node.exec(LOADED).check("list").stdout)]

    before = handles()
    node.exec("fw4 reload").check("reload")
    after = handles()
    assert after[:2] == before[:2] == [1, 1]
    assert min(after[2:]) > max(before[2:])


def test_fw4_reload_fails_without_its_state_file(node: VirtualNode) -> None:
    refused = node.exec("rm /var/run/fw4.state; fw4 reload")
    assert (refused.exit_status, refused.stderr) == (1, "The fw4 firewall does not appear to be loaded.\n")
    node.exec("fw4 start").check("start")
    assert node.exec("fw4 start").exit_status == 1


def test_an_invalid_config_blocks_all_access_under_fw4_and_changes_nothing_under_fw3(
    fleet: VirtualFleet, node: VirtualNode
) -> None:
    damage = "cp /etc/config/firewall /tmp/firewall; echo 'option without' >/etc/config/firewall"
    assert node.exec(f"{damage}; fw4 reload").exit_status == 0
    until(lambda: not answers(node.bench), "the lock-out")
    old = fleet.node("old")
    assert old.exec("command -v fw4 nft").exit_status != 0
    assert old.exec(f"{damage}; fw3 reload").exit_status == 1
    assert answers(old.bench)
    old.exec("cp /tmp/firewall /etc/config/firewall; fw3 reload; [ -s /var/run/fw3.state ]").check("back")


def test_stopping_the_firewall_lets_everything_in(node: VirtualNode) -> None:
    node.exec(f"{CLOSE}; fw4 reload").check("close")
    until(lambda: not answers(node.bench), "the firewall")
    node.exec("/etc/init.d/firewall stop").check("stop")
    until(lambda: answers(node.bench), "no firewall")
    assert node.exec("ls /var/run/fw4.state").exit_status != 0


def test_a_reload_under_way_holds_the_lock(node: VirtualNode) -> None:
    beside = "fw4 reload & until [ ! -e /var/run/fw4.state ]; do :; done; flock -n /var/run/fw4.lock true; echo $?"
    assert (
        node.exec(f"{beside}; flock /var/run/fw4.lock ls /var/run/fw4.state; wait").stdout == "1\n/var/run/fw4.state\n"
    )
