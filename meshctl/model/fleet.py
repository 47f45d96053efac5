"""Nodes, robots and the fleet, with the origin of every value."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from ipaddress import IPv4Address
from types import MappingProxyType

from meshctl.diagnostics import Position
from meshctl.model.hardware import HardwareProfile, RadioHardware
from meshctl.model.ip import IpAddress, IpInterface, IpNetwork
from meshctl.model.mesh import Mesh
from meshctl.model.release import Release
from meshctl.model.secret import SecretRef
from meshctl.model.site import OWN_ADDRESS, NatsHub, Site, SshSettings
from meshctl.model.thin import ThinLink, ThinPorts
from meshctl.model.topic import Topic

_SWITCHED_PORT = re.compile(r"eth\d+\.(?P<vlan>\d+)")


class Role(Enum):
    """BASE is the operator's radio, ROBOT is mounted on a robot, BEACON is dropped by one."""

    BASE = "base"
    ROBOT = "robot"
    BEACON = "beacon"


class NodeState(Enum):
    """CARRIED: in its rack, may be off. DEPLOYED: must answer. SPARE: in storage. LOST and RETIRED: not managed."""

    CARRIED = "carried"
    DEPLOYED = "deployed"
    SPARE = "spare"
    LOST = "lost"
    RETIRED = "retired"

    @property
    def is_managed(self) -> bool:
        return self not in (NodeState.LOST, NodeState.RETIRED)


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a value came from: `layer` is `node`, `range PATTERN`, `group NAME`, `defaults`, `rule` (computed, e.g. an
    address), `hardware NAME`, `mesh NAME`, `robot NAME`, `topic NAME`, `fleet` (its other sections) or `built-in`."""

    position: Position
    layer: str


class MissingOrigin(LookupError):
    """A path that is not in the inventory."""


@dataclass(frozen=True, slots=True)
class Radio:
    """One radio of a node: its hardware, the mesh it joins (None: off) and its drive level for UCI."""

    hardware: RadioHardware
    mesh: str | None
    tx_power_dbm: int
    mac: str = ""

    @property
    def name(self) -> str:
        return self.hardware.name

    @property
    def conducted_dbm(self) -> float:
        """Power at the antenna connector: drive level plus amplifier, at most the rating, minus cable loss."""
        driven = self.tx_power_dbm + self.hardware.amplifier_gain_db
        return min(driven, self.hardware.rated_power_dbm) - self.hardware.cable_loss_db

    @property
    def eirp_dbm(self) -> float:
        return self.conducted_dbm + self.hardware.antenna_gain_dbi


@dataclass(frozen=True, slots=True)
class FixedPosition:
    """Where a device stands for the whole mission, in meters in the frame of the fleet's map; `z_m` None: unknown."""

    x_m: float
    y_m: float
    z_m: float | None = None


@dataclass(frozen=True, slots=True)
class LanFilter:
    """The group-addressed frames that a radio passes from its wired ports into the mesh: address resolution, DHCP,
    group membership and udp_mesh, and UDP to `udp_ports`."""

    udp_ports: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Node:
    """One radio device. `address` is its management address with the prefix length, in its mesh's network.

    `lan_address` is its address in its robot's own LAN, between which and the mesh it routes; None: it bridges the two.
    `lan_filter` None: it bridges every frame. `site` is empty for a node that belongs to none.
    """

    name: str
    hostname: str
    role: Role
    state: NodeState
    hardware: HardwareProfile
    release: Release
    address: IpInterface
    radios: tuple[Radio, ...]
    lan_ports: tuple[str, ...]
    ssh: SshSettings = OWN_ADDRESS
    robot: str = ""
    label: str = ""
    serial: str = ""
    mac: str = ""
    host_keys: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    confirm_window_s: int = 120
    packages: tuple[str, ...] = ()
    extra_uci: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    gateway: IpAddress | None = None
    lan_address: IpInterface | None = None
    position: FixedPosition | None = None
    lan_filter: LanFilter | None = None
    site: str = ""

    @property
    def addresses(self) -> tuple[IpInterface, ...]:
        """Its address in the mesh and, if it routes, that in its robot's LAN."""
        return (self.address,) if self.lan_address is None else (self.address, self.lan_address)

    @property
    def bridges_lan(self) -> bool:
        """Whether frames pass between its wired ports and its mesh."""
        return bool(self.lan_ports and self.meshes) and self.lan_address is None

    @property
    def unswitched_ports(self) -> tuple[str, ...]:
        """Ports such as eth0.1 whose VLAN is on no switch in the inventory. swconfig's switches are behind ethN; a DSA
        port, such as lan4.63, needs no switch VLAN."""
        if "switch_vlan" in self.extra_uci.values():
            return ()
        vlans = {vlan for vlan, _ in self.hardware.switch_vlans}
        return tuple(
            port
            for port in self.lan_ports
            if (found := _SWITCHED_PORT.fullmatch(port)) is not None and found["vlan"] not in vlans
        )

    @property
    def mesh_interfaces(self) -> dict[str, str]:
        """The mesh of each mesh interface, by the interface's name: `mesh0`, `mesh1`, ... in the radios' order."""
        joined = (radio.mesh for radio in self.radios if radio.mesh is not None)
        return {f"mesh{index}": mesh for index, mesh in enumerate(joined)}

    def bands_beside(self, meshes: Iterable[Mesh]) -> str:
        """The bands of its radios and of the meshes: `radio0 is 5g, and mesh main is 2g`."""
        radios = ", ".join(f"{radio.name} is {radio.hardware.band.value}" for radio in self.radios)
        return f"{radios}, and {', '.join(f'mesh {mesh.name} is {mesh.band.value}' for mesh in meshes)}"

    @property
    def meshes(self) -> tuple[str, ...]:
        """The names of the meshes its radios join, each once, in the radios' order."""
        return tuple(dict.fromkeys(radio.mesh for radio in self.radios if radio.mesh is not None))


