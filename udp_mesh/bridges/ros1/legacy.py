"""The legacy system's messages and service, generated here from their fields so that no package need be installed.

`NetworkStats` (queue and last contact per peer), `HostEntry` (one online robot), `GetHosts` (all of them). Names,
fields and checksums match those used by programs on existing robots (docs/facts/legacy-wire.md). Counters that this
transport does not have (`seqNum`, `staleInflightCount`, `incompleteCount`) are 0.
"""

from __future__ import annotations

import hashlib
from typing import Any, Mapping

import genpy
import genpy.dynamic
import rospy
from std_msgs.msg import Header

_NEXT = "=" * 80 + "\nMSG: "
_HEADER = _NEXT + "std_msgs/Header\n" + Header._full_text
_PEER_STATS = (
    "string host\nstring addr\nuint32 xmitDepth\nuint32 seqNum\nuint32 staleInflightCount\nuint32 incompleteCount\n"
    "duration lastRTT\nbool offline\ntime lastSeen\n"
)
_NETWORK_STATS = "Header header\nPeerStats[] peers\n" + _NEXT + "udp_mesh/PeerStats\n" + _PEER_STATS + _HEADER
_HOST_ENTRY = "Header header\nstring host\nstring mac\n" + _HEADER
_HOSTS = "string[] hosts\nstring[] macs"


def _made(name: str, text: str) -> Any:
    return genpy.dynamic.generate_dynamic("udp_mesh/" + name, text)


_stats_classes = _made("NetworkStats", _NETWORK_STATS)
NetworkStats: Any = _stats_classes["udp_mesh/NetworkStats"]
PeerStats: Any = _stats_classes["udp_mesh/PeerStats"]
HostEntry: Any = _made("HostEntry", _HOST_ENTRY)["udp_mesh/HostEntry"]


class GetHosts:
    """The service class rospy expects; its checksum is that of the request's fields followed by the response's."""

    _type = "udp_mesh/GetHosts"
    _md5sum = hashlib.md5(_HOSTS.encode()).hexdigest()
    _request_class: Any = _made("GetHostsRequest", "")["udp_mesh/GetHostsRequest"]
    _response_class: Any = _made("GetHostsResponse", _HOSTS)["udp_mesh/GetHostsResponse"]


def network_stats(conditions: Mapping[str, Any]) -> Any:
    """The daemon's conditions as `NetworkStats`."""
    now = rospy.Time.now()
    return NetworkStats(Header(stamp=now), [_peer_stats(peer, now) for peer in conditions["peers"]])


def _peer_stats(peer: Mapping[str, Any], now: Any) -> Any:
    ago = peer["heard_ago_s"]
    # On a simulated clock the last contact may be before the start, and ROS has no negative time.
    heard = genpy.Time() if ago is None else genpy.Time.from_sec(max(0.0, now.to_sec() - ago))
    waiting = sum(queue["messages"] for queue in peer["queues"])
    round_trip = genpy.Duration.from_sec(peer["round_trip_s"] or 0.0)
    return PeerStats(peer["name"], peer["address"] or "", waiting, 0, 0, 0, round_trip, not peer["online"], heard)


def host_entries(conditions: Mapping[str, Any]) -> list[Any]:
    """One `HostEntry` per online robot; `mac` is its IP address, as in the legacy system."""
    stamp = rospy.Time.now()
    return [HostEntry(Header(stamp=stamp), host, address) for host, address in _online(conditions)]


def hosts_response(conditions: Mapping[str, Any] | None) -> Any:
    """The response of `GetHosts`."""
    online = _online(conditions) if conditions is not None else []
    return GetHosts._response_class([host for host, _ in online], [address for _, address in online])


def _online(conditions: Mapping[str, Any]) -> list[tuple[str, str]]:
    found = [(peer["name"], str(peer["address"] or "")) for peer in conditions["peers"] if peer["online"]]
    return sorted((host, address.rpartition(":")[0].strip("[]") or address) for host, address in found)
