"""The whole document."""

from __future__ import annotations

from typing import Annotated

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
    hardware: Annotated[dict[Name, HardwareDocument], BeforeValidator(empty_mapping)] = Field(default_factory=dict)
    """Hardware profiles by name."""
    meshes: Annotated[dict[Name, MeshDocument], BeforeValidator(empty_mapping)] = Field(default_factory=dict)
    """Meshes by name."""
    defaults: Annotated[NodeLayer, BeforeValidator(empty_mapping)] = NodeLayer()
    """What holds for every node that does not say otherwise."""
    groups: Annotated[
        dict[Name, Annotated[GroupDocument, BeforeValidator(empty_mapping)]], BeforeValidator(empty_mapping)
    ] = Field(default_factory=dict)
    """Groups of nodes by name."""
    nodes: Annotated[
        dict[Text, Annotated[NodeDocument, BeforeValidator(empty_mapping)]], BeforeValidator(empty_mapping)
    ] = Field(default_factory=dict)
    """Nodes by name; `b[01-12]` stands for twelve."""
    robots: Annotated[
        dict[Name, Annotated[RobotDocument, BeforeValidator(empty_mapping)]], BeforeValidator(empty_mapping)
    ] = Field(default_factory=dict)
    """Robots by name."""
    udp_mesh: UdpMeshDocument = UdpMeshDocument()
    """The transport's settings."""
    topics: Annotated[dict[Text, TopicDocument], BeforeValidator(empty_mapping)] = Field(default_factory=dict)
    """Topics by name."""
