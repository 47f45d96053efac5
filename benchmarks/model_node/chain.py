"""What the radios of model nodes in a chain tell: each hears the node before it and the one after it. Pure."""

from __future__ import annotations

import json
from collections.abc import Mapping

from benchmarks.model_node.node import RECORDED_MAC

Sections = Mapping[str, tuple[str, str]]

# Of a good link, of 255, and what each hop of a path costs.
_TQ, _TQ_PER_HOP = 250, 4
_STATION = (
    "Station {mac} (on mesh0)\n\tinactive time:\t40 ms\n\trx bytes:\t12400312\n\ttx bytes:\t3300121\n"
    "\ttx packets:\t22113\n\ttx retries:\t911\n\ttx failed:\t3\n\tsignal:  \t-58 [-60, -62] dBm\n"
    "\ttx bitrate:\t144.4 MBit/s MCS 15 short GI\n\trx bitrate:\t130.0 MBit/s MCS 15\n\tconnected time:\t3600 seconds\n"
)


def mac_prefix(number: int) -> str:
    """The first four bytes of the MACs of a node's interfaces."""
    return f"02:4d:{number >> 8:02x}:{number & 255:02x}"


def chain_sections(recorded: Sections, number: int, first: int, last: int) -> dict[str, tuple[str, str]]:
    """The sections of the node with this number in the chain from `first` to `last`, with MACs of its own."""
    own = mac_prefix(number)
    sections = {
        name: (body.replace(RECORDED_MAC, own).replace(f"fe{RECORDED_MAC[2:]}", f"fe{own[2:]}"), status)
        for name, (body, status) in recorded.items()
    }
    heard = [other for other in (number - 1, number + 1) if first <= other <= last]
    last_seen = {"hard_ifindex": 21, "hard_ifname": "mesh0", "last_seen_msecs": 120}
    neighbors = [{**last_seen, "neigh_address": _radio_mac(other)} for other in heard]
    originators = [
        {
            **last_seen,
            "orig_address": _radio_mac(other),
            "neigh_address": _radio_mac(number + (1 if other > number else -1)),
            "tq": _TQ - _TQ_PER_HOP * abs(other - number),
            "best": True,
        }
        for other in range(first, last + 1)
        if other != number
    ]
    return {
        **sections,
        "iw.stations mesh0": ("".join(_STATION.format(mac=_radio_mac(other)) for other in heard), "0"),
        "batctl.neighbors_json bat0": (json.dumps(neighbors) + "\n", "0"),
        "batctl.originators_json bat0": (json.dumps(originators) + "\n", "0"),
    }


def _radio_mac(number: int) -> str:
    return f"{mac_prefix(number)}:00:01"
