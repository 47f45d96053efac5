"""One virtual node: its factory state, what survives power cuts and reboots, and flashing."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import paramiko
import pytest

from meshctl.device.scripts import script
from meshctl.model import Release
from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.images import firmware_image, opkg_package
from meshlab.spec import FleetSpec, NodeSpec
from meshlab.state import Power
from tests.meshlab.conftest import answers, connect, flash_text, run
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]


def host_key(node: VirtualNode) -> str:
    transport = connect(node.bench)
    key = transport.get_remote_server_key().get_base64()
    transport.close()
    return key


def test_a_factory_node_lets_root_in_without_a_password(fleet: VirtualFleet) -> None:
    transport = connect(fleet.node("box").bench)
    assert transport.remote_version.startswith("SSH-2.0-dropbear")
    assert run(transport, "id -u; uci get network.lan.ipaddr; uci get wireless.radio0.disabled").split() == [
        "0",
        "192.168.1.1",
        "1",
    ]
    transport.close()


def test_dropbear_has_no_sftp(fleet: VirtualFleet) -> None:
    transport = connect(fleet.node("box").bench)
    with pytest.raises((paramiko.SSHException, EOFError, OSError)):
        paramiko.SFTPClient.from_transport(transport)
    transport.close()


def test_every_node_has_its_own_processes_memory_clock_and_boot_id(fleet: VirtualFleet) -> None:
    box, far = fleet.node("box"), fleet.node("far")
    assert box.boot_id != far.boot_id
    processes = box.exec("ps").stdout
    assert "/rom/lab/init" in processes
    assert "/usr/sbin/dropbear -F" in processes
    assert box.exec("awk '/MemTotal/ { print $2 }' /proc/meminfo").stdout.strip() == str(128 * 1024)
    before_s = time.monotonic()
    box.power_cut()
    uptime_s = float(box.exec("cat /proc/uptime").stdout.split()[0])
    assert uptime_s <= time.monotonic() - before_s
    assert uptime_s < float(far.exec("cat /proc/uptime").stdout.split()[0])


def test_the_nodes_busybox_lacks_applets_that_openwrt_disables(fleet: VirtualFleet) -> None:
    missing = fleet.node("box").exec("for tool in stat timeout base64 nohup setsid; do command -v $tool; done; true")
    assert missing.stdout == ""


def test_unsynced_data_is_lost_in_a_power_cut(node: VirtualNode) -> None:
    node.exec("echo kept >/etc/kept; sync; echo lost >/etc/lost; echo changed >/etc/kept").check("write")
    boot_id = node.boot_id
    assert flash_text(node, "/etc/kept") == "kept\n"
    node.power_cut()
    assert node.exec("cat /etc/kept; ls /etc/lost").stdout == "kept\n"
    assert node.boot_id != boot_id


def test_a_power_cut_can_keep_or_truncate_unsynced_data(node: VirtualNode) -> None:
    node.exec("echo old >/etc/file; sync; echo new >/etc/file").check("write")
    node.power_cut(unsynced="kept")
    assert node.exec("cat /etc/file").stdout == "new\n"
    node.exec("echo newer >/etc/file").check("write")
    node.power_cut(unsynced="torn")
    assert node.exec("wc -c </etc/file").stdout.strip() == "0"


def test_an_orderly_reboot_keeps_everything_but_ram(node: VirtualNode) -> None:
    node.exec("echo here >/etc/file; echo gone >/tmp/file").check("write")
    node.reboot()
    assert node.exec("cat /etc/file; ls /tmp/file").stdout == "here\n"


def test_an_unconfigured_radio_is_added_as_disabled_at_boot(
    node: VirtualNode,
) -> None:
    stock = node.exec("cat /etc/config/wireless").stdout
    assert stock.count("config wifi-device") == stock.count("option disabled '1'") > 0
    forget = "uci delete wireless.radio0; uci delete wireless.default_radio0; uci commit wireless; sync"
    node.exec(forget).check("forget radio0")
    assert "radio0" not in node.exec("cat /etc/config/wireless").stdout
    node.reboot()
    again = node.exec("cat /etc/config/wireless").stdout
    assert again.count("config wifi-device") == stock.count("config wifi-device")
    assert "option ssid 'OpenWrt'" in again
    node.reboot()
    assert node.exec("cat /etc/config/wireless").stdout == again


def test_init_scripts_run_in_order_at_boot_when_enabled(node: VirtualNode) -> None:
    script = "#!/bin/sh /etc/rc.common\\nSTART={start}\\nboot() {{ echo {name} >>/tmp/order; }}\\n"
    for name, start in (("late", 97), ("early", 11), ("never", 50)):
        node.exec(f"printf '{script.format(start=start, name=name)}' >/etc/init.d/{name}; chmod 755 /etc/init.d/{name}")
    node.exec("/etc/init.d/late enable; /etc/init.d/early enable; sync").check("enable")
    assert node.exec("/etc/init.d/early enabled").exit_status == 0
    assert node.exec("/etc/init.d/never enabled").exit_status == 1
    node.reboot()
    assert node.exec("cat /tmp/order").stdout == "early\nlate\n"


def test_reload_config_reloads_only_what_changed(node: VirtualNode) -> None:
    node.exec("uci set system.@system[0].hostname=renamed; uci commit system").check("set")
    before = node.exec("logread").stdout
    assert node.exec("cat /proc/sys/kernel/hostname").stdout == "OpenWrt\n"
    node.exec("reload_config").check("reload")
    until(lambda: node.exec("cat /proc/sys/kernel/hostname").stdout == "renamed\n", "the new name")
    until(lambda: "dnsmasq: reloaded" in node.exec("logread").stdout.removeprefix(before), "dnsmasq")
    assert "firewall" not in node.exec("logread").stdout.removeprefix(before)
    node.exec("uci set dhcp.lan.ignore=1; uci commit dhcp; reload_config").check("reload")
    until(lambda: node.exec("logread").stdout.count("dnsmasq: reloaded") == 2, "dnsmasq")


def test_a_node_is_reachable_only_at_its_new_address_after_a_change(fleet: VirtualFleet, node: VirtualNode) -> None:
    transport = connect(node.bench)
    run(transport, "uci set network.lan.ipaddr=10.42.7.9; uci commit; (sleep 0; reload_config) >/dev/null 2>&1 &")
    until(lambda: node.address == "10.42.7.9", "the new address")
    assert not answers(node.bench)
    until(lambda: answers(fleet.endpoint("10.42.7.9")), "an answer at the new address")
    transport.close()


def test_static_routes_are_in_the_kernel_and_follow_the_address(node: VirtualNode) -> None:
    node.exec(
        "uci set network.far=route; uci set network.far.interface=lan; uci set network.far.target=10.43.1.0/24; "
        "uci set network.far.gateway=192.168.1.7; uci commit network; reload_config"
    ).check("add")
    until(lambda: "10.43.1.0/24 via 192.168.1.7" in node.exec("ip route").stdout, "the route")
    node.exec("uci set network.lan.netmask=255.255.0.0; uci commit network; reload_config").check("widen")
    until(lambda: "192.168.0.0/16" in node.exec("ip route").stdout, "the wider network")
    until(lambda: "10.43.1.0/24 via 192.168.1.7" in node.exec("ip route").stdout, "the same route")
    node.exec("uci delete network.far; uci commit network; reload_config").check("remove")
    until(lambda: "10.43.1.0" not in node.exec("ip route").stdout, "its end")


def test_a_network_without_a_firewall_zone_is_unreachable(fleet: VirtualFleet, node: VirtualNode) -> None:
    node.exec("uci delete firewall.@zone[0]; uci commit; reload_config").check("close")
    until(lambda: not answers(node.bench), "the firewall")


@pytest.mark.parametrize("name", ["old", "new", "box"])
def test_system_facts_match_the_release(fleet: VirtualFleet, name: str) -> None:
    node = fleet.node(name)
    release = node.spec.release
    board = json.loads(node.exec("ubus call system board").stdout)
    assert board["board_name"] == "compex,wpj344-16m"
    assert board["release"]["version"].startswith(release.value)
    assert ("rootfs_type" in board) == (release > Release.V19_07)
    assert f"DISTRIB_RELEASE='{release.value}" in node.exec("cat /etc/openwrt_release").stdout
    info = json.loads(node.exec("ubus call system info").stdout)
    assert info["memory"]["total"] == 128 * 1024 * 1024
    network = json.loads(node.exec("cat /etc/board.json").stdout)["network"]["lan"]
    assert network["ifname" if release is Release.V19_07 else "device"] == "eth0"
    lan = node.exec("uci show network.lan").stdout
    assert ("network.lan.type='bridge'" in lan) == (release is Release.V19_07)
    tool = "apk" if release is Release.V25_12 else "opkg"
    assert node.exec("command -v opkg || command -v apk").stdout.strip().endswith(tool)
    installed = node.exec("apk list --installed" if tool == "apk" else "opkg list-installed").stdout
    assert re.search(r"^kmod-batman-adv", installed, re.MULTILINE)
    keys = node.exec("ls /etc/dropbear").stdout.split()
    assert keys == (["dropbear_rsa_host_key"] if release is Release.V19_07 else ["dropbear_ed25519_host_key"])


def test_full_flash_and_full_memory_faults_make_writes_fail(fleet: VirtualFleet) -> None:
    node = fleet.node("new")
    fleet.inject_fault("new", "full-flash")
    assert node.exec("dd if=/dev/zero of=/etc/big bs=1k count=64 2>/dev/null").exit_status != 0
    fleet.inject_fault("new", "full-memory")
    assert node.exec("echo x >/tmp/one && dd if=/dev/zero of=/tmp/two bs=1k count=64 2>/dev/null").exit_status != 0
    assert int(node.exec("awk '/MemAvailable/ { print $2 }' /proc/meminfo").stdout) <= 2048
    fleet.repair("new")
    node.exec("rm -f /etc/big /tmp/one /tmp/two; echo x >/etc/small && echo y >/tmp/small").check("write again")


def test_the_host_key_fault_changes_the_host_key(fleet: VirtualFleet, node: VirtualNode) -> None:
    before = host_key(node)
    fleet.inject_fault("box", "host-key")
    until(lambda: answers(node.bench), "the restarted server")
    assert host_key(node) != before


def test_a_foreign_delta_is_seen_by_uci_changes(fleet: VirtualFleet, node: VirtualNode) -> None:
    fleet.inject_fault("box", "foreign-delta")
    assert "description='left by hand'" in node.exec("uci changes").stdout


def test_the_clock_fault_shifts_the_date_and_repair_restores_it(fleet: VirtualFleet, node: VirtualNode) -> None:
    now = int(node.exec("date +%s").stdout)
    fleet.inject_fault("box", "clock")
    assert now - int(node.exec("date +%s").stdout) > 9 * 365 * 86400
    fleet.repair("box")
    assert int(node.exec("date +%s").stdout) >= now


def test_the_ssh_hang_fault_accepts_connections_without_a_banner(fleet: VirtualFleet, node: VirtualNode) -> None:
    fleet.inject_fault("box", "ssh-hang")
    transport = paramiko.Transport((node.bench.host, node.bench.port))
    transport.banner_timeout = 0.5
    with pytest.raises(paramiko.SSHException):
        transport.start_client(timeout=2)
    transport.close()


def test_a_wrong_board_name_is_reported_before_and_after_a_boot(fleet: VirtualFleet, node: VirtualNode) -> None:
    fleet.inject_fault("box", "wrong-board")
    for _ in range(2):
        board = json.loads(node.exec("ubus call system board").stdout)
        assert board["board_name"] == "virtual,other-board"
        node.power_cut()
    fleet.repair("box")
    assert node.exec("cat /tmp/sysinfo/board_name").stdout.strip() == node.spec.board


# -- flashing --


def put_image(node: VirtualNode, image: bytes) -> None:
    node.exec("cat >/tmp/firmware.bin", stdin=image).check("upload")


def test_sysupgrade_rejects_an_image_for_another_board(node: VirtualNode) -> None:
    put_image(node, firmware_image(Release.V24_10, board="other,board"))
    done = node.exec("sysupgrade -T /tmp/firmware.bin")
    assert done.exit_status == 1
    assert "Device compex,wpj344-16m not supported by this image" in done.stdout
    assert "Supported devices: other,board" in done.stdout
    assert "Image check failed." in done.stderr
    put_image(node, b"no image at all" * 100)
    assert "Image metadata not present" in node.exec("sysupgrade -T /tmp/firmware.bin").stdout
    verdict = json.loads(node.exec('ubus call system validate_firmware_image \'{"path":"/tmp/firmware.bin"}\'').stdout)
    assert (verdict["valid"], verdict["tests"]["fwtool_device_match"]) == (False, False)


def test_sysupgrade_rejects_a_truncated_or_corrupted_image(node: VirtualNode) -> None:
    image = firmware_image(Release.V24_10, board=node.spec.board)
    put_image(node, image[:-1])
    assert node.exec("sysupgrade -T /tmp/firmware.bin").exit_status == 1
    put_image(node, image[:1000] + b"x" + image[1001:])
    assert node.exec("sysupgrade -T /tmp/firmware.bin").exit_status == 1


def test_sysupgrade_installs_the_new_release_given_files_and_new_host_keys(node: VirtualNode) -> None:
    put_image(node, firmware_image(Release.V25_12, board=node.spec.board))
    key, boot_id = host_key(node), node.boot_id
    node.exec(
        "mkdir -p /tmp/new/etc/config && cp /etc/config/system /tmp/new/etc/config/ && "
        "sed -i s/OpenWrt/flashed/ /tmp/new/etc/config/system && echo me >/tmp/new/etc/marker && "
        "tar -czf /tmp/config.tgz -C /tmp/new . && echo old >/etc/old && sync"
    ).check("make the tar")
    assert node.exec("sysupgrade -T /tmp/firmware.bin").exit_status == 0
    transport = connect(node.bench)
    channel = transport.open_session(timeout=60)
    channel.settimeout(60)
    channel.exec_command("sysupgrade -n -f /tmp/config.tgz /tmp/firmware.bin 2>&1")
    assert b"Commencing upgrade. Closing all shell sessions." in channel.recv(4096)
    until(lambda: node.boot_id not in (None, boot_id), "the new firmware")
    transport.close()
    assert node.exec("cat /etc/marker; ls /etc/old").stdout == "me\n"
    assert node.exec("cat /proc/sys/kernel/hostname").stdout == "flashed\n"
    assert "25.12" in node.exec("cat /etc/openwrt_release").stdout
    assert node.exec("command -v apk").exit_status == 0
    assert host_key(node) != key
    # restore the state for the other tests
    put_image(node, firmware_image(Release.V23_05, board=node.spec.board))
    boots = node.boot_id
    node.exec("start-stop-daemon -S -b -x /sbin/sysupgrade -- -n /tmp/firmware.bin")
    until(lambda: node.boot_id not in (None, boots), "the old firmware")


def test_a_power_cut_while_flashing_bricks_the_node_until_it_is_repaired(
    fleet: VirtualFleet, node: VirtualNode
) -> None:
    put_image(node, firmware_image(Release.V24_10, board=node.spec.board))
    fleet.inject_fault("box", "power-cut@flash")
    node.exec("start-stop-daemon -S -b -x /sbin/sysupgrade -- -n /tmp/firmware.bin")
    until(lambda: node.power is Power.DEAD, "the dead firmware")
    assert not answers(node.bench)
    fleet.repair("box")
    node.wait_up()
    assert "23.05" in node.exec("cat /etc/openwrt_release").stdout


# -- steps --


def test_a_power_cut_happens_before_the_given_step(fleet: VirtualFleet, node: VirtualNode) -> None:
    work = "echo 1 >/etc/one; sync; cp /etc/one /etc/two; sync; rm /etc/one; sync"
    node.record_steps()
    node.exec(work).check("work")
    steps = node.steps()
    assert [step.split()[0] for step in steps] == ["sync", "cp", "sync", "rm", "sync"]
    node.exec("rm -f /etc/one /etc/two; sync")
    for number, left in ((2, "one"), (4, "one two"), (5, "one two")):
        boot_id = node.boot_id
        fleet.inject_fault("box", f"power-cut@{number}")
        node.exec(work)
        until(lambda old=boot_id: node.boot_id not in (None, old), "the reboot")  # type: ignore[misc]
        assert node.exec("cd /etc && ls one two 2>/dev/null").stdout.split() == left.split()
        node.exec("rm -f /etc/one /etc/two; sync")


def test_commands_of_a_watch_over_station_entries_are_not_counted(node: VirtualNode) -> None:
    """It runs beside a change, and how many they are depends on the host's speed."""
    node.record_steps()
    node.exec(script("stale_station.sh") + "watch_stale 3 mesh0/02:00:00:00:00:01").check("watch")
    node.exec("rm -f /etc/one")
    assert node.steps() == ("rm -f /etc/one",)


