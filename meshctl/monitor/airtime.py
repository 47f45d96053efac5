"""Airtime cost of monitoring: bytes by device and a status document -> share of the channel's time. Pure.

A byte to a node three hops away is sent three times on one channel. Its time there follows from the rate that the node
expects of its next hop (minstrel's expected throughput: losses and medium access are in it), else from the bit rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# TCP, IP, batman-adv and Ethernet headers on 1448 bytes, and an acknowledgment for every second segment.
OVERHEAD = 1.1
# Half of the bit rate arrives as payload without aggregation (802.11 medium access, acknowledgments).
MAC_EFFICIENCY = 0.5
# Without any report: the lowest mandatory OFDM rate, pessimistic for all but the worst links.
DEFAULT_KBIT_S = 6000 * MAC_EFFICIENCY


@dataclass(frozen=True, slots=True)
class AirtimeUse:
    """`airtime_s` is None if no device reports its place in the mesh."""

    bytes: int
    airtime_s: float | None


def airtime_use(sent: Mapping[str, int], status: Mapping[str, Any]) -> AirtimeUse:
    """The airtime of these bytes by device name (`robot.NAME` for a computer), given the mesh of `status`."""
    nodes = {node["name"]: node for node in status.get("nodes", ())}
    robots = {f"robot.{robot['name']}": robot for robot in status.get("robots", ())}
    airtime_s = 0.0
    is_known = False
    for device, count in sent.items():
        node = nodes.get(device)
        if node is None and device in robots:
            radios = [nodes[name] for name in robots[device].get("radios", ()) if name in nodes]
            node = next((radio for radio in radios if radio.get("hops") is not None), None)
        hops = None if node is None else node.get("hops")
        if node is None or hops is None:
            continue
        is_known = True
        airtime_s += count * OVERHEAD * 8 * hops / (1000 * _rate_kbit_s(node))
    return AirtimeUse(sum(sent.values()), airtime_s if is_known else None)


def _rate_kbit_s(node: Mapping[str, Any]) -> float:
    via = node.get("via")
    for neighbor in node.get("neighbours") or ():
        if neighbor.get("name") == via:
            if expected := neighbor.get("expected_kbit_s"):
                return float(expected)
            if bitrate := neighbor.get("tx_bitrate_kbit_s"):
                return float(bitrate) * MAC_EFFICIENCY
    return DEFAULT_KBIT_S


def next_interval_s(wanted_s: float, airtime_s: float | None, limit_share: float, longest_s: float) -> float:
    """The time between two frames at which one frame's airtime stays within the limit."""
    if airtime_s is None:
        return wanted_s
    return max(wanted_s, min(longest_s, airtime_s / limit_share))
