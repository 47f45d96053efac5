"""Interfaces that come, change and go, in a network namespace of the kernel's own."""

import os
import subprocess
import sys

SCRIPT = """
import select, subprocess, time
from udp_mesh.links.attachments import EVERY_INTERFACE, LinkConfig
from udp_mesh.links.hub import LinkHub
from udp_mesh.links.netlink import InterfaceMonitor

def ip(words):
    subprocess.run(["ip", *words.split()], check=True)

monitor = InterfaceMonitor()
hub = LinkHub(EVERY_INTERFACE, 8700)

def settle(*expected):
    # Refreshes whenever the kernel reports a change, until exactly these links are open.
    opened, gone, deadline = [], [], time.monotonic() + 60
    while True:
        changes = hub.refresh()
        opened += [link.attachment for link in changes.opened]
        gone += [link.attachment.name for link in changes.gone]
        now = {(name, link.attachment.address[0]) for name, link in hub.links.items()}
        if now == set(expected):
            return opened, gone
        ready, _, _ = select.select([monitor], [], [], max(0, deadline - time.monotonic()))
        assert ready, f"the kernel reported no further change: {now}"
        assert monitor.drain()

settle()
ip("link add mesh0 type veth peer name far0")
ip("link set far0 up")
ip("link set mesh0 up")
ip("addr add 10.7.20.5/20 broadcast + dev mesh0")
opened, gone = settle(("mesh0", "10.7.20.5"))
assert [a.broadcast for a in opened] == [("10.7.31.255", 8700)] and not gone, opened

# A second interface leaves the first one's socket alone.
first = hub.links["mesh0"]
ip("link add mesh1 type veth peer name far1")
ip("link set far1 up")
ip("link set mesh1 up")
ip("addr add 192.168.9.18/28 broadcast + dev mesh1")
opened, gone = settle(("mesh0", "10.7.20.5"), ("mesh1", "192.168.9.18"))
assert [a.broadcast for a in opened] == [("192.168.9.31", 8700)] and not gone
assert hub.links["mesh0"] is first

# A changed address reopens.
ip("addr del 10.7.20.5/20 dev mesh0")
ip("addr add 10.7.20.6/20 broadcast + dev mesh0")
opened, gone = settle(("mesh0", "10.7.20.6"), ("mesh1", "192.168.9.18"))
assert gone == ["mesh0"] and len(opened) == 1

# A lost carrier and a deleted interface close; the carrier's return opens.
ip("link set far0 down")
settle(("mesh1", "192.168.9.18"))
ip("link del mesh1")
settle()
ip("link set far0 up")
settle(("mesh0", "10.7.20.6"))

# A port in use is reported, and retried.
hub.close()
taken = LinkHub(EVERY_INTERFACE, 8700)
assert taken.refresh().opened
failed = hub.refresh().failed
assert "Address already in use (UDP port 8700" in failed["mesh0"], failed
taken.close()
assert hub.refresh().opened

# Too narrow for a datagram: reported, not opened, without effect on other links.
ip("link set mesh0 mtu 150")
failed = hub.refresh().failed
assert "expected an MTU of at least 200 bytes, found 150 on mesh0" in failed["mesh0"], failed
ip("link set mesh0 mtu 1500")
settle(("mesh0", "10.7.20.6"))

# Deleted and created again between two refreshes, with the same name and address: the old socket would hear nothing.
first = hub.links["mesh0"]
ip("link del mesh0")
ip("link add mesh0 type veth peer name far0")
ip("link set far0 up")
ip("link set mesh0 up")
ip("addr add 10.7.20.6/20 broadcast + dev mesh0")
settle(("mesh0", "10.7.20.6"))
assert hub.links["mesh0"] is not first

# Broadcasts reach the other side of the veth, and not ourselves.
class Out:
    destination, data, urgent = None, b"to all", False
far = LinkHub([LinkConfig("far0")], 8700)
ip("addr add 10.7.20.9/20 broadcast + dev far0")
for scope in ("all", "far0"):
    # Both ends of the pair live here: the kernel takes the other end's address for a forgery otherwise.
    for name, value in (("accept_local", "1"), ("rp_filter", "0")):
        with open(f"/proc/sys/net/ipv4/conf/{scope}/{name}", "w") as sysctl:
            sysctl.write(value)
assert far.refresh().opened
heard, echoed = [], []
deadline = time.monotonic() + 60
while not heard and time.monotonic() < deadline:
    hub.links["mesh0"].send([Out()])
    select.select([far.links["far0"].strangers_fileno()], [], [], 0.2)
    far.links["far0"].receive_from_strangers(lambda data, source, arrived: heard.append((bytes(data), source)), 10)
    hub.links["mesh0"].receive_from_strangers(lambda data, source, arrived: echoed.append(bytes(data)), 10)
assert heard[0] == (b"to all", ("10.7.20.6", 8700)), heard

# A known peer's broadcast arrives at the socket for what peers do not mark, and only there.
far.links["far0"].set_peers(frozenset({("10.7.20.6", 8700)}))
found = {"marked": [], "unmarked": [], "strangers": []}
while not found["unmarked"] and time.monotonic() < deadline:
    hub.links["mesh0"].send([Out()])
    select.select([far.links["far0"].unmarked_fileno()], [], [], 0.2)
    far.links["far0"].receive(lambda data, source, arrived: found["marked"].append(bytes(data)), 10)
    far.links["far0"].receive_unmarked(lambda data, source, arrived: found["unmarked"].append(bytes(data)), 10)
    far.links["far0"].receive_from_strangers(lambda data, source, arrived: found["strangers"].append(bytes(data)), 10)
assert found["unmarked"]
assert found["marked"] == found["strangers"] == []
assert not echoed
far.close(); hub.close(); monitor.close()
"""


def test_sockets_follow_the_kernels_interfaces() -> None:
    """Veth pairs in a network namespace: netmasks /20 and /28, carrier, deletion, a taken port, broadcast."""
    # Root needs no user namespace, and some systems forbid them.
    become_root = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    done = subprocess.run(
        ["unshare", *become_root, "--net", sys.executable, "-c", SCRIPT],
        check=False,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
