"""Go or no-go: the questions a team asks before robots drive off, each answered with its reason."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from meshctl.model import Fleet, NodeState, Role
from meshctl.status.alarms import WEAK_QUALITY
from meshctl.status.values import FleetStatus, Health, NodeStatus


@dataclass(frozen=True, slots=True)
class Check:
    """One line: what was asked, whether it is a go, and why."""

    name: str
    is_go: bool
    reason: str


def preflight(fleet: Fleet, status: FleetStatus) -> tuple[Check, ...]:
    """Every check, in the order in which a team would mend what is wrong."""
    return tuple(check(fleet, status) for check in _CHECKS)


def _listed(nodes: Iterable[NodeStatus], tell: Callable[[NodeStatus], str] = lambda node: node.name) -> str:
    return "; ".join(tell(node) for node in nodes)


def _with_alarm(status: FleetStatus, *codes: str) -> list[NodeStatus]:
    return [node for node in status.nodes if any(alarm.code in codes for alarm in node.alarms)]


def _alarm_check(name: str, good: str, *codes: str) -> Callable[[Fleet, FleetStatus], Check]:
    """A check that no node has one of these alarms."""

    def check(fleet: Fleet, status: FleetStatus) -> Check:
        bad = _with_alarm(status, *codes)

        def tell(node: NodeStatus) -> str:
            return f"{node.name}: " + ", ".join(alarm.text for alarm in node.alarms if alarm.code in codes)

        return Check(name, not bad, _listed(bad, tell) if bad else good)

    return check


def _base_answers(fleet: Fleet, status: FleetStatus) -> Check:
    base = fleet.base_node
    if base is None:
        return Check("base", False, "the inventory has no base")
    found = next((node for node in status.nodes if node.name == base.name), None)
    answers = found is not None and found.health in (Health.OK, Health.DEGRADED)
    return Check("base", answers, f"{base.name} {'answers' if answers else 'does not answer'}")


def _robots_answer(fleet: Fleet, status: FleetStatus) -> Check:
    """Robot radios must answer whatever their state says: they are about to drive."""
    radios = [node for node in status.nodes if node.node.role is Role.ROBOT and node.node.state is not NodeState.SPARE]
    missing = [node for node in radios if node.health in (Health.UNREACHABLE, Health.OFF)]
    good = f"{len(radios)} robot radio{'s' if len(radios) != 1 else ''} answer"
    return Check("robots", not missing, _listed(missing, _silence) if missing else good)


def _beacons_answer(fleet: Fleet, status: FleetStatus) -> Check:
    """Those in a rack must have been seen once, those deployed must answer now."""
    beacons = [
        node
        for node in status.nodes
        if node.node.role is Role.BEACON and node.node.state in (NodeState.CARRIED, NodeState.DEPLOYED)
    ]
    unknown = [node for node in beacons if node.age_s is None]
    missed = [node for node in beacons if node.health is Health.UNREACHABLE and node not in unknown]
    told = [f"never seen: {_listed(unknown)}"] if unknown else []
    told += [_listed(missed, _silence)] if missed else []
    good = f"{len(beacons)} beacon{'s' if len(beacons) != 1 else ''} known"
    return Check("beacons", not told, "; ".join(told) or good)


def _silence(node: NodeStatus) -> str:
    return f"{node.name}: {node.silent_because}"


def _quality(fleet: Fleet, status: FleetStatus) -> Check:
    weak = [node for node in status.nodes if node.quality is not None and node.hops and node.quality < WEAK_QUALITY]
    return Check(
        "links",
        not weak,
        _listed(weak, lambda node: f"{node.name}: {node.quality:.0%} to the base") if weak else "every path carries",
    )


def _strangers(fleet: Fleet, status: FleetStatus) -> Check:
    strangers = status.strangers
    return Check(
        "strangers", not strangers, f"in the mesh: {', '.join(strangers)}" if strangers else "nobody else heard"
    )


_CHECKS: Sequence[Callable[[Fleet, FleetStatus], Check]] = (
    _base_answers,
    _robots_answer,
    _beacons_answer,
    _alarm_check("identity", "every board is what the inventory says", "board"),
    _alarm_check("firmware", "firmware and packages as in the inventory", "firmware", "packages"),
    _alarm_check("configuration", "configuration as in the inventory", "drift", "foreign", "refused"),
    _alarm_check("changes", "no change is under way", "change"),
    _alarm_check("radios", "every radio is in its cell", "radio", "join", "alone"),
    _quality,
    _alarm_check("resources", "memory and flash suffice", "memory", "flash"),
    _strangers,
)
