"""The ROS 1 graph as the bridge uses it: opaque subscribers and publishers that outlive the master. All rospy is here.

A master that was restarted knows nobody, and rospy does not notice. So `renew` looks at the master's process number and
at whether it knows this node, and registers everything again, leaving every connection as it is.
"""

from __future__ import annotations

import http.client
import logging
import threading
import xmlrpc.client
from typing import Any, Callable, Iterable, NamedTuple

import rosgraph
import roslib.message
import rospy
from std_msgs.msg import String

from udp_mesh.bridges.names import Route
from udp_mesh.bridges.relay import ToRos
from udp_mesh.bridges.types import TypeKey

log = logging.getLogger(__name__)

FIRST_HOLD_S = 2.0
"""How long the first messages of a new topic wait for subscribers who were there before it."""
BUFFER_BYTES = 1 << 24
"""rospy's receive buffer: with its own 64 kB large images lag ever further behind."""
QUEUE_MESSAGES = 100
"""Messages that wait for a slow subscriber."""

MASTER_ERRORS = (rosgraph.MasterException, OSError, xmlrpc.client.Error, http.client.HTTPException)
"""What a call to a master that is gone, or going, raises."""

OnMessage = Callable[[Route, str, TypeKey, str, bool, bytes], None]


class _Publication:
    """One topic we publish, and its first messages until the subscribers that were there before have connected."""

    def __init__(self, message: ToRos, subscribers: int, now: float) -> None:
        self.key, self.latched = message.key, message.latched
        fields = {
            "_type": message.key.name,
            "_md5sum": message.key.checksum,
            "_full_text": message.definition or "",
        }
        self.message_class = type("Opaque", (rospy.AnyMsg,), fields)
        self.publisher = rospy.Publisher(
            message.name, self.message_class, queue_size=QUEUE_MESSAGES, latch=message.latched
        )
        self._subscribers = subscribers
        self._until = now + FIRST_HOLD_S
        self._first: list[bytes] = []

    def publish(self, payload: bytes, now: float) -> None:
        self._first.append(payload)
        self.flush(now)

    def flush(self, now: float) -> None:
        if self.publisher.get_num_connections() >= self._subscribers or now >= self._until:
            self._subscribers = 0
            waiting, self._first = self._first, []
            for payload in waiting:
                opaque = self.message_class()
                opaque._buff = payload
                self.publisher.publish(opaque)


class Parameters(NamedTuple):
    """Private parameters of the node, named like the fielded ones where those exist."""

    socket: str
    hostname: str
    topic_list: list[object]
    host_list: list[object]


