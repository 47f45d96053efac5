"""What has to happen, to which node, in which order, and what is cut while it happens: intent x observation -> plan.

Pure: `node_plan` compares one node's rendered files with what was seen of it, `fleet_plan` puts the nodes in order by
the observed mesh, `saved` writes the plan to JSON and reads it back. Nothing here holds or prints a secret.
"""

from meshctl.plan.build import fleet_plan
from meshctl.plan.node import DesiredState, node_plan
from meshctl.plan.values import (
    Cut,
    Effect,
    FileChange,
    FirmwareStep,
    NodePlan,
    PackageStep,
    Plan,
    Stage,
    StageKind,
    Verdict,
)

__all__ = [
    "Cut",
    "DesiredState",
    "Effect",
    "FileChange",
    "FirmwareStep",
    "NodePlan",
    "PackageStep",
    "Plan",
    "Stage",
    "StageKind",
    "Verdict",
    "fleet_plan",
    "node_plan",
]