@dataclass(frozen=True, slots=True)
class ComputerLink:
    """A further link of a robot's daemon: an interface (a name or a pattern) or the computer's address there.
    `neighbors` are the addresses of robots that no broadcast reaches."""

    interface: str = ""
    address: IpAddress | None = None
    neighbors: Mapping[str, IpAddress] = field(default_factory=lambda: MappingProxyType({}))
    mtu: int | None = None


@dataclass(frozen=True, slots=True)
class Computer:
    """A robot's computer, where the udp_mesh daemon runs. `gateway` is its next hop to other networks, by default the
    robot's radio. `links` are those of the daemon beside the one with `address`. With `collector`, it asks the robot's
    radios for their links, with the private part of the SSH key `collector_key`."""

    address: IpInterface
    ssh: SshSettings = OWN_ADDRESS
    python: str = "python3"
    arch: str = "x86_64"
    ros: str = ""
    gateway: IpAddress | None = None
    links: tuple[ComputerLink, ...] = ()
    collector: bool = False
    collector_key: str = ""


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot, or the operator's base station (`is_base`): the udp_mesh peer `name`.

    `fielded` is the address of a robot that still runs the legacy udp_mesh, which meshctl does not manage. `lan` is the
    subnet of the robot's own LAN, which its radios route; None: they bridge the mesh to its switch. `computers` are the
    others on its switch by name, which run no daemon. Its daemon passes datagrams on for the robots in `relay`.
    """

    name: str
    nodes: tuple[str, ...]
    computer: Computer | None = None
    is_base: bool = False
    carries: tuple[str, ...] = ()
    fielded: IPv4Address | None = None
    lan: IpNetwork | None = None
    computers: Mapping[str, Computer] = field(default_factory=lambda: MappingProxyType({}))
    position: FixedPosition | None = None
    relay: tuple[str, ...] = ()
    thin: ThinPorts | None = None

    @property
    def other_addresses(self) -> tuple[str, ...]:
        """The addresses of its computers without a daemon."""
        return tuple(str(computer.address.ip) for computer in self.computers.values())

    def all_computers(self) -> Iterator[tuple[tuple[str, ...], str, Computer]]:
        """All its computers, the daemon's first: the path below the robot, what it is, and its settings."""
        if self.computer is not None:
            yield ("computer",), f"the computer of {self.name}", self.computer
        for name, computer in self.computers.items():
            yield ("computers", name), f"{name} of {self.name}", computer


@dataclass(frozen=True, slots=True)
class Operators:
    """Login to the nodes: public keys for root, and whether passwords are allowed."""

    ssh_keys: tuple[str, ...] = ()
    password_login: bool = False
    known_hosts: str = "known_hosts"


@dataclass(frozen=True, slots=True)
class SystemSettings:
    """OpenWrt system settings of all nodes."""

    timezone: str = "UTC"
    zonename: str = "UTC"
    log_size_kib: int = 64
    log_host: str = ""
    log_port: int = 514
    ntp_servers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ApplyPolicy:
    """Rollout policy of changes: nodes down at the same time, canary, when to stop."""

    max_down: int = 1
    canary: bool = True
    stop_after_failures: int = 1
    quorum: float = 0.8
    # None: as many as the meshes and this machine carry
    parallel: int | None = None


