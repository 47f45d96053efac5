"""Subscriptions of each robot's programs, in a scenario.

    reads:
      base: {map: {}, video: {rate_hz: 1, max_age_s: 2}, "artifact/*": {}}
      uav: [status]

A robot that is not listed reads everything. Without `reads`, every robot does, and none asks another.
"""

from __future__ import annotations

import yaml

from udp_mesh.core.subscriptions.messages import (
    MAX_AGE_S,
    MAX_RATE_HZ,
    MIN_AGE_S,
    MIN_RATE_HZ,
    UNBOUNDED,
    Bounds,
    Subscription,
)
from udp_mesh.sim.yaml_entry import Entry

Reads = dict[str, tuple[Subscription, ...]]


def read_reads(at: Entry, robots: tuple[str, ...]) -> Reads:
    """By robot, what its programs read."""
    return {robot: _subscriptions(entry) for robot, entry in at.mapping(robots).items()}


def _subscriptions(at: Entry) -> tuple[Subscription, ...]:
    if isinstance(at.node, yaml.SequenceNode):
        return tuple(Subscription(item.text()) for item in at.items())
    return tuple(Subscription(pattern, _bounds(entry)) for pattern, entry in at.mapping(None).items())


def _bounds(at: Entry) -> Bounds:
    found = UNBOUNDED
    for key, entry in at.mapping(("rate_hz", "max_age_s")).items():
        if key == "rate_hz":
            found = found._replace(rate_hz=entry.number(1.0, MIN_RATE_HZ, MAX_RATE_HZ))
        else:
            found = found._replace(max_age_s=entry.number(1.0, MIN_AGE_S, MAX_AGE_S))
    return found
