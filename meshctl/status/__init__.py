"""The fleet as it is: what every node tells, how old that is, what is wrong, and whether the run may begin.

observations + plan + journal -> `assess` -> `FleetStatus` (with `alarms`) -> `text` | `json` | `preflight`.
"""

from meshctl.status.assess import assess
from meshctl.status.preflight import Check, preflight
from meshctl.status.values import Alarm, FleetStatus, Health, Level, Neighbour, NodeStatus

__all__ = [
    "Alarm",
    "Check",
    "FleetStatus",
    "Health",
    "Level",
    "Neighbour",
    "NodeStatus",
    "assess",
    "preflight",
]
