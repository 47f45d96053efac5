"""The fleet as it is: what everybody tells, how old that is, what is wrong, and whether the run may begin.

`look` asks radios and robots -> `assess` (radios) with `robots` (robots) -> `FleetStatus` with its alarms -> `text` (by
`rows` and `table`), `document` (JSON) or `preflight`; `memory` keeps what was told, `filters` chooses what is shown.
"""

from meshctl.status.assess import assess
from meshctl.status.preflight import Check, preflight
from meshctl.status.values import Alarm, FleetStatus, Health, Level, Neighbor, NodeStatus, RobotStatus

__all__ = [
    "Alarm",
    "Check",
    "FleetStatus",
    "Health",
    "Level",
    "Neighbor",
    "NodeStatus",
    "RobotStatus",
    "assess",
    "preflight",
]
