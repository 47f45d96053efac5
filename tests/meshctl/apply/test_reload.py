"""scripts/reload.sh: which effects it waits for, and what does not count as one.

The node's tools are scripts that play recorded behaviour (docs/facts): procd runs a trigger's script a moment after the
event, `fw4 reload` ends with 0 whether or not nft took the ruleset, dropbear's instance is replaced some time after.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from meshctl.apply.change_set import SPEAK_FRAMES, reload_script
from meshctl.render import LAN_FILTER_PATH

DROPBEAR = '{"dropbear": {"instances": {"instance1": {\n"running": true,\n"pid": %s,\n"command": ["-p", "%s"]\n}}}}'
# `service set` keeps the trigger's file, an event with its name creates it (once `procd` says so); each call is logged
UBUS = """echo "ubus $*" >>"$HERE/log"
case "$2 $3" in
'service set') [ ! -e "$HERE/no-triggers" ] || exit 2
    echo "$4" | sed 's/.*"touch","\\([^"]*\\)".*/\\1/' >"$HERE/trigger" ;;
'service event') case $4 in *meshctl-barrier*) [ -e "$HERE/stuck" ] || : >"$(cat "$HERE/trigger")" ;; esac ;;
'service list') cat "$HERE/dropbear"; [ ! -f "$HERE/dropbear.next" ] || mv "$HERE/dropbear.next" "$HERE/dropbear"
    ;;