@dataclass(frozen=True, slots=True)
class UdpMesh:
    """Transport settings of all robots; `keys` are the live fleet keys, of which the first encrypts. `relay_hops` is
    the greatest number of links between two robots with relays between them, `relay_keys` those of the hops. With
    `selective`, robots send each other only what programs there read."""

    port: int = 8700
    keys: tuple[SecretRef, ...] = ()
    heartbeat_s: float = 1.0
    offline_after_s: float = 10.0
    fragment_bytes: int = 1400
    window: int | None = None
    broadcast: bool = True
    metrics_port: int | None = None
    relay_hops: int = 4
    relay_keys: tuple[SecretRef, ...] = ()
    thin_links: Mapping[str, ThinLink] = field(default_factory=lambda: MappingProxyType({}))
    thin_presence_s: float = 45.0
    etc_hosts: bool = False
    selective: bool = True


@dataclass(frozen=True, slots=True)
class Fleet:
    """A whole inventory. Mappings are read-only and in the inventory's order."""

    name: str
    country: str
    meshes: Mapping[str, Mesh]
    hardware: Mapping[str, HardwareProfile]
    nodes: Mapping[str, Node]
    robots: Mapping[str, Robot]
    topics: tuple[Topic, ...]
    udp_mesh: UdpMesh
    operators: Operators
    system: SystemSettings
    apply: ApplyPolicy
    provenance: Mapping[tuple[str, ...], Origin]
    files: tuple[str, ...] = ()
    base: str = ""
    sites: Mapping[str, Site] = field(default_factory=lambda: MappingProxyType({}))
    nats: NatsHub | None = None

    def where(self, *path: str) -> Origin:
        """The origin of a value, or of its innermost container that has one.

        `path` is the dotted path in parts: `("nodes", "b03", "radios", "radio0", "tx_power_dbm")`. Raises
        MissingOrigin if even its first part is unknown.
        """
        for end in range(len(path), 0, -1):
            origin = self.provenance.get(path[:end])
            if origin is not None:
                return origin
        raise MissingOrigin(".".join(path))

    @property
    def base_node(self) -> Node | None:
        """The operator's radio: the first managed node with the role BASE."""
        return next((node for node in self.managed() if node.role is Role.BASE), None)

    @property
    def base_nodes(self) -> tuple[Node, ...]:
        """The base node, and the first managed node with the role BASE of each other site."""
        first: dict[str, Node] = {}
        for node in self.managed():
            if node.role is Role.BASE:
                first.setdefault(node.site, node)
        return tuple(first.values())

    def base_of(self, node: Node) -> Node | None:
        """The base node of its site; of a site without one, that of the fleet."""
        return next((base for base in self.base_nodes if base.site == node.site), self.base_node)

    def bases_of(self, names: Iterable[str]) -> dict[str, Node]:
        """The bases of these nodes, each once, by name."""
        by_site = {base.site: base for base in self.base_nodes}
        found = (by_site.get(self.nodes[name].site, self.base_node) for name in names if name in self.nodes)
        return {base.name: base for base in found if base is not None}

    def rack(self, robot: str) -> frozenset[str]:
        """The nodes on board of a robot: those that it carries, without the deployed ones."""
        carried = (self.nodes[name] for name in self.robots[robot].carries if name in self.nodes)
        return frozenset(node.name for node in carried if node.state is NodeState.CARRIED)

    def moving_with(self, name: str) -> frozenset[str]:
        """The nodes that move with a carried one: the radios of its robot, and that robot's rack. Empty for others."""
        carriers = (robot for robot in self.robots.values() if name in robot.carries and name in self.rack(robot.name))
        return frozenset(other for robot in carriers for other in (*robot.nodes, *self.rack(robot.name)))

    def managed(self) -> Iterator[Node]:
        """The nodes that are neither lost nor retired, in order."""
        return (node for node in self.nodes.values() if node.state.is_managed)

    def router(self, robot: Robot) -> Node | None:
        """The radio that routes the robot's LAN: its first managed one with an address there."""
        nodes = (self.nodes.get(name) for name in robot.nodes)
        return next((node for node in nodes if node and node.state.is_managed and node.lan_address), None)

    def worker_site(self, node: Node) -> Site | None:
        """The site whose worker provisions the node; None if the operator does."""
        site = self.sites.get(node.site)
        return site if site is not None and site.has_worker else None

    def gateway_site(self, node: Node) -> Site | None:
        """The site through whose gateway the node is reached; None without one."""
        site = self.sites.get(node.site)
        return site if site is not None and site.has_gateway else None

    def robot_site(self, robot: Robot) -> Site | None:
        """The site with a gateway where the robot's radios are; None without one."""
        radios = (self.nodes.get(name) for name in robot.nodes)
        return next((site for node in radios if node is not None and (site := self.gateway_site(node))), None)

    def members(self, mesh: str) -> Iterator[Node]:
        """The managed nodes with at least one radio in `mesh`."""
        return (node for node in self.managed() if mesh in node.meshes)
