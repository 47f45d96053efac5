"""Select the radios and robots of a status to show: by name, group, robot, role, state or alarm.

Values of one kind are alternatives; different kinds must all match. Devices that are not shown are usually still
queried, since hop counts and "heard by" come from them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

from meshctl.errors import InputError
from meshctl.inventory.suggest import did_you_mean
from meshctl.model import Fleet, Node, NodeState, Role
from meshctl.status.alarm_codes import CODES
from meshctl.status.robots import robot_state
from meshctl.status.rows import COMPUTER
from meshctl.status.values import Alarm, FleetStatus, Level

ROLES = (*(role.value for role in Role), COMPUTER)
STATES = tuple(state.value for state in NodeState if state.is_managed)
ANY_ALARM = "any"
MAX_HINT_NAMES = 12


@dataclass(frozen=True, slots=True)
class Filter:
    """Empty matches all. `names` match radios and robots; `alarms` are codes, levels or `any` (error, warning)."""

    names: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    roles: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    alarms: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        return self == Filter()

    def check(self, fleet: Fleet) -> None:
        """Raises InputError for a value that can match nothing in this fleet."""
        names = [*(node.name for node in fleet.managed()), *fleet.robots]
        _require_match("node or robot", self.names, names, fleet.name)
        _require_match(
            "group", self.groups, {group for node in fleet.nodes.values() for group in node.groups}, fleet.name
        )
        _require_match("robot", self.robots, fleet.robots, fleet.name)
        _require_match("role", self.roles, ROLES, "a status")
        _require_match("state", self.states, STATES, "a status")
        _require_match("alarm", self.alarms, (*CODES, *(level.text for level in Level), ANY_ALARM), "a status")

    def matches_node(self, node: Node) -> bool:
        return (
            _matches(node.name, self.names)
            and (not self.groups or any(_matches(group, self.groups) for group in node.groups))
            and _matches(node.robot, self.robots)
            and (not self.roles or node.role.value in self.roles)
            and (not self.states or node.state.value in self.states)
        )

    def matches_robot(self, fleet: Fleet, name: str) -> bool:
        """A robot has the groups and the state of its radios."""
        robot = fleet.robots[name]
        groups = {group for node in robot.nodes if node in fleet.nodes for group in fleet.nodes[node].groups}
        state = robot_state(fleet, robot)
        return (
            _matches(name, self.names)
            and (not self.groups or any(_matches(group, self.groups) for group in groups))
            and _matches(name, self.robots)
            and (not self.roles or COMPUTER in self.roles)
            and (not self.states or (state is not None and state.value in self.states))
        )

    def apply(self, fleet: Fleet, status: FleetStatus) -> FleetStatus:
        """The status of the matching devices; a filter drops the alarms of the whole fleet."""
        if self.is_empty:
            return status
        return replace(
            status,
            nodes=tuple(one for one in status.nodes if self.matches_node(one.node) and self._has_alarm(one.alarms)),
            robots=tuple(
                one for one in status.robots if self.matches_robot(fleet, one.name) and self._has_alarm(one.alarms)
            ),
            alarms=(),
            strangers=(),
        )

    def _has_alarm(self, alarms: Iterable[Alarm]) -> bool:
        if not self.alarms:
            return True
        wanted = set(self.alarms)
        return any(
            alarm.code in wanted or alarm.level.text in wanted or (ANY_ALARM in wanted and alarm.level > Level.NOTE)
            for alarm in alarms
        )


def _matches(name: str, patterns: tuple[str, ...]) -> bool:
    return not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)


def _require_match(what: str, patterns: tuple[str, ...], names: Iterable[str], where: str) -> None:
    listed = list(names)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in listed):
            hint = did_you_mean(pattern, listed) or f"expected one of {', '.join(listed[:MAX_HINT_NAMES])}"
            raise InputError(f"no {what} of {where} matches {pattern!r}", hint=hint)
