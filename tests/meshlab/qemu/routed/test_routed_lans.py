"""LANs with subnets of their own over the kernel's batman-adv: routes, broadcasts, and the robots' daemons."""

from __future__ import annotations

import json

import pytest

from meshctl.inventory import load_fleet
from meshctl.render.daemon import daemon_config
from meshlab.qemu import control
from tests.meshlab.qemu.conftest import Lab, until
from tests.meshlab.qemu.routed.conftest import RoutedLab
from tests.meshlab.qemu.test_telemetry import is_there, on_machine, put_programs

pytestmark = [pytest.mark.proof, pytest.mark.lab, pytest.mark.xdist_group("lab-real-routed"), pytest.mark.timeout(2400)]

COMPUTERS = {"base-station": "10.43.0.10", "husky": "10.43.1.10", "spot": "10.42.0.30"}
_DAEMON = """
mkdir -p /run/mesh-{robot}
cat >/run/mesh-{robot}/udp-mesh.toml <<'END'
{config}
[daemon]
socket = "/run/mesh-{robot}/socket"
state_directory = "/run/mesh-{robot}"
END
(umask 077; echo {key} >/run/mesh-{robot}/fleet.key)
ip netns exec pc.{robot} env PYTHONPATH=/opt/telemetry python3 /run/mesh.py run /run/mesh-{robot}/udp-mesh.toml \
    >/run/mesh-{robot}/log 2>&1 </dev/null &
echo $! >>/run/mesh-pids
"""
# once, before any daemon reads it
_PROGRAM = """
cat >/run/mesh.py <<'END'
import sys
from udp_mesh.cli.main import main
sys.exit(main(sys.argv[1:]))
END
"""
_LISTEN = """
cat >/tmp/listen.py <<'END'
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("", 2368))
s.settimeout(5)
count = 0
try:
    while True:
        s.recv(2000)
        count += 1
except TimeoutError:
    print(count)
END
cat >/tmp/lidar.py <<'END'
import socket, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
for n in range(200):
    s.sendto(bytes(1206), ("255.255.255.255", 2368))
    time.sleep(0.01)
END
ip netns exec pc.spot python3 /tmp/listen.py >/tmp/spot-heard &
listening=$!
sleep 1
ip netns exec pc.husky python3 /tmp/lidar.py
wait $listening
cat /tmp/spot-heard
"""


def test_computers_reach_each_other_through_their_routers(routed: RoutedLab) -> None:
    for robot in COMPUTERS:
        for other, address in COMPUTERS.items():
            if other != robot:
                until(lambda: routed.answers(robot, address), f"{other} to answer {robot}")  # noqa: B023
    # the operator's machine reaches every radio at its management address, also one that only relays
    for address in ("10.42.0.1", "10.42.0.101", "10.42.0.11", "10.42.0.12", "10.42.0.13"):
        until(lambda: routed.answers("base-station", address), address)  # noqa: B023
    # no address translation: the Husky sees the base station's own address
    assert "10.43.0.10" not in routed.on("husky-front", "ip addr")
    assert "via 10.42.0.1" in routed.on("b01", "ip route get 10.43.0.10")
    assert "via 10.42.0.11" in routed.on("base", "ip route get 10.43.1.10")


def test_broadcasts_of_a_sensor_stay_in_the_robots_lan(routed: RoutedLab) -> None:
    sent = "cat /sys/class/net/mesh0/statistics/tx_bytes"
    before = int(routed.on("husky-front", sent))
    heard = control.run(routed.fleet.directory, _LISTEN, timeout_s=120.0).check("lidar").stdout
    assert heard.strip() == "0"
    # 200 packets of 1206 bytes, three times each as batman-adv repeats broadcasts, would be 720 kB
    assert int(routed.on("husky-front", sent)) - before < 200_000


def test_the_daemons_meet_with_the_rendered_configuration(routed: RoutedLab) -> None:
    fleet = load_fleet(routed.inventory)
    put_programs(routed)
    on_machine(routed, _PROGRAM)
    for robot in COMPUTERS:
        config = daemon_config(fleet, robot).decode()
        on_machine(routed, _DAEMON.format(robot=robot, config=config, key="be" * 32))
    try:
        for robot in COMPUTERS:
            until(lambda: is_there(routed, f"/run/mesh-{robot}/socket"), f"the daemon of {robot}")  # noqa: B023
        for robot in COMPUTERS:
            others = COMPUTERS.keys() - {robot}
            until(lambda: _online(routed, robot) == others, f"{robot} to meet {', '.join(sorted(others))}")  # noqa: B023
    finally:
        on_machine(routed, "kill $(cat /run/mesh-pids); rm /run/mesh-pids")


def _online(lab: Lab, robot: str) -> set[str]:
    words = f"env PYTHONPATH=/opt/telemetry python3 /run/mesh.py status --json --socket /run/mesh-{robot}/socket"
    done = control.run(lab.fleet.directory, words)
    if done.exit_status != 0:
        return set()
    return {peer["name"] for peer in json.loads(done.stdout)["conditions"]["peers"] if peer["online"]}


def test_a_changed_channel_is_provisioned_over_the_routed_mesh(routed: RoutedLab) -> None:
    routed.edit("channel: 6", "channel: 11")
    routed.provision()
    routed.settle()
    assert "channel 11 (" in routed.on("spot-radio", "iw dev mesh0 info")
    until(lambda: routed.answers("base-station", COMPUTERS["spot"]), "Spot's computer")


def test_status_reaches_every_node_at_its_management_address(routed: RoutedLab) -> None:
    def all_answer() -> bool:
        nodes = routed.meshctl("status", "--json", "--timeout", "30", expect=None).json["nodes"]
        return {node["name"] for node in nodes if node["answers"]} == set(routed.NODES)

    until(all_answer, "every node to answer")
