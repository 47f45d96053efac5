"""The permanent worker under a real systemd: installed, killed, rebooted; its files, and what its sandbox allows.

Each test ends with all nodes as the inventory has them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import pytest

from tests.meshctl.robots.lan import Lan
from tests.meshctl.robots.machine import debian
from tests.meshctl.sites.gateway_machine import ADDRESS, HOME, NODES, OPERATOR, UNIT, USER, GatewayRig
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("nats")]

# `systemd-analyze security`, in tenths of a point: a login user's systemd can neither drop capabilities, which such a
# user does not have, nor mount
MAX_EXPOSURE = 66
_PROVISION = ("provision", "--yes", "--json")
_AT_WORK = '"node": "n-base", "at_s": [0-9.]*, "text": "apply"'
_DONE = dict.fromkeys(NODES, "done")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GatewayRig]:
    """After `sites install`, with the worker accepted by the nodes through the gateway as jump host."""
    base, lan = debian(), Lan(OPERATOR)
    try:
        with lan.inside(), GatewayRig(tmp_path_factory.mktemp("gateway"), lan, base) as started:
            started.run("sites", "trust", "--yes", expected=0)
            first = started.install()
            assert f"it ends when {USER} logs out, until root runs `loginctl enable-linger {USER}` there" in first
            started.root(f"loginctl enable-linger {USER}")
            assert started.start_unit_again() == ""
            assert started.run("provision", "--direct", *_PROVISION[1:], expected=0).results == _DONE
            # as the guide allows: from now on over NATS alone
            started.inventory.write_text(started.inventory.read_text().replace(f"host: {ADDRESS}, ", ""))
            yield started
    finally:
        lan.close()


def _unit(rig: GatewayRig, name: str) -> str:
    return rig.user(f"systemctl --user show --property {name} --value {UNIT}").strip()


def _killed(rig: GatewayRig) -> str:
    pid = _unit(rig, "MainPID")
    rig.user(f"kill -KILL {pid}")
    return pid


def test_the_unit_is_valid_and_restricted_and_its_files_are_private(rig: GatewayRig) -> None:
    directory = f"{HOME}/.config/systemd/user"
    assert rig.user(f"systemd-analyze --user verify {directory}/{UNIT} 2>&1") == ""
    rig.user(f"systemd-analyze --user security --no-pager --threshold={MAX_EXPOSURE} {UNIT}")
    process = rig.user(f"cat /proc/{_unit(rig, 'MainPID')}/status")
    assert re.search(r"^NoNewPrivs:\t1$", process, re.M)
    assert re.search(r"^Seccomp:\t2$", process, re.M)
    state = f"{HOME}/.local/state/meshctl/sites/mines/north"
    assert rig.user(f"stat -c %a {state} {state}/id_ed25519").split() == ["700", "600"]
    # what others can read of the login user's files: nothing of the fleet
    rig.root(f"! setpriv --reuid 65534 --regid 65534 --clear-groups ls {state} 2>/dev/null")
    assert rig.root("stat -c '%U %a' /var/lib/nats /etc/nats-server.conf").split() == ["nats", "700", "root", "640"]


def test_a_run_continues_while_the_worker_is_killed_and_started_again(rig: GatewayRig) -> None:
    rig.change_power()
    started = rig.start(*_PROVISION)
    started.wait_for(_AT_WORK)
    pid = _killed(rig)
    ended = started.end()
    assert (ended.code, ended.results) == (0, _DONE)
    assert _unit(rig, "MainPID") not in ("0", pid)
    assert _unit(rig, "NRestarts") == "1"
    assert _unit(rig, "ActiveState") == "active"


def test_a_gateway_that_reboots_reports_by_itself_and_its_run_is_resumed(rig: GatewayRig) -> None:
    rig.change_power()
    started = rig.start(*_PROVISION)
    started.wait_for(_AT_WORK)
    rig.machine.reboot(rig.directory / "pins")
    ended = started.end()
    assert ended.code == 1
    assert ended.results["n-base"] == "uncertain"
    # without a login there: over NATS
    until(lambda: rig.run("sites", "status").code == 0, "the worker to answer", wait_s=120)
    resumed = rig.run("resume", "--yes", "--json")
    assert resumed.code == 0, resumed
    # drift would be an alarm
    status = json.loads(rig.run("status", "--json", expected=0).out)
    assert {node["name"]: node["health"] for node in status["nodes"]} == dict.fromkeys(NODES, "ok")


def test_the_worker_starts_before_its_leaf_node_and_outlives_it(rig: GatewayRig) -> None:
    rig.root("systemctl stop nats-server")
    _killed(rig)
    until(lambda: _unit(rig, "ActiveState") == "active", "the worker to be started", wait_s=60)
    assert "check the uplink of north" in rig.run("sites", "status").out
    rig.root("systemctl start nats-server && systemctl kill --signal KILL nats-server")
    until(lambda: rig.run("sites", "status").code == 0, "the leaf node to be started again", wait_s=120)
