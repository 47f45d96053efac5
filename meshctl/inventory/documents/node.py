"""Layers of nodes: defaults, groups, ranges and nodes have the same keys; see `layers` for precedence."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from meshctl.inventory.addresses import AddressField
from meshctl.inventory.documents.base import NOT_WRITTEN, Document
from meshctl.inventory.fields import Address, Line, Mac, Name, Port, Real, ReleaseName, Text, Whole
from meshctl.model import NodeState, Role


class RadioLayer(Document):
    """Settings of one radio of a node."""

    mesh: Name | None = None
    """The mesh to join; null turns the radio off. Default: the fleet's only mesh of the radio's band."""
    tx_power_dbm: Whole = Field(default=NOT_WRITTEN, ge=0, le=40)
    """Drive level for UCI in dBm. Default: the driver's maximum."""
    mac: Mac = ""
    """MAC address, as read from the device."""


class SshLayer(Document):
    """SSH login. Keys are in files, never in the inventory."""

    host: Text = ""
    """Host to connect to. Default: the device's own address."""
    port: Whole = Field(default=22, ge=1, le=65_535)
    """TCP port."""
    user: Text = NOT_WRITTEN
    """User. Default: root on radios, the operator's user name on computers."""
    key_files: tuple[Text, ...] = ()
    """Private key files to try; relative to this file. Default: the SSH agent and the usual files."""
    jump: Text = ""
    """Node to use as a jump host."""


class LanFilterLayer(Document):
    """Which broadcasts and multicasts of the wired ports reach the mesh: ARP, IPv6 neighbor and group discovery, IGMP,
    DHCP and udp_mesh always do; all others are dropped."""

    udp_ports: tuple[Annotated[Whole, Field(ge=1, le=65_535)], ...] = ()
    """Destination ports that pass, too, such as 5353 (mDNS) or 7400 (ROS 2 discovery in domain 0)."""


class PositionDocument(Document):
    """Where a device stands for the whole mission, in meters in the frame of the fleet's map."""

    # beyond 1000 km it is another unit, or degrees of another map
    x_m: Real = Field(ge=-1e6, le=1e6)
    """x in meters."""
    y_m: Real = Field(ge=-1e6, le=1e6)
    """y in meters."""
    z_m: Real = Field(default=NOT_WRITTEN, ge=-12_000, le=50_000)
    """Height in meters. Default: unknown."""


class NodeLayer(Document):
    """Settings of a node in `defaults`, in a group, in a range or in its own entry, by increasing precedence."""

    hardware: Name = NOT_WRITTEN
    """Hardware profile. Required for every node."""
    address: AddressField = NOT_WRITTEN
    """Management address: `10.42.0.11`, or a rule for all nodes that share it: `{from: 10.42.0.101}` counts up from
    there, `{rule: network + 100 + index}` is a formula. Required for every node."""
    role: Role = Role.BEACON
    """base: the operator's radio. robot: mounted on a robot. beacon: dropped by a robot."""
    state: NodeState = NodeState.DEPLOYED
    """carried: in its rack, may be off. deployed: must answer. spare: in storage. lost, retired: not managed."""
    radios: dict[Name, RadioLayer] = Field(default_factory=dict)
    """Radios by their names in the hardware profile."""
    hostname: Name = NOT_WRITTEN
    """Hostname. Default: the node's name."""
    release: ReleaseName = NOT_WRITTEN
    """OpenWrt release series. Default: the hardware profile's."""
    lan_ports: tuple[Port, ...] = NOT_WRITTEN
    """Ports bridged into the LAN. Default: the hardware profile's."""
    lan_filter: LanFilterLayer | None = NOT_WRITTEN
    """Keep the broadcasts of devices on its wired ports, such as a lidar, out of the mesh: `{}`, or with exceptions.
    Default: none; null removes that of an outer layer."""
    ssh: SshLayer = Field(default_factory=SshLayer)
    """SSH login."""
    robot: Name = NOT_WRITTEN
    """The robot that carries the node. Default: the robot that lists it."""
    site: Name = NOT_WRITTEN
    """The site where the node is. Default: none."""
    label: Line = Field(default="", min_length=1)
    """Label on the device."""
    serial: Line = Field(default="", min_length=1)
    """Serial number of the device."""
    mac: Mac = ""
    """MAC address of the device, as on its label."""
    host_keys: tuple[Text, ...] = ()
    """SSH host keys, such as `ssh-ed25519 AAAA...`; written by `meshctl trust`."""
    confirm_window_s: Whole = Field(default=NOT_WRITTEN, ge=10, le=3600)
    """Seconds to wait for confirmation of a change. Default: the hardware profile's."""
    packages: tuple[Text, ...] = ()
    """Packages in addition to the hardware profile's."""
    extra_uci: dict[Text, Text] = Field(default_factory=dict)
    """Additional UCI options by their full names: `wireless.radio0.rts: "500"`."""
    gateway: Address | None = NOT_WRITTEN
    """Default gateway; null removes that of an outer layer."""
    position: PositionDocument = NOT_WRITTEN
    """Where it stands, if it does not move."""


class NodeDocument(NodeLayer):
    """A node, or a range of them."""

    groups: tuple[Name, ...] = ()
    """Groups; a later one overrides an earlier one."""


class GroupDocument(NodeLayer):
    """A named layer shared by nodes."""

    inherits: tuple[Name, ...] = ()
    """Groups to inherit values from; a later one overrides an earlier one."""
