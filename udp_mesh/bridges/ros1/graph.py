"""The ROS 1 graph as the bridge uses it: opaque subscribers and publishers that outlive the master. With `fielded`, all
of rospy is here.

A master that was restarted knows nobody, and rospy does not notice. So `renew` looks at the master's process number and
at whether it knows this node, and registers everything again, leaving every connection as it is.

`publish` never waits for the master (`publications`); `listen` and `renew` do, and are called by one thread alone.
"""

from __future__ import annotations

import http.client
import logging
import threading
import time
import xmlrpc.client
from typing import Any, Callable, Mapping, NamedTuple

import rosgraph
import roslib.message
import rospy
from std_msgs.msg import String

from udp_mesh.bridges.names import Route
from udp_mesh.bridges.relay import ToRos
from udp_mesh.bridges.ros1 import legacy
from udp_mesh.bridges.ros1.publications import Outgoing, Publications
from udp_mesh.bridges.types import TypeKey

log = logging.getLogger(__name__)

BUFFER_BYTES = 1 << 24
"""rospy's receive buffer: with its own 64 kB large images lag ever further behind."""
QUEUE_MESSAGES, QUEUE_BYTES = 10_000, 4 << 20
"""What waits at most for one slow subscriber of a topic: bursts of small messages whole, of images the last few; at
least one message."""

MASTER_ERRORS = (rosgraph.MasterException, OSError, xmlrpc.client.Error, http.client.HTTPException)
"""What a call to a master that is gone, or going, raises."""

OnMessage = Callable[[Route, str, TypeKey, str, bool, bytes], None]


class _Opaque:
    """One topic we advertise: rospy's publisher of a class made for its type."""

    def __init__(self, message: Outgoing) -> None:
        fields = {"_type": message.key.name, "_md5sum": message.key.checksum, "_full_text": message.definition}
        self._class = type("Opaque", (rospy.AnyMsg,), fields)
        self._depth = _queue_depth(len(message.payload))
        self._publisher = rospy.Publisher(message.name, self._class, queue_size=self._depth, latch=message.latched)

    def connections(self) -> int:
        return int(self._publisher.get_num_connections())

    def publish(self, payload: bytes) -> None:
        depth = _queue_depth(len(payload))
        if depth < self._depth:
            self._shorten_queues(depth)
        opaque = self._class()
        opaque._buff = payload
        self._publisher.publish(opaque)

    def _shorten_queues(self, depth: int) -> None:
        """Messages have become larger: fewer may wait for a slow subscriber, those that are connected included."""
        self._depth = depth
        self._publisher.impl.set_queue_size(depth)
        for connection in self._publisher.impl.connections:
            # rospy has no other way to shorten a queue; it drops from the front one by one, so cut it here.
            with connection._lock:
                connection._queue_size = depth
                del connection._queue[:-depth]

    def withdraw(self) -> None:
        self._publisher.unregister()


