"""The inventory's format: one model per mapping; unknown keys are errors; docstrings are the keys' descriptions.

The models hold one mapping as written; ranges, groups and references are resolved afterwards.
"""

from meshctl.inventory.documents.base import NOT_WRITTEN, Document, SecretDocument
from meshctl.inventory.documents.node import (
    GroupDocument,
    LanFilterLayer,
    NodeDocument,
    NodeLayer,
    PositionDocument,
    RadioLayer,
    SshLayer,
)
from meshctl.inventory.documents.radio import (
    BatmanDocument,
    FirmwareDocument,
    HardwareDocument,
    MeshDocument,
    OperatorPartsDocument,
    RadioHardwareDocument,
)
from meshctl.inventory.documents.robot import (
    ApplyDocument,
    ComputerDocument,
    LanDocument,
    OperatorsDocument,
    OtherComputerDocument,
    ReductionDocument,
    RobotDocument,
    SystemDocument,
    TopicDocument,
    TopicLogDocument,
    UdpMeshDocument,
)
from meshctl.inventory.documents.root import InventoryDocument
from meshctl.inventory.documents.site import NatsHubDocument, SiteDocument

__all__ = [
    "NOT_WRITTEN",
    "ApplyDocument",
    "BatmanDocument",
    "ComputerDocument",
    "Document",
    "FirmwareDocument",
    "GroupDocument",
    "HardwareDocument",
    "InventoryDocument",
    "LanDocument",
    "LanFilterLayer",
    "MeshDocument",
    "NatsHubDocument",
    "NodeDocument",
    "NodeLayer",
    "OperatorPartsDocument",
    "OperatorsDocument",
    "OtherComputerDocument",
    "PositionDocument",
    "RadioHardwareDocument",
    "RadioLayer",
    "ReductionDocument",
    "RobotDocument",
    "SecretDocument",
    "SiteDocument",
    "SshLayer",
    "SystemDocument",
    "TopicDocument",
    "TopicLogDocument",
    "UdpMeshDocument",
]
