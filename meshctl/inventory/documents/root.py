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
from meshctl.inventory.documents.site import NatsHubDocument, SiteDocument
from meshctl.inventory.fields import Country, Name, Text, Version, empty_mapping

_Entry = TypeVar("_Entry")

# A key without a value is an empty mapping: `b03:` is a node with all values from other layers.
OrEmpty = Annotated[_Entry, BeforeValidator(empty_mapping)]
Section = OrEmpty[dict[Name, _Entry]]
NodeSection = OrEmpty[dict[Text, OrEmpty[NodeDocument]]]
TopicSection = OrEmpty[dict[Text, TopicDocument]]


class InventoryDocument(Document):
    """A fleet: hardware, meshes, nodes, robots and topics."""

    meshctl: Version
    """Format version: 1."""
    fleet: Name
    """Name of the fleet."""
    country: Country
    """Country of the regulatory rules: two capital letters."""
    include: tuple[Text, ...] = ()
    """Additional files of the inventory; relative to this file."""
    operators: OperatorsDocument = Field(default_factory=OperatorsDocument)
    """Login to the radios."""
    system: SystemDocument = Field(default_factory=SystemDocument)
    """OpenWrt system settings."""
    apply: ApplyDocument = Field(default_factory=ApplyDocument)
    """Rollout policy of changes."""
    hardware: Section[HardwareDocument] = Field(default_factory=dict)
    """Hardware profiles by name."""
    meshes: Section[MeshDocument] = Field(default_factory=dict)
    """Meshes by name."""
    defaults: OrEmpty[NodeLayer] = Field(default_factory=NodeLayer)
    """Default values of all nodes."""
    groups: Section[OrEmpty[GroupDocument]] = Field(default_factory=dict)
    """Groups of nodes by name."""
    nodes: NodeSection = Field(default_factory=dict)
    """Nodes by name; `b[01-12]` expands to twelve."""
    sites: Section[OrEmpty[SiteDocument]] = Field(default_factory=dict)
    """Sites by name, each with a worker for its nodes."""
    nats: NatsHubDocument | None = None
    """The NATS server that stores orders for sites."""
    robots: Section[OrEmpty[RobotDocument]] = Field(default_factory=dict)
    """Robots by name."""
    udp_mesh: UdpMeshDocument = Field(default_factory=UdpMeshDocument)
    """Transport settings."""
    topics: TopicSection = Field(default_factory=dict)
    """Topics by name."""
