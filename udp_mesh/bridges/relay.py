"""Decides what a ROS bridge does, as effects for the runtime to execute. Pure: no clock, no ROS.

1. From ROS: the definition is sent once per destination, then the message with its type in the type field. The last
   message of every latched publisher is stored for robots that join later.
2. From the mesh: a message whose definition is known is published; others wait while the source is asked for it.
3. From other bridges: a `Hello` is answered with the missing latched messages, a `Want` with definitions.
4. Peers that come online get a `Hello`. `tick` repeats unanswered requests.
5. A message of the other version of ROS is converted if its type is declared (`mixed_team`), else left out.
6. Items of shared logs may reach a robot that never meets their source. Their definition is an item of the same log,
   before them; one that is missing all the same is requested from all.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict, deque
from typing import Deque, Iterable, Literal, Mapping, NamedTuple, Union

from udp_mesh.bridges.message_definition import MessageDefinition
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.mixed_team import ConversionError, to_ros1, to_ros2
from udp_mesh.bridges.names import Route, inbound_name, ros_word
from udp_mesh.bridges.protocol import Definition, Hello, ProtocolError, Want, decode, encode
from udp_mesh.bridges.ros2.quality import history_depth
from udp_mesh.bridges.types import Definitions, LatchMark, MeshTopic, MessageKind, TypeKey, kind_text, parse_kind

PROTOCOL_TOPICS = {1: "bridge/ros1", 2: "bridge/ros2"}
"""By version of ROS. A bridge sends on its own topic, and reads every `Hello`: robots of both versions share topics."""
PROTOCOL_TYPE = "bridge"
"""Type of messages between bridges, also of a definition in a log; older bridges leave that out."""
MAX_WAITING_MESSAGES, MAX_WAITING_BYTES = 64, 32 << 20
"""Per source, while a definition is requested: a second's worth of messages; beyond it, the oldest is dropped."""
MAX_LATCHED, MAX_LATCHED_BYTES = 4096, 64 << 20
"""Latched messages stored for late joiners, in case a node latches under ever new names."""
MAX_LATCHED_PER_ROUTE = 32
"""Latching publishers per topic (tf_static); beyond it, the oldest is dropped, such as programs that latched and
exited."""
MAX_TRACKED_PUBLISHERS = 4 * MAX_LATCHED_PER_ROUTE
"""Publishers per source and topic whose last latched message is remembered: more than a source can repeat over its two
routes to us, since an old message would otherwise be published after a newer one."""
REQUEST_RETRY_S = 1.0
"""Interval between requests for the same definition."""
DEFINITION_TIMEOUT_S = 30.0
"""How long a message, and later ones of its topic, wait for its definition: the other bridge may be starting."""
MAX_NOTED = 1000
"""Distinct warnings logged; peers can invent names without bound."""


class ToMesh(NamedTuple):
    """Publish on the mesh; `peer` None means the topic's destinations, or all."""

    topic: str
    payload: bytes
    peer: str | None
    type: str


class ToRos(NamedTuple):
    """Publish in ROS. `definition` is None if the source did not send one (a legacy robot)."""

    name: str
    key: TypeKey
    definition: str | None
    latched: bool
    payload: bytes


class Note(NamedTuple):
    """Log a warning."""

    text: str


Effect = Union[ToMesh, ToRos, Note]


class _Waiting(NamedTuple):
    topic: str
    kind: MessageKind
    payload: bytes
    since: float


