"""Find beacons that have been dropped although the inventory has them as carried, from one snapshot. Pure.

A beacon in a robot's rack is off, or within a meter of the robot's own radios. One that answers has been dropped if its
robot's radios hear it weakly or not at all while another node hears it, or reaches the base through it.
"""

from __future__ import annotations

from collections.abc import Iterable

from meshctl.model import Fleet, NodeState, Role
from meshctl.placement.margin import RACK_DBM
from meshctl.status.node_alarms import join_limited
from meshctl.status.values import NodeStatus


def dropped_beacons(fleet: Fleet, nodes: Iterable[NodeStatus]) -> dict[str, str]:
    """Beacon -> why it has been dropped. Only carried beacons that answer are judged."""
    statuses = {status.name: status for status in nodes}
    carriers = {name: robot.nodes for robot in fleet.robots.values() for name in robot.carries}
    found = {}
    for name, status in statuses.items():
        if status.node.state is NodeState.CARRIED and status.node.role is Role.BEACON and status.health.answers:
            radios = [statuses[radio] for radio in carriers.get(name, ()) if radio in statuses]
            if reason := _reason(status, radios):
                found[name] = reason
    return found


def _reason(beacon: NodeStatus, radios: Iterable[NodeStatus]) -> str:
    answering = [radio for radio in radios if radio.health.answers]
    own = {radio.name for radio in answering}
    heard = [neighbor for neighbor in beacon.neighbors if neighbor.name in own]
    signals = [neighbor.signal_dbm for neighbor in heard if neighbor.signal_dbm is not None]
    # the mesh relays through a rack as through any other place
    if beacon.relays and max(signals, default=RACK_DBM - 1) < RACK_DBM:
        return f"relays to the base for {join_limited(beacon.relays)}"
    if not answering or not beacon.neighbors:
        # a robot that does not answer says nothing about where its beacons are
        return ""
    if not heard:
        names = join_limited(tuple(neighbor.name for neighbor in beacon.neighbors))
        return f"hears {names}, not its robot's {_names(own)}"
    if signals and max(signals) < RACK_DBM:
        return f"hears its robot's {_names(own)} with {max(signals)} dBm only"
    return ""


def _names(own: Iterable[str]) -> str:
    return join_limited(tuple(sorted(own)))
