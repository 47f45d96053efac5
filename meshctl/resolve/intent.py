"""The desired configuration of one node, complete and frozen: everything that templates need."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from meshctl.diagnostics import Position
from meshctl.model import (
    Backend,
    Band,
    Batman,
    Encryption,
    MeshMode,
    OperatorParts,
    Release,
    Role,
    Secret,
    SystemSettings,
)
from meshctl.model.ip import IpAddress, IpInterface
from meshctl.resolve.routes import StaticRoute

# UCI interfaces: the wired ports, and a router's interface on the mesh
LAN = "lan"
BACKBONE = "backbone"


@dataclass(frozen=True, slots=True)
class MeshInterface:
    """A radio's interface in a mesh. `name` is its section, device and ifname; `master` is its batman-adv interface,
    empty with another back end; `key` is set exactly if the mesh is encrypted."""

    name: str
    mesh: str
    mode: MeshMode
    ssid: str
    bssid: str
    mcast_rate_kbps: int
    encryption: Encryption
    key: Secret | None
    mtu: int
    master: str
    # only BATMAN_V has the ELP interval
    elp_interval_ms: int | None


@dataclass(frozen=True, slots=True)
class RadioIntent:
    """A radio; `interface` and `channel` are None if it is off."""

    name: str
    path: str
    band: Band
    country: str
    channel: int | None
    htmode: str
    tx_power_dbm: int
    distance_m: int
    beacon_interval_tu: int
    interface: MeshInterface | None

    @property
    def hwmode(self) -> str:
        """The band's name in 19.07."""
        return "11g" if self.band is Band.G2 else "11a"


@dataclass(frozen=True, slots=True)
class BatmanInterface:
    """A batman-adv interface (`bat0`) with its options, and the originator interval for the reconnect target."""

    name: str
    mesh: str
    options: Batman
    orig_interval_ms: int


@dataclass(frozen=True, slots=True)
class Lan:
    """The bridge of the node's wired ports and its mesh, with the management address; without the mesh, and with the
    address in the robot's own LAN, if the node is a router (`Intent.backbone`). `switch_vlans` are the VLANs of
    `switch0` and their ports, empty without swconfig or if only the device has them."""

    bridge: str
    ports: tuple[str, ...]
    address: IpInterface
    gateway: IpAddress | None
    mtu: int
    switch_vlans: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Backbone:
    """A router's interface on the mesh: the batman-adv interface `device`, with the management address."""

    device: str
    address: IpInterface
    gateway: IpAddress | None
    mtu: int

    @property
    def mac(self) -> str:
        """A locally administered MAC address for `device`, from the management address: unique and constant."""
        packed = self.address.ip.packed
        # an IPv6 address has more bits than fit, and fleets differ in which of them they count with
        own = packed if len(packed) == 4 else hashlib.sha256(packed).digest()[:4]
        return ":".join(f"{byte:02x}" for byte in (0x02, 0xBA, *own))


@dataclass(frozen=True, slots=True)
class LanFilterIntent:
    """The filter of group-addressed frames that leave the bridge at `port`, its port into the mesh; UDP to `udp_ports`
    passes."""

    port: str
    udp_ports: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Login:
    """SSH login to the node. `keys` are the operators'; those in `collectors` may only ask for the node's links."""

    port: int
    is_password_allowed: bool
    keys: tuple[str, ...]
    collectors: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Intent:
    """One node, defined at `position`. `backbone` is None on a node that bridges mesh and LAN. `extra_uci` are options
    by their full names (`wireless.radio0.rts`), applied after the templates; `extra_positions` are their positions."""

    fleet: str
    node: str
    hostname: str
    label: str
    role: Role
    release: Release
    board: str
    radios: tuple[RadioIntent, ...]
    batman: tuple[BatmanInterface, ...]
    lan: Lan
    login: Login
    system: SystemSettings
    backend: Backend
    operator_parts: OperatorParts
    packages: tuple[str, ...]
    removed_packages: tuple[str, ...]
    position: Position
    extra_uci: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    extra_positions: Mapping[str, Position] = field(default_factory=lambda: MappingProxyType({}))
    backbone: Backbone | None = None
    routes: tuple[StaticRoute, ...] = ()
    lan_filter: LanFilterIntent | None = None

    @property
    def management_network(self) -> str:
        """The UCI interface with the management address, over which the mesh is reached."""
        return BACKBONE if self.backbone is not None else LAN

    @property
    def interfaces(self) -> tuple[MeshInterface, ...]:
        """The mesh interfaces of all radios, in order."""
        return tuple(radio.interface for radio in self.radios if radio.interface is not None)

    @property
    def secrets(self) -> tuple[Secret, ...]:
        """Every secret that a file of this node may contain."""
        return tuple(dict.fromkeys(interface.key for interface in self.interfaces if interface.key is not None))