class Graph:
    """Topics of this node. `listen`, `publish` and `flush` may be called from any thread."""

    def __init__(self, on_message: OnMessage) -> None:
        self._on_message = on_message
        self._lock = threading.RLock()
        self._pid = _master().getPid()
        self._subscribers: dict[str, tuple[Route, Any]] = {}
        self._publications: dict[str, _Publication] = {}
        self._texts: dict[str, Any] = {}
        self._settings: Any = None
        self._unknown: set[TypeKey] = set()

    # Subscribing

    def listen(self, routes: dict[str, Route]) -> None:
        """Subscribes to exactly these names."""
        with self._lock:
            for name in [name for name, (route, _) in self._subscribers.items() if routes.get(name) != route]:
                self._subscribers.pop(name)[1].unregister()
            for name, route in routes.items():
                if name not in self._subscribers:
                    subscriber = rospy.Subscriber(
                        name, rospy.AnyMsg, self._arrived, callback_args=route, buff_size=BUFFER_BYTES, tcp_nodelay=True
                    )
                    self._subscribers[name] = (route, subscriber)

    def _arrived(self, message: Any, route: Route) -> None:
        header = message._connection_header
        self._on_message(
            route,
            str(header.get("callerid", "")),
            TypeKey(str(header["type"]), str(header["md5sum"])),
            str(header.get("message_definition", "")),
            header.get("latching") == "1",
            bytes(message._buff),
        )

    def listen_settings(self, name: str, on_window: Callable[[int], None]) -> None:
        """The fielded `MeshSettings`, one byte: the window in packets, 0 for adaptive."""

        def arrived(message: Any) -> None:
            if len(message._buff) == 1:
                on_window(message._buff[0])

        self._settings = (name, rospy.Subscriber(name, rospy.AnyMsg, arrived))

    def published(self) -> list[str]:
        """Names somebody publishes, as the master knows them. Raises one of MASTER_ERRORS."""
        return [name for name, _ in _master().getPublishedTopics("")]

    # Publishing

    def publish(self, message: ToRos, now: float) -> None:
        """Publishes an opaque message; a topic whose type or latching changed is advertised anew."""
        complete = self._complete(message)
        if complete is None:
            return
        with self._lock:
            known = self._publications.get(message.name)
            if known is None or known.key != complete.key or known.latched != complete.latched:
                if known is not None:
                    # rospy keeps the first type of a topic until its last publisher is gone.
                    known.publisher.unregister()
                known = _Publication(complete, 0 if complete.latched else _subscribers_of(message.name), now)
                self._publications[message.name] = known
            known.publish(message.payload, now)

    def _complete(self, message: ToRos) -> ToRos | None:
        """A fielded robot names only the type: checksum and definition are then those installed here."""
        if message.key.checksum:
            return message
        found = roslib.message.get_message_class(message.key.name)
        if found is None:
            if message.key not in self._unknown:
                self._unknown.add(message.key)
                log.warning("type-unknown type=%s name=%s", message.key.name, message.name)
            return None
        return message._replace(key=TypeKey(message.key.name, found._md5sum), definition=found._full_text)

    def publish_text(self, name: str, text: str, *, latched: bool = False) -> None:
        """A std_msgs/String."""
        if name not in self._texts:
            self._texts[name] = rospy.Publisher(name, String, queue_size=1, latch=latched)
        self._texts[name].publish(String(text))

    def flush(self, now: float) -> None:
        """First messages of new topics whose subscribers have come by now."""
        with self._lock:
            for publication in self._publications.values():
                publication.flush(now)

    # The master

    def renew(self) -> bool:
        """Registers everything again if the master was restarted; True if it did. Raises one of MASTER_ERRORS."""
        master = _master()
        pid = master.getPid()
        if pid == self._pid and _knows_us(master):
            return False
        uri = rospy.get_node_uri()
        ourselves = xmlrpc.client.ServerProxy(uri)
        for name, message_type in self._published_types():
            master.registerPublisher(name, message_type, uri)
        for name in self._listened():
            publishers = master.registerSubscriber(name, rospy.AnyMsg._type, uri)
            # The new master's answer reaches rospy as if the master had called.
            ourselves.publisherUpdate("/master", name, publishers)
        self._pid = pid
        log.info("master-restarted pid=%d", pid)
        return True

    def _published_types(self) -> Iterable[tuple[str, str]]:
        yield from [(name, publication.key.name) for name, publication in self._publications.items()]
        yield from [(name, String._type) for name in self._texts]

    def _listened(self) -> list[str]:
        return [*self._subscribers, *([self._settings[0]] if self._settings else [])]


def _master() -> Any:
    """A connection to the master for the calling thread alone."""
    return rosgraph.Master(rospy.get_name())


def _knows_us(master: Any) -> bool:
    try:
        return bool(master.lookupNode(rospy.get_name()) == rospy.get_node_uri())
    except rosgraph.MasterException:
        return False


def _subscribers_of(name: str) -> int:
    try:
        subscribers = _master().getSystemState()[1]
    except MASTER_ERRORS:
        return 0
    return sum(len(nodes) for topic, nodes in subscribers if topic == name)


def parameters(default_socket: str) -> Parameters:
    """The node's private parameters."""
    return Parameters(
        str(rospy.get_param("~socket", default_socket)),
        str(rospy.get_param("~hostname", "")),
        list(rospy.get_param("~topic_list", [])),
        list(rospy.get_param("~host_list", [])),
    )