def test_a_fault_step_can_be_given_as_command_text(fleet: VirtualFleet, node: VirtualNode) -> None:
    boot_id = node.boot_id
    fleet.inject_fault("box", "power-cut@uci commit system")
    node.exec("uci set system.@system[0].hostname=a; uci commit network; uci commit system; uci commit")
    until(lambda: node.boot_id not in (None, boot_id), "the reboot")
    assert node.exec("uci get system.@system[0].hostname").stdout == "OpenWrt\n"


def test_packages_are_installed_from_files_and_checked(fleet: VirtualFleet, node: VirtualNode) -> None:
    from meshlab.images import apk_package, opkg_package

    node.exec("cat >/tmp/p.ipk", stdin=opkg_package("tool", "1.2-3", {"/usr/bin/tool": "#!/bin/sh\necho works\n"}))
    node.exec("opkg install /tmp/p.ipk").check("install")
    assert node.exec("tool; opkg list-installed").stdout.startswith("works\n")
    assert "tool - 1.2-3" in node.exec("opkg list-installed").stdout
    node.exec("cat >/tmp/q.ipk", stdin=opkg_package("needy", "1", {}, depends=("absent",)))
    assert node.exec("opkg install /tmp/q.ipk").exit_status == 255
    node.exec("cat >/tmp/r.ipk", stdin=opkg_package("strange", "1", {}, arch="x86_64"))
    assert node.exec("opkg install /tmp/r.ipk").exit_status == 255
    new = fleet.node("new")
    new.exec("cat >/tmp/p.apk", stdin=apk_package("tool", "1.2-r3", {"/usr/bin/tool": "#!/bin/sh\necho works\n"}))
    new.exec("apk add --allow-untrusted /tmp/p.apk").check("install")
    assert "tool-1.2-r3" in new.exec("apk list --installed").stdout
    new.exec("apk del tool").check("remove")
    assert "tool-1.2-r3" not in new.exec("apk list --installed").stdout


