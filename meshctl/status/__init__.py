"""The state of the fleet: observations, their age, alarms, and the go/no-go checks before a mission.

`collect` queries radios and robots -> `Snapshot` -> `assess` (radios) and `robots` -> `FleetStatus` with alarms ->
`filters` -> `text` (by `rows` and `table`), `json_output` or `preflight`. `last_known` records facts in the journal.
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
