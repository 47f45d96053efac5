"""One interface of a robot of a live team, whose other end is a port of an `Ether`."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Callable

from tests.udp_mesh.daemon.live.ether import Ether

REFUSING_RULE = 10
"""Preference of the routing rule that makes the kernel refuse to send."""


def run(command: str) -> None:
    subprocess.run(command.split(), check=True)


class Radio:
    """`mesh0` in the robot's namespace, or `mesh1` of its second radio; the addresses of each are a network."""

    def __init__(self, robot: str, place: int, number: int, ether: Ether, *, ipv6: bool) -> None:
        self.robot, self.number, self.ether, self.ipv6 = robot, number, ether, ipv6
        self.interface, self.port = f"mesh{number}", f"port{place}.{number}"
        self.place, self.host = place, place + 1
        self._ip: Callable[[str], None]

    def attach(self, namespace: int, ip: Callable[[str], None]) -> None:
        """Make the interface. `ip` runs `ip WORDS` in the robot's namespace."""
        self._ip = ip
        # Segmentation by the kernel: the ether sees the datagrams that a radio would.
        peer = f"peer name {self.interface} gso_max_segs 1 netns {namespace}"
        run(f"ip link add {self.port} gso_max_segs 1 type veth {peer}")
        run(f"ip link set {self.port} up")
        ip(f"link set {self.interface} addrgenmode none")
        self.plug_in()
        self.ether.plug_in(self.robot, self.port)

    @property
    def network(self) -> str:
        return "fe80::/10" if self.ipv6 else f"10.{7 + self.number}.0.0/16"

    @property
    def address(self) -> str:
        host = self.host
        return f"fe80::{host:x}/64" if self.ipv6 else f"10.{7 + self.number}.{host >> 8}.{host & 255}/16"

    def plug_in(self) -> None:
        """The interface is up, with its address."""
        self._ip(f"link set {self.interface} up")
        # The kernel removes an IPv6 address when the interface goes down.
        self._ip(f"addr replace {self.address} {'nodad' if self.ipv6 else 'broadcast +'} dev {self.interface}")

    def pull_out(self) -> None:
        self._ip(f"link set {self.interface} down")

    def set_mtu(self, mtu: int) -> None:
        self._ip(f"link set {self.interface} mtu {mtu}")

    def move(self, host: int, *, overlaps: bool) -> None:
        """Another address, as from another DHCP lease: instead of the old one, or before that goes."""
        if overlaps:
            self.plug_in()
        else:
            self._ip(f"addr flush dev {self.interface}")
        old, self.host = self.address, host
        self.plug_in()
        if overlaps and old != self.address:
            self._ip(f"addr del {old} dev {self.interface}")

    def renumber(self, host: int) -> None:
        """The interface goes down and loses its address; it will get another one."""
        self.pull_out()
        self._ip(f"addr flush dev {self.interface}")
        self.host = host

    def refuse_to_send(self, how: str) -> None:
        """The kernel refuses datagrams to single peers, with EACCES (`prohibit`), ENETUNREACH (`unreachable`) or EINVAL
        (`blackhole`)."""
        self._ip(f"{self._family} rule add pref {REFUSING_RULE + self.number} to {self.network} {how}")

    def allow_to_send(self) -> None:
        """Also if nothing is refused."""
        with contextlib.suppress(subprocess.CalledProcessError):
            self._ip(f"{self._family} rule del pref {REFUSING_RULE + self.number}")

    @property
    def _family(self) -> str:
        return "-6" if self.ipv6 else "-4"

    def close(self) -> None:
        # The kernel would remove it some time after the namespace, when the next team may need the name.
        subprocess.run(["ip", "link", "del", self.port], check=False, stderr=subprocess.DEVNULL)
