"""The whole document."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import BeforeValidator, Field

from meshctl.inventory.documents.base import Document
from meshctl.inventory.documents.node import GroupDocument, NodeDocument, NodeLayer
from meshctl.inventory.documents.radio import HardwareDocument, MeshDocument
from meshctl.inventory.documents.robot import (
    ApplyDocument,
    OperatorsDocument,
    RobotDocument,
    SystemDocument,
    TopicDocument,
    UdpMeshDocument,
)
from meshctl.inventory.fields import Country, Name, Text, Version, empty_mapping

_Entry = TypeVar("_Entry")

# Nothing written under a key means an empty mapping: `b03:` is a node with all its values from elsewhere.
OrEmpty = Annotated[_Entry, BeforeValidator(empty_mapping)]
Section = OrEmpty[dict[Name, _Entry]]
NodeSection = OrEmpty[dict[Text, OrEmpty[NodeDocument]]]
TopicSection = OrEmpty[dict[Text, TopicDocument]]


class InventoryDocument(Document):
    """A fleet: what it is made of, who is in it, what it says."""

    meshctl: Version
    """Version of this format: 1."""
    fleet: Name
    """Name of the fleet."""
    country: Country
    """Country whose radio rules hold: two capital letters."""
    include: tuple[Text, ...] = ()
    """Further files with parts of the inventory; relative to this file."""
    operators: OperatorsDocument = OperatorsDocument()
    """Who may log in."""
    system: SystemDocument = SystemDocument()
    """OpenWrt's system settings."""
    apply: ApplyDocument = ApplyDocument()
    """How carefully the fleet is changed."""
    hardware: Section[HardwareDocument] = Field(default_factory=dict)
    """Hardware profiles by name."""
    meshes: Section[MeshDocument] = Field(default_factory=dict)
    """Meshes by name."""
    defaults: OrEmpty[NodeLayer] = NodeLayer()
    """What holds for every node that does not say otherwise."""
    groups: Section[OrEmpty[GroupDocument]] = Field(default_factory=dict)
    """Groups of nodes by name."""
    nodes: NodeSection = Field(default_factory=dict)
    """Nodes by name; `b[01-12]` stands for twelve."""
    robots: Section[OrEmpty[RobotDocument]] = Field(default_factory=dict)
    """Robots by name."""
    udp_mesh: UdpMeshDocument = UdpMeshDocument()
    """The transport's settings."""
    topics: TopicSection = Field(default_factory=dict)
    """Topics by name."""
