"""Make a fleet spec from an inventory: its nodes as factory-fresh devices, and links between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from meshctl.model import Fleet, Node, Robot, Role
from meshctl.resolve import computer_gateway, lan_filter_needs
from meshlab.errors import LabError
from meshlab.spec import (
    DEFAULT_DRIVER,
    MESH_PACKAGES,
    SSH_PORT,
    FleetSpec,
    LanSpec,
    LinkSpec,
    Medium,
    NodeSpec,
    RadioSpec,
)

# the default topology is a chain up to this size, a tree above
_MAX_CHAIN_NODES = 12
# locally administered, so that no real device has it: two bytes of prefix, two for the node, two for the radio
_MAC = "02:4d:{:02x}:{:02x}:00:{:02x}"


def spec_of(
    fleet: Fleet, *, links: Sequence[LinkSpec] | None = None, nodes: int | None = None, port: int = 0
) -> FleetSpec:
    """The spec of a fleet with the inventory's first `nodes` managed nodes (default: all), factory-fresh.

    Every node is on the bench; the operator's machine is on the LAN of the node with the role `base`. `links` None:
    `default_links` in the inventory's order. Raises LabError for a node with an IPv6 address.
    """
    chosen = tuple(fleet.managed())[:nodes]
    for node in chosen:
        if node.address.version == 6:
            raise LabError(
                f"node {node.name} has the IPv6 address {node.address.ip}: the virtual fleet has IPv4 only",
                hint="use IPv4 networks in a copy of the inventory for practice; provision supports both on real nodes",
            )
    names = [node.name for node in chosen]
    if links is None:
        used = default_links(names, [[node.name for node in chosen if mesh in node.meshes] for mesh in fleet.meshes])
    else:
        used = [link for link in links if link.a in names and link.b in names]
    return FleetSpec(
        name=fleet.name,
        nodes=tuple(_node_spec(node, number) for number, node in enumerate(chosen)),
        links=tuple(used),
        port=port,
        lans=tuple(_lan_spec(fleet, robot, names) for robot in fleet.robots.values() if set(robot.nodes) & set(names)),
    )


def default_links(names: Sequence[str], meshes: Sequence[Sequence[str]] = ()) -> list[LinkSpec]:
    """Links between all nodes, and among the nodes of each of `meshes`: radios of another mesh forward nothing."""
    found: dict[frozenset[str], LinkSpec] = {}
    for members in (*meshes, names):
        for link in _chain_or_tree(members):
            found.setdefault(link.ends, link)
    return list(found.values())


def _chain_or_tree(names: Sequence[str]) -> list[LinkSpec]:
    """A chain with a weaker link past every second node; for big fleets, a tree with three children per node, because
    batman-adv's TQ reaches 0 after some thirty hops."""
    if len(names) > _MAX_CHAIN_NODES:
        return [LinkSpec(names[(number - 1) // 3], name, tq=250) for number, name in enumerate(names) if number]
    chain = [LinkSpec(a, b, tq=250, signal_dbm=-58) for a, b in pairwise(names)]
    past = [LinkSpec(a, b, tq=120, signal_dbm=-79) for a, b in list(zip(names, names[2:], strict=False))[::2]]
    return chain + past


def _lan_spec(fleet: Fleet, robot: Robot, names: Sequence[str]) -> LanSpec:
    computer = robot.computer
    nodes = tuple(name for name in robot.nodes if name in names)
    gateway = computer_gateway(fleet, robot)
    return LanSpec(robot.name, nodes, str(computer.address) if computer else "", str(gateway) if gateway else "")


def _node_spec(node: Node, number: int) -> NodeSpec:
    hardware = node.hardware
    filter_packages = (need.any_of[0] for need in lan_filter_needs(node))
    radios = tuple(
        RadioSpec(
            name=radio.name,
            path=radio.hardware.path,
            band=radio.hardware.band.value,
            mac=radio.mac or _MAC.format(number // 256, number % 256, 16 + place),
            max_tx_power_dbm=radio.hardware.max_drive_dbm,
            driver=radio.hardware.driver or DEFAULT_DRIVER,
        )
        for place, radio in enumerate(node.radios)
    )
    return NodeSpec(
        name=node.name,
        board=hardware.board,
        model=hardware.name,
        target=hardware.target,
        release=node.release,
        packages=tuple(dict.fromkeys((*MESH_PACKAGES, *filter_packages, *hardware.packages, *node.packages))),
        radios=radios,
        lan_ports=hardware.lan_ports or node.lan_ports,
        mac=node.mac or _MAC.format(number // 256, number % 256, 0),
        medium=Medium.BASE if node.role is Role.BASE else Medium.BENCH,
        overlay_kib=max(1024, hardware.flash_mib * 1024 // 2),
        memory_kib=hardware.memory_mib * 1024,
        # behind another host, `port` is that of the host
        ssh_port=SSH_PORT if node.ssh.host else node.ssh.port,
    )
