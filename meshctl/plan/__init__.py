"""Plans: desired state x observation -> what changes on which node, in which order, and what it interrupts. Pure.

`node_plan` compares one node's rendered files with its observation, `fleet_plan` orders the nodes by the observed mesh,
`saved` writes the plan to JSON and reads it back. A plan contains no secret.
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