class Relay:
    """State of one bridge. ROS 1 types have two parts (`pkg/Type`) and are published with their definition; ROS 2 types
    have three (`pkg/msg/Type`) and must be installed on both sides."""

    def __init__(
        self,
        own: str,
        protocol_topic: str,
        *,
        ros_version: Literal[1, 2],
        nonce: bytes,
        types: Mapping[str, MessageDefinition] = TYPES,
    ) -> None:
        """`nonce`: random, so that message numbers of different runs of this bridge are never compared. `types` are
        converted from the other version of ROS."""
        self.own = own
        self._nonce = nonce
        self._number = 0
        self.protocol_topic = protocol_topic
        self.dropped = 0
        self._needs_definitions = ros_version == 1
        self._ros_version = ros_version
        self._types = types
        self._definitions = Definitions()
        self._sent_definitions: set[tuple[TypeKey, str | None]] = set()
        self._logged_definitions: set[tuple[TypeKey, str]] = set()
        self._latched: OrderedDict[tuple[Route, str], Deque[tuple[MessageKind, bytes]]] = OrderedDict()
        self._latched_bytes = 0
        self._last_numbers: dict[str, dict[str, OrderedDict[str, int]]] = {}
        self._recent_numbers: OrderedDict[tuple[str, str, str], Deque[int]] = OrderedDict()
        self._waiting: dict[str, Deque[_Waiting]] = {}
        self._requested_at: dict[tuple[str, TypeKey], float] = {}
        self._topics: Mapping[str, MeshTopic] = {}
        self._noted: set[Route | str] = set()

    def set_topics(self, topics: Mapping[str, MeshTopic]) -> None:
        """Sets the daemon's topics."""
        self._topics = topics

    def _is_log(self, topic: str) -> bool:
        return topic in self._topics and self._topics[topic].is_log

    # From ROS

    def from_ros(
        self, route: Route, publisher: str, key: TypeKey, definition: str, latched: bool, payload: bytes
    ) -> list[Effect]:
        """Handles a message from ROS. `publisher` distinguishes several that latch on one topic."""
        effects: list[Effect] = []
        if "/" not in key.name:
            # A publisher of any type (AnyMsg) has no type before its first message: receivers could not decode it.
            return self._note_once(route, "{}: unsupported type {!r} on {}".format(publisher, key.name, route.topic))
        if self._needs_definitions and (definition or key not in self._definitions):
            self._definitions.put(key, definition)
        if self._is_log(route.topic):
            return self._to_log(route.topic, key, definition, payload)
        if self._needs_definitions and (key, route.peer) not in self._sent_definitions:
            self._sent_definitions.add((key, route.peer))
            effects.append(self._to_bridges(Definition(key, definition), route.peer))
        kind = MessageKind(key)
        if latched:
            self._number += 1
            tag = hashlib.blake2b(publisher.encode(), key=self._nonce, digest_size=4).hexdigest()
            kind = MessageKind(key, LatchMark(tag, self._number))
            self._keep_latched(route, publisher, kind, payload)
        effects.append(ToMesh(route.topic, payload, route.peer, kind_text(kind)))
        return effects

    def _to_log(self, topic: str, key: TypeKey, definition: str, payload: bytes) -> list[Effect]:
        """A message to a shared log: to its readers, whatever peer its ROS name has. It is not latched, since the log
        keeps it for late joiners, and a later item replaces none before it."""
        effects: list[Effect] = []
        if self._needs_definitions and (key, topic) not in self._logged_definitions:
            self._logged_definitions.add((key, topic))
            effects.append(ToMesh(topic, encode(Definition(key, definition)), None, PROTOCOL_TYPE))
        return [*effects, ToMesh(topic, payload, None, kind_text(MessageKind(key)))]

    def _keep_latched(self, route: Route, publisher: str, kind: MessageKind, payload: bytes) -> None:
        """Stores a latched message, and of its publisher as many as late joiners get in ROS."""
        held = self._latched.pop((route, publisher), deque())
        held.append((kind, payload))
        self._latched_bytes += len(payload)
        while len(held) > history_depth(kind.key.checksum):
            self._latched_bytes -= len(held.popleft()[1])
        self._latched[route, publisher] = held
        same_route = [key for key in self._latched if key[0] == route]
        if len(same_route) > MAX_LATCHED_PER_ROUTE:
            self._forget_latched(same_route[0])
        while len(self._latched) > MAX_LATCHED or self._latched_bytes > MAX_LATCHED_BYTES:
            self._forget_latched(next(iter(self._latched)))

    def _forget_latched(self, key: tuple[Route, str]) -> None:
        self._latched_bytes -= sum(len(payload) for _, payload in self._latched.pop(key))

    # From the mesh

    def from_mesh(self, source: str, topic: str, type_text: str, payload: bytes, now: float) -> list[Effect]:
        """Handles a message from the mesh."""
        if topic in PROTOCOL_TOPICS.values() or topic == self.protocol_topic:
            return self._from_bridge(source, topic, payload)
        if type_text == PROTOCOL_TYPE and self._is_log(topic):
            return self._definition_from_log(source, topic, payload)
        kind = parse_kind(type_text)
        if kind is None or kind.key.name.count("/") not in (1, 2):
            return []
        if ros_word(source) == ros_word(self.own):
            text = "{}: same ROS name as this robot: its messages are not published".format(source)
            return self._note_once(source, text)
        if kind.mark is not None and not self._is_newer(source, topic, kind):
            return []
        if kind.key.name.count("/") != self._ros_version:
            try:
                kind, payload = self._converted(kind, payload)
            except ConversionError as error:
                about = "{}/{}: {}".format(source, topic, kind.key.name)
                return self._note_once(about, "{} from {} is not published: {}".format(topic, source, error))
        message = _Waiting(topic, kind, payload, now)
        waiting = self._waiting.get(source)
        blocked = waiting is not None and any(other.topic == topic for other in waiting)
        if not blocked and self._is_publishable(kind.key):
            return [self._publication(source, message)]
        self._enqueue(source, message)
        return self._request_definition(source, kind.key, now, from_all=self._is_log(topic))

    def _definition_from_log(self, source: str, topic: str, payload: bytes) -> list[Effect]:
        try:
            message = decode(payload)
        except ProtocolError as error:
            return [Note("invalid message from {} on {}: {}".format(source, topic, error))]
        if not isinstance(message, Definition) or not self._definitions.put(message.key, message.text):
            return []
        return self._publish_waiting()

    def _converted(self, kind: MessageKind, payload: bytes) -> tuple[MessageKind, bytes]:
        """A message of the other version of ROS as one of this. Raises ConversionError."""
        if self._ros_version == 2:
            key, payload = to_ros2(self._types, kind.key, payload, latched=kind.mark is not None)
            return MessageKind(key, kind.mark), payload
        definition, payload = to_ros1(self._types, kind.key, payload)
        key = TypeKey(definition.name, definition.md5sum)
        if key not in self._definitions:
            self._definitions.put(key, definition.text)
        return MessageKind(key, kind.mark), payload

    def _is_newer(self, source: str, topic: str, kind: MessageKind) -> bool:
        """Whether this message was not received before, nor a later one in whose place late joiners would get it."""
        assert kind.mark is not None
        publisher, number = kind.mark
        held = self._last_numbers.setdefault(source, {}).setdefault(topic, OrderedDict())
        last = held.get(publisher, -1)
        depth = history_depth(kind.key.checksum)
        if depth > 1:
            recent = self._recent_numbers.setdefault((source, topic, publisher), deque(maxlen=depth))
            if number in recent or number <= last - depth:
                return False
            recent.append(number)
            if len(self._recent_numbers) > MAX_LATCHED:
                self._recent_numbers.popitem(last=False)
        elif last >= number:
            return False
        held.pop(publisher, None)
        held[publisher] = max(last, number)
        while len(held) > MAX_TRACKED_PUBLISHERS:
            held.popitem(last=False)
        return True

    def _is_publishable(self, key: TypeKey) -> bool:
        return not self._needs_definitions or not key.checksum or key in self._definitions

    def _publication(self, source: str, message: _Waiting) -> ToRos:
        key = message.kind.key
        name = inbound_name(self.own, source, message.topic)
        return ToRos(name, key, self._definitions.get(key), message.kind.mark is not None, message.payload)

    def _enqueue(self, source: str, message: _Waiting) -> None:
        waiting = self._waiting.setdefault(source, deque())
        waiting.append(message)
        while len(waiting) > MAX_WAITING_MESSAGES or sum(len(each.payload) for each in waiting) > MAX_WAITING_BYTES:
            waiting.popleft()
            self.dropped += 1

    def _request_definition(self, source: str, key: TypeKey, now: float, *, from_all: bool) -> list[Effect]:
        """`from_all`: the source may be out of reach, and another bridge may have the type."""
        asked_at = self._requested_at.get((source, key))
        if self._is_publishable(key) or (asked_at is not None and now - asked_at < REQUEST_RETRY_S):
            return []
        self._requested_at[source, key] = now
        return [self._to_bridges(Want([key]), None if from_all else source)]

    # From other bridges

    def _from_bridge(self, source: str, topic: str, payload: bytes) -> list[Effect]:
        try:
            message = decode(payload)
        except ProtocolError as error:
            return [Note("invalid message from {} on {}: {}".format(source, topic, error))]
        if topic != self.protocol_topic and not isinstance(message, Hello):
            # definitions concern only bridges of the same version of ROS
            return []
        if isinstance(message, Definition):
            if not self._definitions.put(message.key, message.text):
                return []
            return self._publish_waiting()
        if isinstance(message, Want):
            return self._send_definitions(message.keys, source)
        effects = [self.greeting(source, answer=False)] if message.answer else []
        return effects + self._missing_latched(source, message.holds)

    def _send_definitions(self, keys: Iterable[TypeKey], peer: str) -> list[Effect]:
        found = ((key, self._definitions.get(key)) for key in keys)
        return [self._to_bridges(Definition(key, text), peer) for key, text in found if text is not None]

    def _missing_latched(self, peer: str, holds: Mapping[str, Mapping[str, int]]) -> list[Effect]:
        """Our latched messages that the peer does not have."""
        effects: list[Effect] = []
        for (route, _), held in self._latched.items():
            allowed = self._topics[route.topic].destinations if route.topic in self._topics else ()
            if route.peer not in (None, peer) or (route.peer is None and allowed and peer not in allowed):
                continue
            for kind, payload in held:
                if kind.mark is None or holds.get(route.topic, {}).get(kind.mark.publisher, -1) < kind.mark.number:
                    effects.append(ToMesh(route.topic, payload, peer, kind_text(kind)))
        return effects

    def _publish_waiting(self) -> list[Effect]:
        """Publishes messages whose definition arrived, in order per source and topic."""
        effects: list[Effect] = []
        for source, waiting in list(self._waiting.items()):
            blocked: set[str] = set()
            left: Deque[_Waiting] = deque()
            for message in waiting:
                if message.topic not in blocked and self._is_publishable(message.kind.key):
                    effects.append(self._publication(source, message))
                else:
                    blocked.add(message.topic)
                    left.append(message)
            if left:
                self._waiting[source] = left
            else:
                del self._waiting[source]
        self._requested_at = {
            asked: at for asked, at in self._requested_at.items() if not self._is_publishable(asked[1])
        }
        return effects

    def greeting(self, peer: str | None, *, answer: bool) -> Effect:
        """A `Hello` for one peer, or (None) for all."""
        held = self._last_numbers.get(peer, {}) if peer is not None else {}
        return self._to_bridges(Hello({topic: dict(numbers) for topic, numbers in held.items()}, answer), peer)

    def _to_bridges(self, message: Hello | Want | Definition, peer: str | None) -> ToMesh:
        return ToMesh(self.protocol_topic, encode(message), peer, PROTOCOL_TYPE)

    # Peers and time

    def on_daemon_up(self, online: Iterable[str]) -> list[Effect]:
        """Sends a `Hello` to every online peer after each connect to the daemon."""
        return [self.greeting(peer, answer=True) for peer in online]

    def on_peer_online(self, peer: str) -> list[Effect]:
        """Sends a `Hello`, so that each side then sends the latched messages the other lacks."""
        return [self.greeting(peer, answer=True)]

    def tick(self, now: float) -> list[Effect]:
        """Repeats requests for definitions, and drops messages that waited too long."""
        effects = self._expire_waiting(now) if self._waiting else []
        for source, waiting in self._waiting.items():
            for key in OrderedDict.fromkeys(message.kind.key for message in waiting):
                from_all = any(self._is_log(message.topic) for message in waiting if message.kind.key == key)
                effects += self._request_definition(source, key, now, from_all=from_all)
        return effects

    def _expire_waiting(self, now: float) -> list[Effect]:
        notes: list[Effect] = []
        for source, waiting in self._waiting.items():
            late = [message for message in waiting if self._is_expired(message, now)]
            if late:
                names = sorted({message.kind.key.name for message in late})
                notes.append(Note("{}: no definition received for {}: not published".format(source, ", ".join(names))))
                self.dropped += len(late)
                self._waiting[source] = deque(message for message in waiting if not self._is_expired(message, now))
        self._requested_at = {asked: at for asked, at in self._requested_at.items() if now - at <= DEFINITION_TIMEOUT_S}
        return notes + self._publish_waiting() if notes else notes

    def _is_expired(self, message: _Waiting, now: float) -> bool:
        return now - message.since > DEFINITION_TIMEOUT_S and not self._is_publishable(message.kind.key)

    def _note_once(self, about: Route | str, text: str) -> list[Effect]:
        if about in self._noted or len(self._noted) >= MAX_NOTED:
            return []
        self._noted.add(about)
        return [Note(text)]
