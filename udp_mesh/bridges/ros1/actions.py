"""Actions of ROS 1 (actionlib) across the mesh: which names carry which topics, and what ends goals. No rospy.

An action is five topics below its name. On the robot with the server, clients' goals and cancels from the mesh are
published under the action's own name, and its status, feedback and results are sent to the mesh. On every other robot
the action is `/<robot>/mesh_comm/<self>/<action>`: its five names are local topics there. The messages take the relay's
way, with their types and definitions.

A client waits until one node has all five names, so the names of a peer's action exist as soon as the peer offers it,
with the types that it reports. When the peer stays away for longer than `lost_s`, or its server is gone, clients get a
status in which their goals are pending, then one without them: actionlib's clients then end them as LOST.
"""

from __future__ import annotations

import json
import struct
from collections import deque
from typing import Deque, Dict, FrozenSet, Iterable, List, Mapping, NamedTuple, Optional, Set, Tuple

from udp_mesh.bridges.call_messages import Offer
from udp_mesh.bridges.message_codec import CodecError, MessageReader, encode
from udp_mesh.bridges.message_definition import MessageDefinition
from udp_mesh.bridges.names import Route, inbound_name
from udp_mesh.bridges.types import TypeKey

OFFER_TYPE = "actionlib"
GOAL, CANCEL = "goal", "cancel"
STATUS, FEEDBACK, RESULT = "status", "feedback", "result"
TO_SERVER, FROM_SERVER = (GOAL, CANCEL), (STATUS, FEEDBACK, RESULT)
TOPIC_SETTINGS: Mapping[str, Mapping[str, object]] = {
    GOAL: {"priority": 2, "reliable": True, "deadline_s": 30.0},
    CANCEL: {"priority": 2, "reliable": True, "deadline_s": 30.0},
    STATUS: {"priority": 3, "reliable": False, "keep_last": 1},
    FEEDBACK: {"priority": 3, "reliable": False, "keep_last": 1},
    RESULT: {"priority": 2, "reliable": True, "deadline_s": 600.0, "outbox": "all"},
}
"""Of the five mesh topics; the daemon's `[topics]` take precedence."""
STATUS_S = 1.0
"""actionlib repeats an unchanged status five times a second."""
MAX_GOALS = 256
"""Per action: the latest goals of local clients, which a status names before they are lost."""
_HEADER = "Header header\n"
_NEXT = "=" * 80 + "\nMSG: "
STATUS_ARRAY = MessageDefinition(
    "actionlib_msgs/GoalStatusArray",
    _HEADER + "GoalStatus[] status_list\n"
    + _NEXT + "std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    + _NEXT + "actionlib_msgs/GoalStatus\nGoalID goal_id\nuint8 status\n"
    + "".join(
        "uint8 {}={}\n".format(name, value)
        for value, name in enumerate(
            ("PENDING", "ACTIVE", "PREEMPTED", "SUCCEEDED", "ABORTED", "REJECTED", "PREEMPTING", "RECALLING",
             "RECALLED", "LOST")
        )
    )
    + "string text\n"
    + _NEXT + "actionlib_msgs/GoalID\ntime stamp\nstring id\n",
)  # fmt: skip


class GoalId(NamedTuple):
    stamp: Tuple[int, int]
    text: str


def mesh_topic(action: str, part: str) -> str:
    """`/move` and `goal` -> the mesh topic `move/goal`."""
    return "{}/{}".format(action.strip("/"), part)


def offer_of(action: str, types: Mapping[str, TypeKey], lost_s: float) -> Offer:
    """Announces an action to peers: the types of feedback and result, which a client's subscriptions must match."""
    text = json.dumps({part: list(types[part]) for part in (FEEDBACK, RESULT)}, separators=(",", ":"))
    return Offer(action, "{} {}".format(OFFER_TYPE, text), "", 0.0, lost_s)


def offered_types(offer: Offer) -> Optional[Dict[str, TypeKey]]:
    """The types of the topics that a peer's server publishes; None if the offer is no action."""
    head, _, text = offer.type.partition(" ")
    if head != OFFER_TYPE:
        return None
    try:
        found = json.loads(text)
        types = {part: TypeKey(str(found[part][0]), str(found[part][1])) for part in (FEEDBACK, RESULT)}
    except (ValueError, TypeError, KeyError, IndexError, RecursionError):
        return None
    types[STATUS] = TypeKey(STATUS_ARRAY.name, STATUS_ARRAY.md5sum)
    return types


def goal_id(payload: bytes) -> Optional[GoalId]:
    """The id in a client's goal message, behind its header; None for other bytes."""
    reader = MessageReader(payload, 1)
    try:
        reader.number("I")
        reader.time()
        reader.text()
        return GoalId(reader.time(), reader.text())
    except (CodecError, ValueError, struct.error):
        return None


