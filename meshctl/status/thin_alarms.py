"""Alarms of a robot's thin links: ports, numbers, budgets, and robots that are reached only there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from meshctl.robots.facts import RobotFacts
from meshctl.status.values import Alarm, Level


def thin_alarms(facts: RobotFacts) -> Iterator[Alarm]:
    """Alarms from the status of its daemon; a daemon without thin links, or of an earlier version, has none."""
    thin = facts.status.get("thin")
    if not isinstance(thin, Mapping):
        return
    for name, reason in _items(thin.get("failures")):
        yield Alarm(Level.ERROR, "thin-link", f"thin link {name} is down: {reason}", "check the radio and its port")
    for name, reason in _items(thin.get("refusals")):
        text = f"the radio of thin link {name} refuses frames: {reason}"
        yield Alarm(Level.WARNING, "thin-link", text, "check the radio's settings, and frame_bytes of the link")
    for link in _objects(thin.get("links")):
        if link.get("rejecting_s") is not None:
            text = f"thin link {link.get('name')} accepts nothing: too many frames were forged"
            yield Alarm(Level.ERROR, "thin-link", text, "look for a foreign transmitter on its channel")
        if link.get("waits_for_budget_s") is not None:
            text = f"thin link {link.get('name')} has used its airtime"
            yield Alarm(Level.WARNING, "thin-airtime", text, "send less on it: meshctl lint has the topics")
    others = [thin.get("own_number_used_by")]
    others += [peer.get("conflicting_name") for peer in _objects(thin.get("peers"))]
    for name in filter(None, others):
        text = f"{name} has the same number on thin links as another robot"
        yield Alarm(Level.ERROR, "thin-link", text, "give each robot its own thin.number; then meshctl robots deploy")
    only = only_thin(facts)
    if only:
        yield Alarm(Level.WARNING, "thin-only", f"reaches {', '.join(only)} by thin links only", "check their wifi")


def only_thin(facts: RobotFacts) -> tuple[str, ...]:
    """The robots that it reaches by thin links only."""
    thin = facts.status.get("thin")
    peers = _objects(thin.get("peers")) if isinstance(thin, Mapping) else ()
    return tuple(str(peer.get("name")) for peer in peers if peer.get("present") and peer.get("only_thin"))


def _objects(value: object) -> list[Mapping[str, Any]]:
    return [item for item in value if isinstance(item, Mapping)] if isinstance(value, list) else []


def _items(value: object) -> list[tuple[str, object]]:
    return [(str(key), item) for key, item in value.items()] if isinstance(value, Mapping) else []
