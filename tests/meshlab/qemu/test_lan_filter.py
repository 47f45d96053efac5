"""The LAN filter on the kernel's bridges: a lidar that broadcasts behind the Husky's two radios stays off the air.

The base's link carries less than the lidar sends, as a real channel at the multicast rate would.
"""

from __future__ import annotations

import re
import statistics
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from meshlab.qemu import control
from tests.meshlab.qemu.conftest import Lab, until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]

RADIOS = ("husky-front", "husky-rear")
# a tenth of what the lidar sends: an emulated robot on a busy host does not get all of it out
_LINK_KBIT_S = 1000
_PINGS = 25
# a VLP-16's packets to its factory destination: 1206 bytes, at 10 Mbit/s
_LIDAR = """
cat >/run/lidar.py <<'END'
import socket, time
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"eth0")
start, sent = time.monotonic(), 0
while True:
    while sent < (time.monotonic() - start) * 1e7 / 8 / 1206:
        out.sendto(bytes(1206), ("{destination}", 2368))
        sent += 1
    time.sleep(0.005)
END
ip netns exec pc.husky python3 /run/lidar.py >/dev/null 2>&1 </dev/null & echo $! >/run/lidar.pid
"""


@contextmanager
def lidar(lab: Lab, destination: str = "255.255.255.255") -> Iterator[None]:
    """Behind the Husky's radios; with its factory destination by default."""
    control.run(lab.fleet.directory, _LIDAR.replace("{destination}", destination)).check("start the lidar")
    try:
        yield
    finally:
        control.run(lab.fleet.directory, "kill $(cat /run/lidar.pid)").check("stop the lidar")


def round_trips_ms(lab: Lab) -> list[float]:
    """Of small urgent messages from the Husky's computer to the base station; a lost one counts as a whole second."""
    command = f"ip netns exec pc.husky ping -Q 0xb8 -c {_PINGS} -i 0.1 -W 1 10.42.0.2"
    found = re.findall(r"time=([\d.]+) ms", control.run(lab.fleet.directory, command, timeout_s=60.0).stdout)
    return [float(one) for one in found] + [1000.0] * (_PINGS - len(found))


def dropped(lab: Lab) -> list[int]:
    """How many frames the filter of each radio has dropped, by meshctl's status."""
    found: list[int] = []

    def answered() -> bool:
        done = lab.meshctl("status", "--json", "--timeout", "30", *RADIOS, expect=None)
        filters = [node["lan_filter"] for node in done.json["nodes"]] if done.text else []
        found[:] = [counts["dropped_packets"] for counts in filters if counts is not None]
        return len(found) == len(RADIOS)

    until(answered, "both radios to tell what their filters dropped")
    return found


def test_a_lidars_broadcasts_stay_off_the_air_and_urgent_messages_keep_their_latency(lab: Lab) -> None:
    lab.meshctl("lab", "link", "base", "b01", "--rate", str(_LINK_KBIT_S))
    try:
        before = dropped(lab)
        # the same packets to one device on the robot: both measurements share the load of the emulated processor
        with lidar(lab, "10.42.0.11"):
            quiet = round_trips_ms(lab)
        with lidar(lab):
            filtered = round_trips_ms(lab)
        assert all(now - then > 500 for now, then in zip(dropped(lab), before, strict=True))
        for name in RADIOS:
            lab.on(name, "nft delete table bridge meshctl_lan")
        with lidar(lab):
            flooded = round_trips_ms(lab)
    finally:
        for name in RADIOS:
            lab.on(name, "sh /etc/meshctl/lan-filter.sh")
        lab.meshctl("lab", "mend", "base-b01")
    quiet_ms, filtered_ms, flooded_ms = map(statistics.median, (quiet, filtered, flooded))
    # half the way to the flood, on a logarithmic scale
    assert filtered_ms / quiet_ms < (flooded_ms / quiet_ms) ** 0.5
    lab.settle()
