"""Cables and radios of the machine's nodes, put in from outside as hands would.

Each node has a cable from its first LAN port: on the bench it ends in the machine itself, else in the switch of the
robot it belongs to, where the robot's computer is (a network namespace `pc.ROBOT`). Each of its radios is one of
mac80211_hwsim's, moved into its namespace at every boot and taken back when it ends.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Interface
from pathlib import Path

from meshlab import namespaces as ns
from meshlab.errors import LabError
from meshlab.spec import FleetSpec, LanSpec, Medium
from meshlab.state import label_mac

log = logging.getLogger("meshlab.qemu.hwsim_devices")
# only when `take_devices` failed: the kernel takes a dead namespace apart in the background, whenever it gets to it
_RADIOS_BACK_S = 60.0
_POLL_S = 0.02
_PHYS = Path("/sys/class/ieee80211")
_GROUPS = Path("/sys/kernel/debug/ieee80211")


@dataclass(frozen=True, slots=True)
class NodeHardware:
    """Where a node's hardware is: its number, its radios' names in the kernel, its cable, its LAN."""

    name: str
    number: int
    mac: str
    phys: tuple[str, ...]
    lan_ports: tuple[str, ...]
    lan: LanSpec | None

    @property
    def cable(self) -> str:
        return f"cable{self.number}"


def node_hardware(spec: FleetSpec) -> dict[str, NodeHardware]:
    """Every node's place; radios are counted through in the order of the nodes."""
    lans = {name: lan for lan in spec.lans for name in lan.nodes}
    found = {}
    phy = 0
    for number, node in enumerate(spec.nodes):
        phys = tuple(f"phy{phy + place}" for place in range(len(node.radios)))
        phy += len(phys)
        mac = label_mac(node, number)
        found[node.name] = NodeHardware(node.name, number, mac, phys, node.lan_ports, lans.get(node.name))
    return found


def switch_name(lan: LanSpec, spec: FleetSpec) -> str:
    """The kernel's name of a LAN's switch; robots' names are too long for it."""
    return f"switch{spec.lans.index(lan)}"


def computer_namespace(lan: LanSpec) -> str:
    """The name of the namespace that is a LAN's computer."""
    return f"pc.{lan.name}"


def operator_lan(spec: FleetSpec) -> LanSpec | None:
    """The LAN at which the operator sits: that of the first base."""
    base = next((node.name for node in spec.nodes if node.medium is Medium.BASE), None)
    return next((lan for lan in spec.lans if base in lan.nodes), None)


def prepare(spec: FleetSpec, country: str = "US") -> None:
    """Make what stands before any node has power: switches, robots' computers, the machine's own address."""
    batch = ["link set lo up"]
    for lan in spec.lans:
        switch, space = switch_name(lan, spec), computer_namespace(lan)
        batch += [
            f"netns add {space}",
            f"link add {switch} type bridge stp_state 0 mcast_snooping 0",
            f"link set {switch} up",
            f"link add {switch}.pc up master {switch} type veth peer name eth0 netns {space}",
        ]
    ip(batch)
    for lan in spec.lans:
        address = [f"addr add {lan.computer} dev eth0"] if lan.computer else []
        ip(["link set lo up", "link set eth0 up", *address], space=computer_namespace(lan))
    # an address of one bench cable is not told on another
    Path("/proc/sys/net/ipv4/conf/all/arp_ignore").write_text("1\n", encoding="ascii")
    run(("iw", "reg", "set", country))
    # the interfaces hwsim comes with; nodes make their own
    for interface in Path("/sys/class/net").glob("wlan*"):
        run(("iw", "dev", interface.name, "del"))


def attach_devices(hardware: NodeHardware, pid: int) -> None:
    """Give the new namespace of process `pid` its LAN ports and radios. Raises LabError when they do not come free."""
    first, *others = hardware.lan_ports or ("eth0",)
    batch = [f"link add {hardware.cable} type veth peer name {first} address {hardware.mac} netns {pid}"]
    for count, port in enumerate(others):
        batch.append(f"link add {hardware.cable}.{count} type veth peer name {port} address {hardware.mac} netns {pid}")
    deadline = time.monotonic() + _RADIOS_BACK_S
    while any(not (_PHYS / phy).exists() for phy in hardware.phys) or _cables(hardware):
        if time.monotonic() > deadline:
            raise LabError(f"the radios of {hardware.name} did not come back within {_RADIOS_BACK_S:g} s")
        time.sleep(_POLL_S)
    ip(batch)
    for phy in hardware.phys:
        for interface in (_PHYS / phy / "device" / "net").glob("*"):
            run(("iw", "dev", interface.name, "del"))
        run(("iw", "phy", phy, "set", "netns", str(pid)))


