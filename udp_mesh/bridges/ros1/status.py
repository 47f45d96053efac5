"""The network's conditions as JSON for ROS topics, without message packages. Pure.

`mesh_status` has the fields of the fielded `NetworkStats` per peer, `hosts` those of `HostEntry`, `mesh_conditions`
everything the daemon knows.
"""

from __future__ import annotations

import json
from typing import Any, Mapping


def mesh_status(conditions: Mapping[str, Any]) -> str:
    """Per peer: what waits, the last round trip, whether it is gone, and how long ago it was heard (seconds)."""
    peers = [
        {
            "host": peer["name"],
            "addr": peer["address"],
            "xmitDepth": sum(queue["messages"] for queue in peer["queues"]),
            "lastRTT": peer["round_trip_s"],
            "offline": not peer["online"],
            "lastSeenAgo": peer["heard_ago_s"],
        }
        for peer in conditions["peers"]
    ]
    return json.dumps({"host": conditions["name"], "peers": peers}, sort_keys=True)


def hosts(conditions: Mapping[str, Any]) -> str:
    """Everyone online with their address; changes only when they do."""
    online = [{"host": peer["name"], "addr": peer["address"]} for peer in conditions["peers"] if peer["online"]]
    return json.dumps({"hosts": sorted(online, key=lambda host: str(host["host"]))}, sort_keys=True)


def mesh_conditions(conditions: Mapping[str, Any]) -> str:
    return json.dumps(conditions, sort_keys=True)
