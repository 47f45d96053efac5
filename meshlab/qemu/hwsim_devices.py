"""The network devices of the machine's nodes: veth cables and mac80211_hwsim radios.

Each node has a cable from its first LAN port: on the bench it ends in the machine itself, else in the switch of its
robot, to which the robot's computer (a network namespace `pc.ROBOT`) is connected. Each of its radios is one of
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
# only needed when `detach_devices` failed: the kernel cleans up a dead namespace in the background
_RADIOS_BACK_S = 60.0
_POLL_S = 0.02
_PHYS = Path("/sys/class/ieee80211")
_GROUPS = Path("/sys/kernel/debug/ieee80211")


@dataclass(frozen=True, slots=True)
class NodeHardware:
    """A node's number, phys, LAN ports, cable and LAN."""

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
    """The hardware of every node; phys are numbered in the order of the nodes."""
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
    """The interface name of a LAN's switch; a robot's name would be too long."""
    return f"switch{spec.lans.index(lan)}"


def computer_namespace(lan: LanSpec) -> str:
    """The network namespace of a LAN's computer."""
    return f"pc.{lan.name}"


def operator_lan(spec: FleetSpec) -> LanSpec | None:
    """The LAN of the operator's machine: that of the first base."""
    base = next((node.name for node in spec.nodes if node.medium is Medium.BASE), None)
    return next((lan for lan in spec.lans if base in lan.nodes), None)


def is_on_operator_lan(hardware: NodeHardware, spec: FleetSpec) -> bool:
    """Whether the node is a base whose cable always leads to the operator's machine. Any other base has a cable of its
    own on the bench: on one LAN, two factory devices answer at 192.168.1.1."""
    is_base = spec.nodes[hardware.number].medium is Medium.BASE
    lan = operator_lan(spec)
    if not is_base or lan is None or hardware.lan is not lan:
        return False
    first = next(node.name for node in spec.nodes if node.medium is Medium.BASE)
    return hardware.name == first


def prepare(spec: FleetSpec, country: str = "US") -> None:
    """Create what must exist before any node boots: switches and robots' computers."""
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
        gateway = [f"route add default via {lan.gateway}"] if lan.computer and lan.gateway else []
        ip(["link set lo up", "link set eth0 up", *address, *gateway], namespace=computer_namespace(lan))
    # do not answer ARP on one bench cable for the address of another
    Path("/proc/sys/net/ipv4/conf/all/arp_ignore").write_text("1\n", encoding="ascii")
    run(("iw", "reg", "set", country))
    # hwsim's default interfaces; nodes create their own
    for interface in Path("/sys/class/net").glob("wlan*"):
        run(("iw", "dev", interface.name, "del"))


def attach_devices(hardware: NodeHardware, pid: int) -> None:
    """Move LAN ports and radios into the new namespace of process `pid`. Raises LabError when they stay in use."""
    first, *others = hardware.lan_ports or ("eth0",)
    batch = [f"link add {hardware.cable} type veth peer name {first} address {hardware.mac} netns {pid}"]
    for count, port in enumerate(others):
        batch.append(f"link add {hardware.cable}.{count} type veth peer name {port} address {hardware.mac} netns {pid}")
    deadline = time.monotonic() + _RADIOS_BACK_S
    while any(not (_PHYS / phy).exists() for phy in hardware.phys) or _cables(hardware):
        if time.monotonic() > deadline:
            raise LabError(f"the radios of {hardware.name} were not released within {_RADIOS_BACK_S:g} s")
        time.sleep(_POLL_S)
    ip(batch)
    for phy in hardware.phys:
        for interface in (_PHYS / phy / "device" / "net").glob("*"):
            run(("iw", "dev", interface.name, "del"))
        run(("iw", "phy", phy, "set", "netns", str(pid)))


def detach_devices(hardware: NodeHardware, network: int) -> None:
    """Take radios and cables out of the network namespace (a descriptor) of a node that has ended.

    The kernel would return them, too, but in the background after all other cleanup of the namespace: this took more
    than a minute on a busy host, and takes as long as a TCP socket in the namespace retransmits its FIN.
    """
    home = str(os.getpid())
    # by number: names are looked up in /sys, which shows only the radios of this namespace
    steps: list[tuple[Sequence[str], int]] = [
        (("iw", f"phy#{phy.removeprefix('phy')}", "set", "netns", home), network) for phy in hardware.phys
    ]
    # a veth ends with its peer
    steps += [(("ip", "link", "del", path.name), -1) for path in _cables(hardware)]
    for words, where in steps:
        try:
            run(words, network=where)
        except LabError as error:
            log.warning("device-not-detached node=%s reason=%s", hardware.name, error)


def _cables(hardware: NodeHardware) -> list[Path]:
    """The machine's ends of the node's existing cables."""
    names = [hardware.cable, *(f"{hardware.cable}.{count}" for count in range(len(hardware.lan_ports) - 1))]
    return [path for path in map(Path("/sys/class/net").joinpath, names) if path.exists()]


def connect_cable(hardware: NodeHardware, spec: FleetSpec, *, on_bench: bool) -> None:
    """Connect a running node's cable to the bench, to its robot's switch, or to nothing."""
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
    """The operator's address for `node` on the bench: from the end of its network, one per node."""
    network = node.network
    hosts = network.num_addresses - 2
    candidate = network.broadcast_address - 1 - number % hosts
    if candidate == node.ip:
        candidate = network.broadcast_address - 1 - (number + 1) % hosts
    return IPv4Interface((candidate, network.prefixlen))


def set_group(phy: str, mask: int) -> None:
    """Set a radio's hwsim group mask, which it keeps when it moves between namespaces."""
    (_GROUPS / phy / "hwsim" / "group").write_text(f"{mask}\n", encoding="ascii")


def ip(lines: Sequence[str], *, namespace: str = "") -> None:
    """Run several `ip` commands in one process. Raises LabError with its error output."""
    where = ("-n", namespace) if namespace else ()
    run(("ip", *where, "-batch", "-"), stdin="".join(f"{line}\n" for line in lines))


def run(command: Sequence[str], *, stdin: str = "", node: int = 0, network: int = -1) -> str:
    """Run a program in the network namespace of the node whose process 1 is `node`, in that of the descriptor
    `network`, or (neither) in the machine's own; returns its output.

    Raises LabError with its error output. nsenter is not used: busybox's would run its own applets, not iproute2.
    """
    with contextlib.ExitStack() as stack:
        if node:
            try:
                network = os.open(f"/proc/{node}/ns/net", os.O_RDONLY | os.O_CLOEXEC)
            except OSError as error:
                # ENOENT: it has ended; EACCES: it has also been reaped
                raise LabError("the node has ended") from error
            stack.callback(os.close, network)
        enter = (lambda: ns.setns(network, ns.CLONE_NEWNET)) if network >= 0 else None
        done = subprocess.run(command, input=stdin, capture_output=True, text=True, check=False, preexec_fn=enter)
    if done.returncode != 0:
        raise LabError(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}")
    return done.stdout
