"""Select the radios and robots to show or check: one selection (`inventory.selection`) over both kinds of device.

`select_devices` decides which; `Filter` is the decision, and also selects by alarm. Devices that are not shown are
usually still queried, since hop counts and "heard by" come from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from meshctl.errors import InputError
from meshctl.inventory.selection import COMPUTER, LIST_HINT, attributes_of, robot_attributes, select, unmanaged_states
from meshctl.model import Fleet, NodeState, Role
from meshctl.status.alarm_codes import CODES
from meshctl.status.values import Alarm, FleetStatus, Level, stranger_alarm
from meshctl.suggest import did_you_mean
from meshctl.wording import join_limited

ROLES = (*(role.value for role in Role), COMPUTER)
STATES = tuple(state.value for state in NodeState if state.is_managed)
ANY_ALARM = "any"
MAX_HINT_NAMES = 12


class _Kind(Enum):
    RADIO = "radio"
    ROBOT = "robot"


@dataclass(frozen=True, slots=True)
class Filter:
    """The selected radios and robots by name, None for all; `alarms` are codes, levels or `any` (error, warning)."""

    nodes: frozenset[str] | None = None
    robots: frozenset[str] | None = None
    alarms: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        return self == Filter()

    def selects_node(self, name: str) -> bool:
        return self.nodes is None or name in self.nodes

    def selects_robot(self, name: str) -> bool:
        return self.robots is None or name in self.robots

    def devices_of(self, status: FleetStatus) -> FleetStatus:
        """The status with the selected devices alone."""
        return replace(
            status,
            nodes=tuple(node for node in status.nodes if self.selects_node(node.name) and self._has_alarm(node.alarms)),
            robots=tuple(
                robot for robot in status.robots if self.selects_robot(robot.name) and self._has_alarm(robot.alarms)
            ),
        )

    def apply(self, status: FleetStatus) -> FleetStatus:
        """The status of the selected devices. Of the fleet's alarms, a selection keeps those about a selected node, and
        that selected robots were not queried."""
        if self.is_empty:
            return status
        kept = tuple(alarm for alarm in status.alarms if self._concerns(alarm) and self._has_alarm((alarm,)))
        strangers = status.strangers if self.nodes is None and self._has_alarm((stranger_alarm(status),)) else ()
        return replace(self.devices_of(status), alarms=kept, strangers=strangers)

    def _concerns(self, alarm: Alarm) -> bool:
        if self.nodes is None:
            return True
        if alarm.code == "robots-unasked":
            return bool(self.robots)
        return not self.nodes.isdisjoint(alarm.nodes)

    def _has_alarm(self, alarms: Iterable[Alarm]) -> bool:
        if not self.alarms:
            return True
        wanted = set(self.alarms)
        return any(
            alarm.code in wanted or alarm.level.text in wanted or (ANY_ALARM in wanted and alarm.level > Level.NOTE)
            for alarm in alarms
        )


def select_devices(
    fleet: Fleet,
    words: Iterable[str],
    read_file: Callable[[str], str],
    limits: Iterable[str] = (),
    attributes: Mapping[str, Sequence[str]] | None = None,
    alarms: Iterable[str] = (),
) -> Filter:
    """The radios and robots that the words and every limit select, and that have each of the `attributes`.

    Values of one attribute are alternatives. Raises InputError for a value that can match nothing in this fleet.
    """
    wanted = tuple(alarms)
    known = (*CODES, *(level.text for level in Level), ANY_ALARM)
    for alarm in wanted:
        if alarm not in known:
            hint = did_you_mean(alarm, known) or f"expected one of {join_limited(known, MAX_HINT_NAMES)}"
            raise InputError(f"no alarm of a status is called {alarm!r}", hint=hint)
    named = (tuple(f"{key}:{value}" for value in values) for key, values in (attributes or {}).items() if values)
    restrictions = [tuple(words), *((limit,) for limit in limits), *named]
    if not any(restrictions):
        return Filter(alarms=wanted)
    radios = {(_Kind.RADIO, node.name): attributes_of(node) for node in fleet.managed()}
    computers = {(_Kind.ROBOT, name): robot_attributes(fleet, robot) for name, robot in fleet.robots.items()}
    chosen = select(
        restrictions[0],
        {**radios, **computers},
        read_file,
        [",".join(restriction) for restriction in restrictions[1:]],
        what=f"node or robot of {fleet.name}",
        hint=LIST_HINT,
        unmanaged=unmanaged_states(fleet),
        name_of=lambda device: device[1],
    )
    return Filter(
        frozenset(name for kind, name in chosen if kind is _Kind.RADIO),
        frozenset(name for kind, name in chosen if kind is _Kind.ROBOT),
        wanted,
    )