def detach_devices(hardware: NodeHardware, network: int) -> None:
    """Take radios and cables out of the network (a descriptor) of a node that has ended; they are here on return.

    The kernel would return them too, but in the background and after everything else that a dead network leaves: seen
    to take more than a minute on a busy host, and as long as a socket of the network retries its farewell.
    """
    home = str(os.getpid())
    # by number: names are looked up in /sys, which shows this network's radios alone
    steps: list[tuple[Sequence[str], int]] = [
        (("iw", f"phy#{phy.removeprefix('phy')}", "set", "netns", home), network) for phy in hardware.phys
    ]
    # a veth ends with its peer
    steps += [(("ip", "link", "del", path.name), -1) for path in _cables(hardware)]
    for words, where in steps:
        try:
            run(words, network=where)
        except LabError as error:
            log.warning("device-not-taken node=%s reason=%s", hardware.name, error)


def _cables(hardware: NodeHardware) -> list[Path]:
    """The machine's ends of the node's cables that exist now."""
    names = [hardware.cable, *(f"{hardware.cable}.{count}" for count in range(len(hardware.lan_ports) - 1))]
    return [path for path in map(Path("/sys/class/net").joinpath, names) if path.exists()]


def connect_cable(hardware: NodeHardware, spec: FleetSpec, *, on_bench: bool) -> None:
    """Let a running node's cable end on the bench, in its robot's switch, or nowhere."""
    if not (Path("/sys/class/net") / hardware.cable).exists():
        return
    if on_bench:
        ip([f"link set {hardware.cable} nomaster", f"link set {hardware.cable} up"])
    elif hardware.lan is not None:
        ip(
            [
                f"addr flush dev {hardware.cable}",
                f"link set {hardware.cable} master {switch_name(hardware.lan, spec)} up",
            ]
        )
    else:
        ip(
            [
                f"addr flush dev {hardware.cable}",
                f"link set {hardware.cable} nomaster",
                f"link set {hardware.cable} down",
            ]
        )


def operator_address(node: IPv4Interface, number: int) -> IPv4Interface:
    """The address the operator takes to speak with `node` on the bench: from the end of its network, one per node."""
    network = node.network
    hosts = network.num_addresses - 2
    candidate = network.broadcast_address - 1 - number % hosts
    if candidate == node.ip:
        candidate = network.broadcast_address - 1 - (number + 1) % hosts
    return IPv4Interface((candidate, network.prefixlen))


def set_group(phy: str, mask: int) -> None:
    """Radios hear each other when their masks overlap; it stays with the radio wherever it moves."""
    (_GROUPS / phy / "hwsim" / "group").write_text(f"{mask}\n", encoding="ascii")


def ip(lines: Sequence[str], *, space: str = "") -> None:
    """Several `ip` commands in one process. Raises LabError with its complaint."""
    where = ("-n", space) if space else ()
    run(("ip", *where, "-batch", "-"), stdin="".join(f"{line}\n" for line in lines))


def run(words: Sequence[str], *, stdin: str = "", node: int = 0, network: int = -1) -> str:
    """What a program of the machine prints, run in the network of the node whose process 1 is `node` or in that of the
    descriptor `network` (neither: outside).

    Raises LabError with its complaint. busybox' nsenter would run applets of its own where iproute2 is meant.
    """
    with contextlib.ExitStack() as stack:
        if node:
            try:
                network = os.open(f"/proc/{node}/ns/net", os.O_RDONLY | os.O_CLOEXEC)
            except OSError as error:
                # ENOENT: it has ended; EACCES: it has been collected, too
                raise LabError("the node has just ended") from error
            stack.callback(os.close, network)
        enter = (lambda: ns.setns(network, ns.CLONE_NEWNET)) if network >= 0 else None
        done = subprocess.run(words, input=stdin, capture_output=True, text=True, check=False, preexec_fn=enter)
    if done.returncode != 0:
        raise LabError(f"{' '.join(words)}: {done.stderr.strip() or done.returncode}")
    return done.stdout
