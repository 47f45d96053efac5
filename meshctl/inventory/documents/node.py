"""Layers of nodes: defaults, groups, ranges and nodes say the same things, the nearest wins."""

from __future__ import annotations

from pydantic import Field

from meshctl.inventory.addresses import AddressField
from meshctl.inventory.documents.base import NOT_WRITTEN, Document
from meshctl.inventory.fields import Address, Mac, Name, ReleaseName, Text, Whole
from meshctl.model import NodeState, Role


class RadioLayer(Document):
    """What one node sets on one of its radios."""

    mesh: Name | None = None
    """The mesh it joins; null switches it off. Without it the fleet's only mesh of the radio's band."""
    tx_power_dbm: Whole = Field(default=NOT_WRITTEN, ge=0, le=40)
    """The drive level that UCI gets; without it the most the driver offers."""
    mac: Mac = ""
    """Its MAC address, read off the device."""


class SshLayer(Document):
    """How to log in. Keys live in files, never in the inventory."""

    host: Text = ""
    """Host to reach instead of the own address."""
    port: Whole = Field(default=22, ge=1, le=65_535)
    """TCP port."""
    user: Text = NOT_WRITTEN
    """User; root on radios, without it on computers the operator's own name."""
    key_files: tuple[Text, ...] = ()
    """Private key files to try; without it the SSH agent and the usual files."""
    jump: Text = ""
    """Another node to go through."""


class NodeLayer(Document):
    """What may be said of a node in `defaults`, in a group, in a range or at the node itself; the nearest wins."""

    hardware: Name = NOT_WRITTEN
    """Its hardware profile. Every node needs one."""
    address: AddressField = NOT_WRITTEN
    """Its management address: `10.42.0.11`, or a rule for all who share it: `{from: 10.42.0.101}` counts up from there,
    `{rule: network + 100 + index}` reckons. Every node needs one."""
    role: Role = Role.BEACON
    """base: the operator's radio. robot: rides on a robot. beacon: dropped behind one."""
    state: NodeState = NodeState.DEPLOYED
    """carried: in its rack, may be off. deployed: must answer. spare: in the box. lost and retired: left alone."""
    radios: dict[Name, RadioLayer] = Field(default_factory=dict)
    """Its radios by the names of the hardware profile."""
    hostname: Name = NOT_WRITTEN
    """Host name; without it the node's name."""
    release: ReleaseName = NOT_WRITTEN
    """OpenWrt's release series, where it differs from the hardware profile's."""
    lan_ports: tuple[Text, ...] = NOT_WRITTEN
    """Ports bridged into the LAN, where they differ from the hardware profile's."""
    ssh: SshLayer = SshLayer()
    """How to log in."""
    robot: Name = NOT_WRITTEN
    """The robot that carries it; without it the robot that lists it."""
    label: Text = ""
    """What is written on the box."""
    serial: Text = ""
    """Serial number of the box."""
    mac: Mac = ""
    """MAC address of the box, as on its sticker."""
    host_keys: tuple[Text, ...] = ()
    """Its SSH host keys, such as `ssh-ed25519 AAAA...`; written by `meshctl trust`."""
    confirm_window_s: Whole = Field(default=NOT_WRITTEN, ge=10, le=3600)
    """Seconds to wait for a confirmation, where it differs from the hardware profile's."""
    packages: tuple[Text, ...] = ()
    """Packages beyond the hardware profile's."""
    extra_uci: dict[Text, Text] = Field(default_factory=dict)
    """Further UCI options by their full names: `wireless.radio0.rts: "500"`."""
    gateway: Address = NOT_WRITTEN
    """Default gateway."""


class NodeDocument(NodeLayer):
    """A node, or a range of them."""

    groups: tuple[Name, ...] = ()
    """Its groups; a later one wins over an earlier one."""


class GroupDocument(NodeLayer):
    """A named layer that nodes share."""

    inherits: tuple[Name, ...] = ()
    """Groups whose values this one starts from; a later one wins over an earlier one."""
