"""The fleet as frozen values: the inventory with ranges, groups, defaults and addresses resolved.

Higher layers (lint, resolve, plan, status) use only these values, and `Fleet.where` for the file, line and column of a
value.
"""

from meshctl.model.fleet import (
    ApplyPolicy,
    Computer,
    ComputerLink,
    FixedPosition,
    Fleet,
    LanFilter,
    MissingOrigin,
    Node,
    NodeState,
    Operators,
    Origin,
    Radio,
    Robot,
    Role,
    SystemSettings,
    UdpMesh,
)
from meshctl.model.hardware import AntennaKind, Band, Firmware, HardwareProfile, RadioHardware
from meshctl.model.mesh import Backend, Batman, Encryption, Mesh, MeshMode, OperatorParts
from meshctl.model.release import RELEASES, PackageTool, Release
from meshctl.model.secret import MASK, Secret, SecretKind, SecretRef
from meshctl.model.site import NatsHub, Site, SiteNats, SshSettings
from meshctl.model.thin import ThinBand, ThinFraming, ThinLink, ThinPorts, ThinPreset
from meshctl.model.topic import JpegEncoding, Outbox, Reduction, Topic, TopicClass, TopicLog

__all__ = [
    "MASK",
    "RELEASES",
    "AntennaKind",
    "ApplyPolicy",
    "Backend",
    "Band",
    "Batman",
    "Computer",
    "ComputerLink",
    "Encryption",
    "Firmware",
    "FixedPosition",
    "Fleet",
    "HardwareProfile",
    "JpegEncoding",
    "LanFilter",
    "Mesh",
    "MeshMode",
    "MissingOrigin",
    "NatsHub",
    "Node",
    "NodeState",
    "OperatorParts",
    "Operators",
    "Origin",
    "Outbox",
    "PackageTool",
    "Radio",
    "RadioHardware",
    "Reduction",
    "Release",
    "Robot",
    "Role",
    "Secret",
    "SecretKind",
    "SecretRef",
    "Site",
    "SiteNats",
    "SshSettings",
    "SystemSettings",
    "ThinBand",
    "ThinFraming",
    "ThinLink",
    "ThinPorts",
    "ThinPreset",
    "Topic",
    "TopicClass",
    "TopicLog",
    "UdpMesh",
]
