"""What systemd does for the daemon: privileges, readiness, watchdog, boot; lost power in between, and a wrong clock."""

from __future__ import annotations

import json
import threading
import time

import pytest

from tests.meshctl.device.servers import eventually
from tests.meshctl.robots.fleets import RobotFleet

# `systemd-analyze security`, in tenths of a point from 0 (locked up) to 100 (does what it likes).
MAX_EXPOSURE = 20
PORT = "    thin: {number: 2, ports: {lora: /dev/ttyUSB0}}\n"


def _show(fleet: RobotFleet, *properties: str, unit: str = "udp-mesh.service") -> dict[str, str]:
    output = fleet.shell("husky1", f"systemctl show -p {','.join(properties)} {unit}")
    return dict(line.partition("=")[::2] for line in output.splitlines())


def test_the_daemon_service_is_sandboxed_and_restarts_after_hang_and_boot(
    fleet: RobotFleet,
) -> None:
    machine = fleet.add("husky1")
    fleet.write()
    fleet.deploy()
    output = _show(fleet, "MainPID", "Type", "StatusText", "WatchdogUSec", "NRestarts")
    assert output["Type"] == "notify"
    assert output["StatusText"] == "husky1: 0 of 0 peers online", "it reports its status to systemd"
    pid = output["MainPID"]

    process = dict(
        line.split(":\t", 1) for line in fleet.shell("husky1", f"cat /proc/{pid}/status").splitlines() if ":\t" in line
    )
    account = fleet.shell("husky1", "id -u udp-mesh").strip()
    assert set(process["Uid"].split()) == {account}
    assert int(process["CapEff"], 16) == int(process["CapBnd"], 16) == 1 << 13, "CAP_NET_RAW and nothing else"
    assert (process["NoNewPrivs"], process["Seccomp"]) == ("1", "2")
    inside = f"nsenter -t {pid} -m -S {account}"
    fleet.shell("husky1", f"! {inside} touch /opt/udp-mesh/x 2>/dev/null && ! {inside} cat /etc/shadow 2>/dev/null")
    fleet.shell("husky1", f"! {inside} ls /root 2>/dev/null && {inside} touch /var/lib/udp-mesh/x")
    fleet.shell("husky1", f"systemd-analyze security --no-pager --threshold={MAX_EXPOSURE} udp-mesh.service")

    # it hangs
    began = fleet.shell("husky1", "date '+%F %T'").strip()
    fleet.shell("husky1", f"kill -STOP {pid}")
    eventually(lambda: _show(fleet, "NRestarts", "ActiveState") == {"NRestarts": "1", "ActiveState": "active"})
    assert _show(fleet, "MainPID")["MainPID"] != pid
    journal = fleet.shell("husky1", f"journalctl --no-pager -u udp-mesh.service --since '{began}' -o cat")
    assert "Watchdog timeout" in journal
    assert fleet.status()["husky1"]["service"]["restarts"] == 1

    release = fleet.status()["husky1"]["release"]
    machine.reboot(fleet.directory / "pins")
    eventually(lambda: bool(fleet.status()["husky1"]["well"]))
    found = fleet.status()["husky1"]
    assert (found["release"], found["service"]["restarts"]) == (release, 0)
    assert "husky1: unchanged" in fleet.deploy()


def test_a_robot_with_a_thin_link_may_open_serial_ports_and_nothing_more(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    fleet.deploy()
    assert _show(fleet, "PrivateDevices") == {"PrivateDevices": "yes"}
    # a radio that is not plugged in does not keep the daemon from its other links
    text = fleet.file.read_text()
    link = "  thin_links: {lora: {bits_per_s: 5470, band: eu868, frame_bytes: 120}}\n"
    text = text.replace("udp_mesh:\n", f"udp_mesh:\n{link}").replace(
        "    nodes: [base]\n", f"    nodes: [base]\n{PORT}"
    )
    fleet.file.write_text(text.replace("class: emergency_stop}", "class: emergency_stop, thin: true}"))
    fleet.deploy()
    found = _show(fleet, "PrivateDevices", "DevicePolicy", "DeviceAllow", "SupplementaryGroups", "ActiveState")
    assert (found["ActiveState"], found["PrivateDevices"], found["DevicePolicy"]) == ("active", "no", "closed")
    assert found["SupplementaryGroups"] == "dialout"
    assert "char-ttyUSB rw" in found["DeviceAllow"]
    pid = _show(fleet, "MainPID")["MainPID"]
    groups = fleet.shell("husky1", f"grep ^Groups: /proc/{pid}/status").split()
    assert fleet.shell("husky1", "getent group dialout").split(":")[2] in groups
    fleet.shell("husky1", f"systemd-analyze security --no-pager --threshold={MAX_EXPOSURE} udp-mesh.service")
    assert "husky1: unchanged" in fleet.deploy()


def test_a_power_cut_during_a_switch_is_detected_and_resumed(fleet: RobotFleet) -> None:
    machine = fleet.add("husky1")
    fleet.write()
    fleet.deploy()
    first = fleet.status()["husky1"]["release"]
    fleet.add_topic("video: {priority: 9}")
    marker = fleet.directory / "husky1/upper/opt/udp-mesh/unproven"

    def cut() -> None:
        while not marker.exists():
            time.sleep(0.001)
        machine.stop()

    cutting = threading.Thread(target=cut)
    cutting.start()
    output = fleet.deploy(exit_code=1)
    cutting.join()
    assert "husky1: uncertain" in output
    assert "completes or rolls back the switch by itself" in output
    machine.start()
    eventually(lambda: fleet.status()["husky1"]["answers"])
    found = fleet.status()["husky1"]
    assert not found["is_proven"]
    assert "a switch was interrupted" in found["remark"]
    assert "a switch was interrupted" in fleet.meshctl("diff", exit_code=1)
    assert "husky1: done: runs " in fleet.root_command("resume")
    found = fleet.status()["husky1"]
    assert found["well"]
    assert found["release"] != first
    assert found["previous"] == first


@pytest.mark.proof
def test_a_clock_years_off_does_not_affect_deploy_or_status(fleet: RobotFleet) -> None:
    machine = fleet.add("husky1", start=False)
    library = next(iter((fleet.base / "usr/lib").glob("*/faketime/libfaketime.so.1"))).relative_to(fleet.base)
    faked = f"LD_PRELOAD=/{library} FAKETIME=-20y FAKETIME_DONT_FAKE_MONOTONIC=1 DONT_FAKE_MONOTONIC=1"
    machine.write("/etc/systemd/system/udp-mesh.service.d/clock.conf", f"[Service]\nEnvironment={faked}\n")
    machine.start()
    fleet.tool("husky1", "date", f'#!/bin/sh\nexec env {faked} /bin/date "$@"\n')
    fleet.add("husky2")
    fleet.write()
    assert int(fleet.shell("husky1", "date +%s")) < time.time() - 19 * 365 * 86_400
    output = fleet.deploy()
    assert "its clock is 20 years behind ours" in output
    pid = fleet.shell("husky1", "systemctl show -p MainPID --value udp-mesh.service").strip()
    assert str(library) in fleet.shell("husky1", f"cat /proc/{pid}/maps"), "the daemon, too, lives in that year"
    eventually(lambda: all(one["online"] for one in fleet.status().values()))
    assert "husky1: unchanged" in fleet.deploy()
    document = json.loads(fleet.meshctl("status", "--json"))
    assert all(one["well"] for one in document)