'network.wireless status') [ ! -e "$HERE/pending" ] || { echo '"pending": true'; rm "$HERE/pending"; } ;;
'network get_proto_handlers') cat "$HERE/handlers" 2>/dev/null ;;
esac"""


class Node:
    """The tools of a node in one directory, and what was called."""

    def __init__(self, place: Path) -> None:
        self.place = place
        for folder in ("bin", "init.d", "rc.d", "run", "net"):
            (place / folder).mkdir()
        self.tool("ubus", UBUS)
        self.tool("reload_config", 'echo reload_config >>"$HERE/log"')
        # time passes by sleeping
        passing = 'read -r up _ <"$HERE/uptime"; echo "$((up + $1)) 0" >"$HERE/uptime"'
        self.tool("sleep", f'echo "sleep $1" >>"$HERE/log"; {passing}')
        (place / "uptime").write_text("1000 0\n")
        self.tool("uci", 'case $3 in network) cat "$HERE/network.uci" ;; *) cat "$HERE/wireless" ;; esac 2>/dev/null')
        self.tool("iw", 'cat "$HERE/iw" 2>/dev/null')
        self.fw4('case $1 in reload | start) echo new >>"$HERE/rules" ;; esac')
        self.tool("nft", 'cat "$HERE/rules"')
        self.service("network")
        self.service("firewall", 'fw4 "$1"')
        (place / "rc.d" / "S19firewall").symlink_to("../init.d/firewall")
        (place / "rules").write_text("old\n")
        (place / "run" / "fw4.state").touch()
        (place / "dropbear").write_text(DROPBEAR % (1, 22))
        (place / "network").write_text("option proto 'batadv'")
        (place / "handlers").write_text('{"static": {}, "batadv": {}}')

    def tool(self, name: str, body: str, folder: str = "bin") -> None:
        (self.place / folder / name).write_text(f"#!/bin/sh\n{body}\n")
        (self.place / folder / name).chmod(0o755)

    def fw4(self, body: str) -> None:
        self.tool("fw4", f'echo "fw4 $1" >>"$HERE/log"\n{body}')

    def service(self, name: str, body: str = ":") -> None:
        self.tool(name, f'echo "{name} $1" >>"$HERE/log"\n{body}', "init.d")

    def script(self, *packages: str, services: tuple[str, ...] = ()) -> str:
        text = reload_script({f"etc/config/{package}" for package in packages}, services)
        for path, own in {
            "/etc/config/network": "network",
            "/proc/uptime": "uptime",
            "/etc/init.d": "init.d",
            "/etc/rc.d": "rc.d",
            "/var/run": "run",
            "/tmp/meshctl": "run/meshctl",
            "/sys/class/net": "net",
            "/sbin/wifi": "bin/wifi",
        }.items():
            text = text.replace(path, str(self.place / own))
        return text

    def reload(
        self, *packages: str, services: tuple[str, ...] = (), environ: Mapping[str, str] = MappingProxyType({})
    ) -> tuple[int, str]:
        """The exit status and the failure messages."""
        done = subprocess.run(
            ["sh", "-c", self.script(*packages, services=services)],
            env={"PATH": f"{self.place}/bin:/usr/bin:/bin", "HERE": str(self.place), **environ},
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        return done.returncode, done.stderr.strip()

    @property
    def log(self) -> list[str]:
        log = self.place / "log"
        return log.read_text().splitlines() if log.exists() else []

    def slept_s(self) -> int:
        return sum(int(line.split()[1]) for line in self.log if line.startswith("sleep "))


@pytest.fixture
def node(tmp_path: Path) -> Node:
    return Node(tmp_path)


def test_files_outside_uci_packages_trigger_no_reload(node: Node) -> None:
    assert node.reload() == (0, "")
    assert [line for line in node.log if "service list" not in line] == []


def test_each_changed_package_sends_its_event_and_waits_for_procd(node: Node) -> None:
    assert node.reload("system", "dhcp") == (0, "")
    events = [line for line in node.log if "service event" in line]
    assert all(name in event for name, event in zip(("dhcp", "system", "barrier"), events, strict=True))
    assert "service delete" in node.log[-1]
    assert not list((node.place / "run" / "meshctl").iterdir())


def test_the_reload_fails_if_procd_never_runs_its_triggers(node: Node) -> None:
    (node.place / "stuck").touch()
    status, said = node.reload("system")
    assert status == 1
    assert "procd did not run the reloads in time" in said
    assert node.slept_s() == 240


def test_no_wait_outlasts_the_confirm_window(node: Node) -> None:
    (node.place / "stuck").touch()
    status, said = node.reload("system", "network", environ={"UNTIL_S": "1017"})
    assert status == 75
    assert "procd did not run the reloads in time" in said
    assert node.slept_s() == 17


def test_a_reload_that_is_done_before_the_window_ends_succeeds(node: Node) -> None:
    assert node.reload("system", environ={"UNTIL_S": "1017"}) == (0, "")


@pytest.mark.parametrize("procd_is_later", [False, True], ids=["procd first", "the next reload first"])
def test_what_a_stopped_reload_has_left_is_gone_after_the_next(node: Node, procd_is_later: bool) -> None:
    (node.place / "stuck").touch()
    node.tool("sleep", "kill -KILL $PPID")
    assert node.reload("system")[0] < 0
    first_set = next(line for line in node.log if "service set" in line)
    procd_runs = ["touch", (node.place / "trigger").read_text().strip()]
    (node.place / "stuck").unlink()
    if not procd_is_later:
        subprocess.run(procd_runs, check=True)
    assert node.reload("system") == (0, "")
    if procd_is_later:
        subprocess.run(procd_runs, check=False, capture_output=True)
    assert [left.name for left in (node.place / "run" / "meshctl").iterdir()] in ([], ["pause"])
    name = first_set.partition('"name":"')[2].partition('"')[0]
    assert f'ubus call service delete {{"name":"{name}"}}' in node.log


def test_a_fixed_delay_is_used_if_procd_rejects_the_trigger(node: Node) -> None:
    (node.place / "no-triggers").touch()
    assert node.reload("system") == (0, "")
    assert node.slept_s() == 10


@pytest.mark.parametrize(("has_include", "is_unloaded"), [(True, False), (False, True)])
def test_a_lan_filter_is_unloaded_when_the_firewall_no_longer_includes_it(
    node: Node, has_include: bool, is_unloaded: bool
) -> None:
    node.tool("nft", 'case $1 in delete) echo "nft $*" >>"$HERE/log" ;; *) cat "$HERE/rules" ;; esac')
    node.tool("uci", 'case $* in *get*lan_filter*) [ -e "$HERE/include" ] ;; esac')
    if has_include:
        (node.place / "include").touch()
    assert node.reload("firewall") == (0, "")
    assert ("nft delete table bridge meshctl_lan" in node.log) == is_unloaded


def test_a_changed_lan_filter_reloads_the_firewall() -> None:
    assert "PACKAGES=firewall\n" in reload_script({LAN_FILTER_PATH}, ())
    assert reload_script({LAN_FILTER_PATH, "etc/config/firewall"}, ()) == reload_script({LAN_FILTER_PATH}, ())


def test_a_ruleset_rejected_by_nft_is_a_failure_even_if_fw4_exits_with_0(node: Node) -> None:
    node.fw4(":")
    status, said = node.reload("firewall")
    assert (status, said) == (1, "failed: the firewall's new ruleset is not loaded")


def test_the_firewall_is_reloaded_after_procd_and_the_interfaces_settle(node: Node) -> None:
    assert node.reload("network", "firewall") == (0, "")
    barriers = [at for at, line in enumerate(node.log) if "service delete" in line]
    assert len(barriers) == 2
    assert barriers[1] < node.log.index("fw4 reload")


def test_the_firewall_is_reloaded_without_the_processes_of_its_init_script(node: Node) -> None:
    """On 25.12 userspace, rc.common and its libraries start 20 processes before they run `fw4 reload`."""
    assert node.reload("firewall") == (0, "")
    assert [line for line in node.log if line.startswith(("firewall", "fw4"))] == ["fw4 reload"]


def test_a_stopped_firewall_is_started_immediately(node: Node) -> None:
    (node.place / "run" / "fw4.state").unlink()
    assert node.reload("firewall") == (0, "")
    assert "firewall start" in node.log


def test_a_firewall_that_is_disabled_is_left_alone(node: Node) -> None:
    (node.place / "rc.d" / "S19firewall").unlink()
    assert node.reload("firewall") == (0, "")
    assert [line for line in node.log if line.startswith(("firewall", "fw4"))] == []


def test_an_already_broken_firewall_does_not_fail_a_network_change(node: Node) -> None:
    node.fw4(":")
    assert node.reload("network") == (0, "")


def test_on_releases_with_fw3_its_exit_status_counts(node: Node) -> None:
    (node.place / "bin" / "fw4").unlink()
    (node.place / "run" / "fw4.state").rename(node.place / "run" / "fw3.state")
    node.service("firewall")
    assert node.reload("firewall") == (0, "")
    node.service("firewall", '[ "$1" != reload ]')
    assert node.reload("firewall")[0] == 1


def test_a_dropbear_with_unchanged_options_is_not_waited_for(node: Node) -> None:
    assert node.reload("dropbear") == (0, "")
    assert node.slept_s() == 0


def test_a_dropbear_with_changed_options_is_waited_for_until_its_old_process_exits(node: Node) -> None:
    with subprocess.Popen(["sleep", "600"]) as old:
        (node.place / "dropbear").write_text(DROPBEAR % (old.pid, 22))
        (node.place / "dropbear.next").write_text(DROPBEAR % (old.pid, 2222))
        # procd lists the new command while the old process still runs
        # the pause ends once the old process is reaped: a zombie still counts as running
        stop = f"kill {old.pid}; while kill -0 {old.pid}; do /bin/sleep .01; done 2>/dev/null"
        node.tool("sleep", f'echo "sleep $1" >>"$HERE/log"; {stop}')
        reaper = threading.Thread(target=old.wait)
        reaper.start()
        try:
            assert node.reload("dropbear") == (0, "")
        finally:
            old.kill()
            reaper.join()
    assert node.slept_s() >= 1


def test_a_dropbear_process_that_does_not_exit_is_a_failure(node: Node) -> None:
    (node.place / "dropbear").write_text(DROPBEAR % (os.getpid(), 22))
    (node.place / "dropbear.next").write_text(DROPBEAR % (os.getpid(), 2222))
    assert node.reload("dropbear") == (1, "failed: dropbear still runs with its old options")
    assert node.slept_s() == 30


def test_the_reload_waits_for_radios_that_netifd_is_setting_up(node: Node) -> None:
    (node.place / "pending").touch()
    assert node.reload("wireless") == (0, "")
    assert node.slept_s() == 2  # until they are up, and once more


def test_a_radio_that_a_slow_node_needs_most_of_a_minute_for_is_not_taken_down(node: Node) -> None:
    """Taken down in the middle of its setup, it would need that time once more, and might miss the confirm window."""
    node.tool("wifi", 'echo "wifi $1" >>"$HERE/log"')
    (node.place / "wireless").write_text(WIRELESS % 0)
    (node.place / "net" / "mesh0").mkdir()
    node.tool("reload_config", 'rmdir "$HERE/net/mesh0"; touch "$HERE/setup"')
    # it is pending until the clock of this test has advanced by 50 s
    passing = 'read -r up _ <"$HERE/uptime"; up=$((up + $1)); echo "$up 0" >"$HERE/uptime"'
    ready = '[ $up -lt 1050 ] || { mkdir -p "$HERE/net/mesh0"; rm -f "$HERE/setup"; }'
    node.tool("sleep", f'echo "sleep $1" >>"$HERE/log"; {passing}; {ready}')
    is_pending = '[ ! -e "$HERE/setup" ] || echo \'"pending": true\''
    node.tool("ubus", f"{UBUS}\n[ \"$2 $3\" != 'network.wireless status' ] || {is_pending}")
    assert node.reload("wireless") == (0, "")
    assert [line for line in node.log if line.startswith("wifi")] == []
    assert (node.place / "net" / "mesh0").exists()


def test_an_interface_lost_in_a_second_setup_right_after_the_first_is_recreated(node: Node) -> None:
    node.tool("wifi", 'echo "wifi $1" >>"$HERE/log"')
    (node.place / "wireless").write_text(WIRELESS % 0)
    (node.place / "net" / "mesh0").mkdir()
    # up at the first look; the pause after it is when netifd handles the change that it had only noted
    node.tool("sleep", 'echo "sleep $1" >>"$HERE/log"; rmdir "$HERE/net/mesh0" 2>/dev/null')
    assert node.reload("wireless") == (0, "")
    assert [line for line in node.log if line.startswith("wifi")] == ["wifi down", "wifi up"]


WIRELESS = """wireless.radio0=wifi-device
wireless.radio0.disabled='%s'
wireless.mesh0=wifi-iface
wireless.mesh0.device='radio0'
wireless.mesh0.ifname='mesh0'
wireless.default_radio0=wifi-iface
wireless.default_radio0.device='radio0'
"""


@pytest.mark.parametrize(
    ("disabled", "before", "after", "resets"),
    [
        (0, True, True, []),
        # taken away and never created again
        (0, True, False, ["wifi down", "wifi up"]),
        # missing all along: not what the change did
        (0, False, False, []),
        # it continues to send although it is off, whatever is done
        (1, True, True, ["wifi down radio0", "wifi up radio0", "wifi down", "wifi up"]),
        (1, True, False, []),
    ],
)
def test_lost_radios_and_disabled_radios_still_up_are_reset_once(
    node: Node, disabled: int, before: bool, after: bool, resets: list[str]
) -> None:
    node.tool("wifi", 'echo wifi "$@" >>"$HERE/log"')
    (node.place / "wireless").write_text(WIRELESS % disabled)
    (node.place / "net" / "lo").mkdir()
    if before:
        (node.place / "net" / "mesh0").mkdir()
    if before and not after:
        node.tool("reload_config", 'rmdir "$HERE/net/mesh0"')
    assert node.reload("wireless") == (0, "")
    assert [line for line in node.log if line.startswith("wifi")] == resets


@pytest.fixture
def member(node: Node) -> Node:
    """A node whose radio interface has joined its cell and is part of batman-adv."""
    (node.place / "wireless").write_text(f"{WIRELESS % 0}wireless.mesh0.network='mesh0'\n")
    (node.place / "network.uci").write_text("network.mesh0=interface\nnetwork.mesh0.proto='batadv_hardif'\n")
    (node.place / "net" / "bat0").mkdir()
    (node.place / "net" / "mesh0").mkdir()
    (node.place / "net" / "mesh0" / "carrier").write_text("1\n")
    (node.place / "net" / "mesh0" / "master").symlink_to("../bat0")
    node.tool("wifi", 'echo wifi "$@" >>"$HERE/log"')
    return node


LOSES_MASTER = 'rm -f "$HERE/net/mesh0/master"'


def test_a_radio_that_netifd_left_out_of_batman_adv_is_brought_back_by_a_restart_of_netifd(member: Node) -> None:
    """Recorded on 25.12.5: netifd says `available`, neither `up` nor `pending`, whatever is called but its restart."""
    member.tool("reload_config", LOSES_MASTER)
    member.service("network", 'ln -s ../bat0 "$HERE/net/mesh0/master"')
    assert member.reload("wireless") == (0, "")
    assert [line for line in member.log if line.startswith(("wifi", "network"))] == ["network restart"]
    assert (member.place / "net" / "mesh0" / "master").is_symlink()


def test_a_radio_that_stays_out_of_batman_adv_is_a_failure(member: Node) -> None:
    member.tool("reload_config", LOSES_MASTER)
    assert member.reload("wireless") == (1, "failed: a radio is not part of batman-adv")


def test_a_radio_that_is_still_joining_its_cell_is_no_failure(member: Node) -> None:
    member.tool("reload_config", f'{LOSES_MASTER}; echo 0 >"$HERE/net/mesh0/carrier"')
    assert member.reload("wireless") == (0, "")
    assert "network restart" not in member.log


@pytest.mark.parametrize("was_member", [True, False])
def test_a_rollback_fails_if_the_change_lost_a_radio_that_does_not_return(member: Node, was_member: bool) -> None:
    """A failed reload of a rollback reboots the node. A radio that was missing before the change is no reason to."""
    if not was_member:
        shutil.rmtree(member.place / "net" / "mesh0")
    member.tool("reload_config", 'rm -rf "$HERE/net/mesh0"')
    member.reload("wireless", environ={"UNTIL_S": "1001"})
    assert member.reload("wireless")[0] == int(was_member)


TWO_RADIOS = """wireless.radio0=wifi-device
wireless.radio0.disabled='0'
wireless.radio1=wifi-device
wireless.radio1.disabled='1'
wireless.mesh0=wifi-iface
wireless.mesh0.device='radio0'
wireless.mesh0.ifname='mesh0'
"""
# as `iw dev` prints it
ON_THE_AIR = "phy#1\n\tInterface mesh1\n\t\tifindex 9\n\t\ttype %s\nphy#0\n\tInterface mesh0\n\t\ttype IBSS\n"


@pytest.mark.parametrize(
    ("kind", "settings", "is_removed"),
    [
        ("IBSS", TWO_RADIOS, True),
        ("mesh point", TWO_RADIOS, True),
        # someone's own
        ("monitor", TWO_RADIOS, False),
        # an interface without a name may be any of those
        ("IBSS", f"{TWO_RADIOS}wireless.other=wifi-iface\nwireless.other.device='radio0'\n", False),
    ],
)
def test_the_interface_of_a_removed_section_is_taken_down_alone(
    node: Node, kind: str, settings: str, is_removed: bool
) -> None:
    """25.12 leaves it in its cell. The radio over which the node is reached stays up."""
    node.tool("wifi", 'echo wifi "$@" >>"$HERE/log"; [ "$1 $2" != "down radio1" ] || rmdir "$HERE/net/mesh1"')
    (node.place / "wireless").write_text(settings)
    (node.place / "iw").write_text(ON_THE_AIR % kind)
    for name in ("mesh0", "mesh1"):
        (node.place / "net" / name).mkdir()
    assert node.reload("wireless") == (0, "")
    resets = ["wifi down radio1", "wifi up radio1"] if is_removed else []
    assert [line for line in node.log if line.startswith("wifi")] == resets
    assert (node.place / "net" / "mesh1").exists() != is_removed


@pytest.mark.parametrize(
    ("network", "handlers", "restarts"),
    [
        ("option proto 'batadv'", '{"static": {}, "batadv": {}}', False),
        ("option proto 'batadv'", '{"static": {}}', True),
        ("option proto 'static'", '{"static": {}}', False),
    ],
)
def test_netifd_is_restarted_only_if_it_lacks_the_batadv_protocol_handler(
    node: Node, network: str, handlers: str, restarts: bool
) -> None:
    (node.place / "network").write_text(network)
    (node.place / "handlers").write_text(handlers)
    assert node.reload("network") == (0, "")
    assert ("network restart" in node.log) is restarts


def test_a_back_end_service_is_restarted_and_a_failed_restart_is_reported(node: Node) -> None:
    node.service("meshmerize")
    assert node.reload("network", services=("meshmerize",)) == (0, "")
    assert "meshmerize restart" in node.log
    node.service("meshmerize", "exit 1")
    assert node.reload("network", services=("meshmerize",)) == (1, "failed: restart of meshmerize")


@pytest.mark.parametrize(
    ("client", "pings"),
    [({"SSH_CONNECTION": "10.42.0.2 51000 10.42.0.11 22"}, [f"-c {SPEAK_FRAMES} 10.42.0.2"]), ({}, [])],
)
def test_a_network_change_pings_the_ssh_client_without_waiting_for_a_reply(
    node: Node, client: dict[str, str], pings: list[str]
) -> None:
    os.mkfifo(node.place / "go")
    node.tool("ping", 'read -r _ <"$HERE/go"\necho "$@" >>"$HERE/pings"')
    # it ends although the ping has not
    assert node.reload("network", environ=client) == (0, "")
    if pings:
        (node.place / "go").write_text("\n")
    log = node.place / "pings"
    deadline = time.monotonic() + 60
    while pings and not (log.exists() and log.read_text()):
        assert time.monotonic() < deadline, "it did not speak"
        time.sleep(0.01)
    assert (log.read_text().splitlines() if log.exists() else []) == pings


def test_a_wireless_change_alone_sends_no_ping(node: Node) -> None:
    node.tool("ping", 'echo "$@" >>"$HERE/log"')
    assert node.reload("wireless", environ={"SSH_CONNECTION": "10.42.0.2 51000 10.42.0.11 22"}) == (0, "")
    assert not [line for line in node.log if "10.42.0.2" in line]