SERVICE = (
    "#!/bin/sh /etc/rc.common\nSTART=50\nstart() { echo start >>/tmp/calls; }\nstop() { echo stop >>/tmp/calls; }\n"
)


def test_installing_and_removing_a_package_handles_its_files_and_services(
    fleet: VirtualFleet, node: VirtualNode
) -> None:
    from meshlab.images import apk_package, opkg_package

    files = {"/etc/init.d/tool": SERVICE, "/usr/bin/tool": "#!/bin/sh\n"}
    listed = "ls /etc/rc.d /usr/bin | grep tool; cat /tmp/calls"
    here = {"S50tool", "tool", "start"}
    node.exec("cat >/tmp/p.ipk", stdin=opkg_package("tool", "1", files))
    node.exec("opkg install /tmp/p.ipk").check("install")
    assert set(node.exec(listed).stdout.split()) == here
    assert node.exec("opkg files tool").stdout.splitlines()[1:] == sorted(files)
    node.exec("opkg remove tool").check("remove")
    assert node.exec(listed).stdout.split() == ["start", "stop"]
    new = fleet.node("new")
    new.exec("cat >/tmp/p.apk", stdin=apk_package("tool", "1-r1", files))
    new.exec("cat >/tmp/bad.apk", stdin=b"torn")
    listing = [*(path.lstrip("/") for path in sorted(files)), "lib/apk/packages/tool.list"]
    manifest = new.exec("apk manifest --allow-untrusted /tmp/p.apk").stdout.splitlines()
    assert [line.split("  ")[1] for line in manifest] == listing
    assert new.exec("apk manifest --allow-untrusted /tmp/bad.apk").exit_status == 0
    new.exec("apk add --allow-untrusted /tmp/p.apk").check("install")
    assert set(new.exec(listed).stdout.split()) == here
    assert new.exec("apk info -L tool").stdout.splitlines() == ["tool-1-r1 contains:", *listing]
    new.exec("apk del tool").check("remove")
    assert new.exec(listed).stdout.split() == ["start", "stop"]


