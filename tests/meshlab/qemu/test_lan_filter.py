"""The LAN filter on the kernel's bridges: a lidar that broadcasts behind the Husky's two radios stays off the air.

What reaches the base station's computer, three hops away, is counted: nothing of it with the filter, and without it.
`benchmarks/lan_filter.py` measures what that does to urgent messages.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from meshlab.qemu import control
from tests.meshlab.qemu.conftest import Lab, until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]

RADIOS = ("husky-front", "husky-rear")
# a VLP-16's packets to its factory destination: 1206 bytes
_LIDAR = """
cat >/run/lidar.py <<'END'
import socket, time
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"eth0")
start, sent = time.monotonic(), 0
while True:
    while sent < (time.monotonic() - start) * BITS_PER_S / 8 / 1206:
        out.sendto(bytes(1206), ("255.255.255.255", 2368))
        sent += 1
    time.sleep(0.005)
END
ip netns exec pc.husky python3 /run/lidar.py >/dev/null 2>&1 </dev/null & echo $! >/run/lidar.pid
"""
# counts what arrives until it is killed; the file appears when it listens
_LISTENER = """
rm -f /run/heard
cat >/run/heard.py <<'END'
import pathlib, socket
heard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
heard.bind(("", 2368))
count, written = 0, pathlib.Path("/run/heard.new")
while True:
    written.write_text(str(count))
    written.replace("/run/heard")  # whole for every reader
    heard.recv(2048)
    count += 1
END
ip netns exec pc.base-station python3 /run/heard.py >/dev/null 2>&1 </dev/null & echo $! >/run/heard.pid
"""


def lidar(bits_per_s: float) -> str:
    """The command that starts it."""
    return _LIDAR.replace("BITS_PER_S", f"{bits_per_s:g}")


@contextmanager
def process(lab: Lab, start: str, name: str) -> Iterator[None]:
    """A program in the machine, whose start writes its process ID to `/run/NAME.pid`."""
    control.run(lab.fleet.directory, start).check(f"start {name}")
    try:
        yield
    finally:
        control.run(lab.fleet.directory, f"kill $(cat /run/{name}.pid)").check(f"stop {name}")


def heard_at_base(lab: Lab) -> int | None:
    """How many of the lidar's packets have reached the base station's computer; None: nothing listens yet."""
    return int(text) if (text := control.run(lab.fleet.directory, "cat /run/heard").stdout) else None


def dropped(lab: Lab) -> list[int]:
    """How many frames the filter of each radio has dropped, by meshctl's status."""
    found: list[int] = []

    def answered() -> bool:
        done = lab.meshctl("status", "--json", "--timeout", "30", *RADIOS, expect=None)
        filters = [node["lan_filter"] for node in done.json["nodes"]] if done.text else []
        found[:] = [counts["dropped_packets"] for counts in filters if counts is not None]
        return len(found) == len(RADIOS)

    until(answered, "both radios to report what their filters dropped")
    return found


def test_a_lidars_broadcasts_stay_on_the_robot_and_unicast_passes(lab: Lab) -> None:
    before = dropped(lab)
    try:
        with process(lab, _LISTENER, "heard"):
            until(lambda: heard_at_base(lab) is not None, "the base station's computer to listen")
            with process(lab, lidar(10e6), "lidar"):
                until(
                    lambda: all(now - then > 500 for now, then in zip(dropped(lab), before, strict=True)),
                    "both filters to drop 500 frames",
                )
                until(lambda: lab.answers("husky", "10.42.0.2"), "the base station to answer beside the lidar")
                assert heard_at_base(lab) == 0
            for name in RADIOS:
                lab.on(name, "nft delete table bridge meshctl_lan")
            # on a busy host the mesh carries little of 10 Mbit/s, and what waits would fill the machine's memory
            with process(lab, lidar(0.5e6), "lidar"):
                until(lambda: (heard_at_base(lab) or 0) > 50, "the lidar to be heard without the filters")
    finally:
        for name in RADIOS:
            lab.on(name, "sh /etc/meshctl/lan-filter.sh")
    lab.settle()