def _queue_depth(payload_bytes: int) -> int:
    return max(1, min(QUEUE_MESSAGES, QUEUE_BYTES // max(1, payload_bytes)))


class Parameters(NamedTuple):
    """Private parameters of the node, named like the fielded ones where those exist."""

    socket: str
    hostname: str
    topic_list: list[object]
    host_list: list[object]


class Graph:
    """Topics of this node, and the fielded status topics and service under `prefix`."""

    def __init__(self, on_message: OnMessage, prefix: str, on_window: Callable[[int], None]) -> None:
        self._on_message = on_message
        self._pid = _master().getPid()
        self._subscribers: dict[str, tuple[Route, Any]] = {}
        self._publications = Publications(_Opaque, _subscribers_of, time.monotonic)
        self._unknown: set[TypeKey] = set()
        self._conditions: Mapping[str, Any] | None = None
        self._stats = rospy.Publisher(prefix + "mesh_status", legacy.NetworkStats, queue_size=1)
        self._hosts = rospy.Publisher(prefix + "hosts", legacy.HostEntry, queue_size=100)
        self._text = rospy.Publisher(prefix + "mesh_conditions", String, queue_size=1)
        self._service = rospy.Service(prefix + "getHosts", legacy.GetHosts, self._get_hosts)
        self._settings = rospy.Subscriber(prefix + "mesh_settings", rospy.AnyMsg, self._settings_arrived, on_window)

    def start(self, stop: threading.Event) -> None:
        """Begins to advertise; until `stop`."""
        threading.Thread(target=self._publications.run, args=(stop,), daemon=True).start()

    # Subscribing

    def listen(self, routes: dict[str, Route]) -> None:
        """Subscribes to exactly these names. Waits for the master."""
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

    def _settings_arrived(self, message: Any, on_window: Callable[[int], None]) -> None:
        """The fielded `MeshSettings`, one byte: the window in packets, 0 for adaptive."""
        if len(message._buff) == 1:
            on_window(message._buff[0])

    def published(self) -> list[str]:
        """Names somebody publishes, as the master knows them. Raises one of MASTER_ERRORS."""
        return [name for name, _ in _master().getPublishedTopics("")]

    # Publishing

    def publish(self, message: ToRos) -> None:
        """Publishes an opaque message, from any thread; a topic whose type or latching changed is advertised anew."""
        key, definition = message.key, message.definition
        if not key.checksum:
            # A fielded robot names only the type: checksum and definition are then those installed here.
            found = roslib.message.get_message_class(key.name)
            if found is None:
                if key not in self._unknown:
                    self._unknown.add(key)
                    log.warning("type-unknown type=%s name=%s", key.name, message.name)
                return
            key, definition = TypeKey(key.name, found._md5sum), found._full_text
        self._publications.publish(Outgoing(message.name, key, definition or "", message.latched, message.payload))

    def publish_conditions(self, conditions: Mapping[str, Any], text: str) -> None:
        """The network's conditions: to programs of the fielded system, and whole (`text`) for the autonomy."""
        self._conditions = conditions
        self._stats.publish(legacy.network_stats(conditions))
        for entry in legacy.host_entries(conditions):
            self._hosts.publish(entry)
        self._text.publish(String(text))

    def _get_hosts(self, _request: object) -> Any:
        return legacy.hosts_response(self._conditions)

    # The master

    def reregister(self) -> bool:
        """Registers everything again if the master was restarted; True if it did. Raises one of MASTER_ERRORS."""
        master = _master()
        pid = master.getPid()
        if pid == self._pid and _is_registered(master):
            return False
        uri = rospy.get_node_uri()
        ourselves = xmlrpc.client.ServerProxy(uri)
        fixed = [(publisher.resolved_name, publisher.type) for publisher in (self._stats, self._hosts, self._text)]
        for name, message_type in [*fixed, *self._publications.advertised()]:
            master.registerPublisher(name, message_type, uri)
        for name in [*self._subscribers, self._settings.resolved_name]:
            publishers = master.registerSubscriber(name, rospy.AnyMsg._type, uri)
            # The new master's answer reaches rospy as if the master had called.
            ourselves.publisherUpdate("/master", name, publishers)
        master.registerService(self._service.resolved_name, self._service.uri, uri)
        self._pid = pid
        log.info("master-restarted pid=%d", pid)
        return True


def _master() -> Any:
    """A connection to the master for the calling thread alone."""
    return rosgraph.Master(rospy.get_name())


def _is_registered(master: Any) -> bool:
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


def log_to_ros() -> None:
    """What the bridge logs goes where rospy's own messages go: terminal and /rosout. Call it after `init_node`, which
    takes all other handlers away."""
    ours = logging.getLogger("udp_mesh")
    ours.handlers = list(logging.getLogger("rosout").handlers)
    ours.setLevel(logging.INFO)
    ours.propagate = False


def parameters(default_socket: str) -> Parameters:
    """The node's private parameters. One that should be a list and is none is reported, and taken for empty."""
    return Parameters(
        str(rospy.get_param("~socket", default_socket)),
        str(rospy.get_param("~hostname", "")),
        _list_parameter("topic_list"),
        _list_parameter("host_list"),
    )


def _list_parameter(name: str) -> list[object]:
    value = rospy.get_param("~" + name, [])
    if isinstance(value, list):
        return value
    log.error("parameter-refused %s: expected a list, found %r", name, value)
    return []