def test_the_package_database_is_written_last(fleet: VirtualFleet, node: VirtualNode) -> None:
    from meshlab.images import opkg_package

    script = (
        "#!/bin/sh /etc/rc.common\nSTART=50\nstart() { opkg list-installed >/tmp/seen; ls /usr/bin >/tmp/there; }\n"
    )
    files = {"/etc/init.d/second": script, "/usr/bin/second": ""}
    node.exec("cat >/tmp/p.ipk", stdin=opkg_package("first", "1", {"/usr/bin/first": ""}))
    node.exec("cat >/tmp/q.ipk", stdin=opkg_package("second", "1", files))
    node.exec("opkg install /tmp/p.ipk /tmp/q.ipk").check("install")
    seen, there = (set(node.exec(f"cat /tmp/{name}").stdout.split()) for name in ("seen", "there"))
    assert {"first", "second"} <= there
    assert not {"first", "second"} & seen
    assert {"first", "second"} <= set(node.exec("opkg list-installed").stdout.split())


def test_netifd_detects_protocol_handlers_only_at_startup(fleet: VirtualFleet, node: VirtualNode) -> None:
    known = json.loads(node.exec("ubus call network get_proto_handlers").stdout)
    assert set(known) >= {"static", "batadv", "batadv_hardif"}
    node.exec("opkg remove kmod-batman-adv && /etc/init.d/network restart").check("forget")
    assert "batadv" not in json.loads(node.exec("ubus call network get_proto_handlers").stdout)
    node.exec("cat >/tmp/k.ipk", stdin=opkg_package("kmod-batman-adv", "1", {})).check("put it there")
    handlers = "ubus call network get_proto_handlers"
    again = node.exec(f"opkg install /tmp/k.ipk >/dev/null; ubus call network reload; {handlers}")
    assert "batadv" not in json.loads(again.stdout)
    restarted = node.exec("ubus call network restart; ubus call network get_proto_handlers")
    assert "batadv" in json.loads(restarted.stdout)


def test_a_vlan_of_a_switch_is_on_a_port_of_the_board(tmp_path: Path) -> None:
    with VirtualFleet(FleetSpec("switch", (NodeSpec("box", lan_ports=("eth0.1",)),)), tmp_path / "lab") as fleet:
        found = fleet.node("box").exec("ubus call network reload; ls /sys/class/net").check("list the devices")
    assert {"eth0", "eth0.1"} <= set(found.stdout.split())