class Proxy:
    """A peer's action, as the local clients see it."""

    def __init__(self, own: str, peer: str, offer: Offer, types: Dict[str, TypeKey]) -> None:
        self.peer, self.offer, self.types = peer, offer, types
        self.names = {
            part: inbound_name(own, peer, mesh_topic(offer.name, part)) for part in (*TO_SERVER, *FROM_SERVER)
        }
        self._goals: Deque[GoalId] = deque(maxlen=MAX_GOALS)

    @property
    def routes(self) -> Dict[str, Route]:
        """Local names of the clients' messages."""
        return {self.names[part]: Route(mesh_topic(self.offer.name, part), self.peer) for part in TO_SERVER}

    def note_goal(self, payload: bytes) -> None:
        found = goal_id(payload)
        if found is not None:
            self._goals.append(found)

    def lost_statuses(self) -> List[bytes]:
        """Two status messages, after which clients have lost their goals; none if there were no goals."""
        if not self._goals:
            return []
        pending = [{"goal_id": {"stamp": each.stamp, "id": each.text}, "status": 0} for each in self._goals]
        self._goals.clear()
        return [encode(STATUS_ARRAY, {"status_list": listed}, 1) for listed in (pending, [])]


class Actions:
    """The actions of one bridge: those with a server here, and the proxies of the peers'. Times in monotonic s."""

    def __init__(self, own: str, names: Iterable[str]) -> None:
        self._own = own
        self._names = tuple(names)
        self.peers: FrozenSet[str] = frozenset()
        """All known robots; set by the bridge."""
        self._callers: Dict[str, Set[str]] = {name: set() for name in self._names}
        self._sent: Dict[str, Tuple[bytes, float]] = {}
        self._proxies: Dict[Tuple[str, str], Proxy] = {}
        self._gone_at: Dict[Tuple[str, str], float] = {}

    @property
    def settings(self) -> Dict[str, Mapping[str, object]]:
        """The mesh topics to declare."""
        names = {*self._names, *(name for _, name in self._proxies)}
        return {mesh_topic(name, part): values for name in names for part, values in TOPIC_SETTINGS.items()}

    def proxies(self) -> List[Proxy]:
        return list(self._proxies.values())

    def routes(self) -> Dict[str, Route]:
        """Every further ROS name to subscribe to: what local servers publish, and what local clients do."""
        found = {
            "{}/{}".format(name, part): Route(mesh_topic(name, part), None)
            for name in self._names
            for part in FROM_SERVER
        }
        for proxy in self._proxies.values():
            found.update(proxy.routes)
        return found

    # Messages

    def from_ros(self, route: Route, payload: bytes, now: float) -> List[Route]:
        """Where a message from ROS goes: feedback and results to the robots that called, a status when it changed or
        every STATUS_S, all else by its route."""
        for name in self._names:
            if route == Route(mesh_topic(name, STATUS), None):
                return [route] if self._is_due(name, payload, now) else []
            if route in (Route(mesh_topic(name, FEEDBACK), None), Route(mesh_topic(name, RESULT), None)):
                return [Route(route.topic, peer) for peer in sorted(self._callers[name])]
        for (peer, name), proxy in self._proxies.items():
            if route == Route(mesh_topic(name, GOAL), peer):
                proxy.note_goal(payload)
        return [route]

    def _is_due(self, name: str, payload: bytes, now: float) -> bool:
        # behind the header: seq, stamp and frame id
        content = payload[16 + int.from_bytes(payload[12:16], "little") :]
        known = self._sent.get(name)
        if known is not None and known[0] == content and now - known[1] < STATUS_S:
            return False
        self._sent[name] = content, now
        return True

    def local_name(self, name: str) -> str:
        """The ROS name for a message that arrived under `name`: for goals and cancels that of the local server."""
        for action in self._names:
            for part in TO_SERVER:
                for peer in self.peers:
                    if name == inbound_name(self._own, peer, mesh_topic(action, part)):
                        self._callers[action].add(peer)
                        return "{}/{}".format(action, part)
        return name

    # Peers

    def on_offered(self, peer: str, offer: Offer) -> Optional[Proxy]:
        """A peer offers something; its proxy if that is an action."""
        types = offered_types(offer)
        if types is None:
            return None
        self._gone_at.pop((peer, offer.name), None)
        known = self._proxies.get((peer, offer.name))
        if known is None or known.types != types:
            self._proxies[peer, offer.name] = Proxy(self._own, peer, offer, types)
        return self._proxies[peer, offer.name]

    def on_withdrawn(self, peer: str, name: str, now: float) -> bool:
        """A peer's offer ended, or the peer is offline; whether it was an action."""
        if (peer, name) not in self._proxies:
            return False
        self._gone_at.setdefault((peer, name), now)
        return True

    def lost(self, now: float) -> List[Proxy]:
        """Proxies whose peer has been away for too long: their goals are lost, and they are removed."""
        ended = [key for key, at in self._gone_at.items() if now - at >= self._proxies[key].offer.lost_s]
        for key in ended:
            del self._gone_at[key]
        return [self._proxies.pop(key) for key in ended]
