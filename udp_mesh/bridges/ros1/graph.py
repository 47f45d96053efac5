"""The ROS 1 graph: opaque subscribers and publishers that survive restarts of the master. Together with `legacy`, the
only user of rospy.

A restarted master has lost all registrations, and rospy does not notice. `reregister` therefore compares the master's
process id, checks whether it knows this node, and if not registers everything again without closing a connection.

`publish` never waits for the master (`publications`); `listen` and `reregister` do, and are called by one thread only.
"""

from __future__ import annotations

import http.client
import logging
import threading
import time
import xmlrpc.client
from typing import Any, Callable, Iterable, Mapping, NamedTuple, Sequence

import rosgraph
import roslib.message
import rospy

from udp_mesh.bridges.conditions_message import to_ros
from udp_mesh.bridges.names import Route
from udp_mesh.bridges.receiving import Receive, parse_receive
from udp_mesh.bridges.relay import ToRos
from udp_mesh.bridges.ros1 import legacy
from udp_mesh.bridges.ros1.lost_connections import LostConnections, SystemState
from udp_mesh.bridges.ros1.publications import Publications, RosPublication
from udp_mesh.bridges.types import TypeKey

log = logging.getLogger(__name__)

BUFFER_BYTES = 1 << 24
"""rospy's receive buffer: with its default of 64 kB the bridge falls behind on large images."""
QUEUE_MESSAGES, QUEUE_BYTES = 10_000, 4 << 20
"""Maximum queue for one slow subscriber of a topic: many small messages or the last few images, at least one
message."""

MASTER_ERRORS = (rosgraph.MasterException, OSError, xmlrpc.client.Error, http.client.HTTPException)
"""Exceptions of calls to a master that is down or going down."""

OnMessage = Callable[[Route, str, TypeKey, str, bool, bytes], None]


class _Opaque:
    """One advertised topic: rospy's publisher of a message class created for its type."""

    def __init__(self, message: RosPublication) -> None:
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
        """Shortens the queues, those of existing connections too, because messages have become larger."""
        self._depth = depth
        self._publisher.impl.set_queue_size(depth)
        for connection in self._publisher.impl.connections:
            # rospy cannot shorten a queue, and drops only one message at a time: truncate it here.
            with connection._lock:
                connection._queue_size = depth
                del connection._queue[:-depth]

    @property
    def type(self) -> str:
        return str(self._publisher.type)

    def withdraw(self) -> None:
        self._publisher.unregister()


def _queue_depth(payload_bytes: int) -> int:
    return max(1, min(QUEUE_MESSAGES, QUEUE_BYTES // max(1, payload_bytes)))


class Parameters(NamedTuple):
    """Private parameters of the node, with the legacy names where these exist."""

    socket: str
    hostname: str
    topic_list: list[object]
    host_list: list[object]
    odometry: str = ""
    tf_frames: list[object] = []  # noqa: RUF012 - a tuple's default, never changed
    config: str = ""
    receive: Sequence[Receive] = ()


class Graph:
    """Topics of this node, and the legacy status topics and service under `prefix`."""

    def __init__(self, on_message: OnMessage, prefix: str, on_window: Callable[[int], None]) -> None:
        self._on_message = on_message
        self._pid = _master().getPid()
        self._subscribers: dict[str, tuple[Route, Any]] = {}
        self._watched: list[Any] = []
        self._reserved: dict[str, _Opaque] = {}
        self._publications = Publications(_Opaque, _subscribers_of, time.monotonic)
        self._unknown: set[TypeKey] = set()
        self._lost_publishers, self._lost_subscribers = LostConnections(), LostConnections()
        self._conditions: Mapping[str, Any] | None = None
        self._prefix = prefix
        self._stats = rospy.Publisher(prefix + "mesh_status", legacy.NetworkStats, queue_size=1)
        self._hosts = rospy.Publisher(prefix + "hosts", legacy.HostEntry, queue_size=100)
        self._service = rospy.Service(prefix + "getHosts", legacy.GetHosts, self._get_hosts)
        self._settings = rospy.Subscriber(prefix + "mesh_settings", rospy.AnyMsg, self._settings_arrived, on_window)

    def start(self, stop: threading.Event) -> None:
        """Starts advertising, until `stop` is set."""
        threading.Thread(target=self._publications.run, args=(stop,), daemon=True).start()

    # Subscribe

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

    def publisher_type(self, name: str) -> TypeKey | None:
        """The type of a publisher that a subscriber of `listen` is connected to; None without one."""
        route_and_subscriber = self._subscribers.get(name)
        connections = [] if route_and_subscriber is None else route_and_subscriber[1].impl.connections
        return next(
            (TypeKey(str(connection.type), str(connection.md5sum)) for connection in connections if connection.type),
            None,
        )

    def reserve(self, types: Mapping[str, TypeKey]) -> None:
        """Advertises exactly these names beside those with messages, for programs that wait for a publisher. Waits for
        the master."""
        for name in [name for name in self._reserved if name not in types]:
            self._reserved.pop(name).withdraw()
        for name, key in types.items():
            if name not in self._reserved:
                self._reserved[name] = _Opaque(RosPublication(name, key, "", False, b""))

    def watch(self, name: str, on_bytes: Callable[[str, bytes], None]) -> None:
        """Subscribes to a name for this bridge itself, not for the mesh. Waits for the master."""

        def arrived(message: Any) -> None:
            on_bytes(name, bytes(message._buff))

        # only the newest matters; the name may be relative to the node's namespace
        self._watched.append(rospy.Subscriber(name, rospy.AnyMsg, arrived, queue_size=1, buff_size=BUFFER_BYTES))

    def _settings_arrived(self, message: Any, on_window: Callable[[int], None]) -> None:
        """The legacy `MeshSettings`, one byte: the window in packets, 0 for adaptive."""
        if len(message._buff) == 1:
            on_window(message._buff[0])

    def system_state(self) -> SystemState:
        """Names with publishers or subscribers beside this node. Raises one of MASTER_ERRORS."""
        publishers, subscribers, _ = _master().getSystemState()
        return SystemState(_of_others(publishers), _of_others(subscribers))

    def reconnect(self, state: SystemState) -> None:
        """Has the master repeat who publishes the names whose connections were lost. Raises one of MASTER_ERRORS."""
        subscribed = [subscriber for _, subscriber in self._subscribers.values()] + self._watched
        incoming = {one.resolved_name: one.impl.get_num_connections() for one in subscribed}
        for name in self._lost_publishers.due(incoming, state.publishers):
            self._register_subscriber(name)
        types = dict(self._publications.advertised())
        for name in self._lost_subscribers.due(self._publications.connections(), state.subscribers):
            if name in types:
                _master().registerPublisher(name, types[name], rospy.get_node_uri())

    # Publish

    def publish(self, message: ToRos) -> None:
        """Publishes an opaque message, from any thread; a topic whose type or latching changed is advertised again."""
        key, definition = message.key, message.definition
        if not key.checksum:
            # A legacy robot sends only the type's name: use the locally installed checksum and definition.
            found = roslib.message.get_message_class(key.name)
            if found is None:
                if key not in self._unknown:
                    self._unknown.add(key)
                    log.warning("type-unknown type=%s name=%s", key.name, message.name)
                return
            key, definition = TypeKey(key.name, found._md5sum), found._full_text
        self._publications.publish(
            RosPublication(message.name, key, definition or "", message.latched, message.payload)
        )

    def publish_conditions(self, conditions: Mapping[str, Any]) -> None:
        """Publishes the network conditions: as legacy messages, as complete JSON, and typed."""
        self._conditions = conditions
        self._stats.publish(legacy.network_stats(conditions))
        for entry in legacy.host_entries(conditions):
            self._hosts.publish(entry)
        now = rospy.Time.now()
        for message in to_ros(conditions, self._prefix.rstrip("/"), 1, (now.secs, now.nsecs)):
            self.publish(message)

    def _get_hosts(self, _request: object) -> Any:
        return legacy.hosts_response(self._conditions)

    # The master

    def reregister(self, services: Iterable[tuple[str, str]] = ()) -> bool:
        """Registers everything, and these services (name, URI), with a restarted master; returns whether it was needed.
        Raises one of MASTER_ERRORS."""
        master = _master()
        pid = master.getPid()
        if pid == self._pid and _is_registered(master):
            return False
        uri = rospy.get_node_uri()
        fixed = [(publisher.resolved_name, publisher.type) for publisher in (self._stats, self._hosts)]
        reserved = [(name, opaque.type) for name, opaque in self._reserved.items()]
        for name, message_type in [*fixed, *self._publications.advertised(), *reserved]:
            master.registerPublisher(name, message_type, uri)
        watched = [subscriber.resolved_name for subscriber in self._watched]
        for name in [*self._subscribers, *watched, self._settings.resolved_name]:
            self._register_subscriber(name)
        for name, service_uri in [(self._service.resolved_name, self._service.uri), *services]:
            master.registerService(name, service_uri, uri)
        self._pid = pid
        log.info("master-restarted pid=%d", pid)
        return True

    def _register_subscriber(self, name: str) -> None:
        """Registers the subscriber, and passes the master's answer to rospy as if the master had called."""
        uri = rospy.get_node_uri()
        publishers = _master().registerSubscriber(name, rospy.AnyMsg._type, uri)
        xmlrpc.client.ServerProxy(uri).publisherUpdate("/master", name, publishers)


def _of_others(names: Iterable[Sequence[Any]]) -> dict[str, list[str]]:
    """The nodes of each name without this one; names without another node are left out."""
    ours = rospy.get_name()
    listed = {str(name): [str(node) for node in nodes if node != ours] for name, nodes in names}
    return {name: nodes for name, nodes in listed.items() if nodes}


def _master() -> Any:
    """A master proxy for the calling thread only."""
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
    """Sends the bridge's log to rospy's handlers: terminal and /rosout. Call it after `init_node`, which removes all
    other handlers."""
    ours = logging.getLogger("udp_mesh")
    ours.handlers = list(logging.getLogger("rosout").handlers)
    ours.setLevel(logging.INFO)
    ours.propagate = False


def parameters(default_socket: str) -> Parameters:
    """The node's private parameters. A parameter that should be a list and is not is logged and taken as empty."""
    return Parameters(
        str(rospy.get_param("~socket", default_socket)),
        str(rospy.get_param("~hostname", "")),
        _list_parameter("topic_list"),
        _list_parameter("host_list"),
        str(rospy.get_param("~odometry", "")),
        _list_parameter("tf_frames"),
        str(rospy.get_param("~config", "")),
        _receive_parameter(),
    )


def unknown_arguments(arguments: Sequence[str]) -> str:
    """The fault of the command line; "" if there is none. rospy takes any `name:=value` and ignores all else.

    The launch file gives the bridge a path, too, which means nothing.
    """
    for argument in arguments:
        name, assigned, _ = argument.partition(":=")
        if not assigned and argument.startswith("-"):
            return "{}: expected _NAME:=VALUE with one of {}".format(argument, ", ".join(_PARAMETERS))
        if assigned and name[:1] == "_" and name[1:2] != "_" and name[1:] not in _PARAMETERS:
            return "{}: expected one of {}".format(argument, ", ".join("_" + known for known in _PARAMETERS))
    return ""


_PARAMETERS = Parameters._fields


def _receive_parameter() -> list[Receive]:
    """`~receive`; without a valid entry, everything is received."""
    found: list[Receive] = []
    for entry in _list_parameter("receive"):
        try:
            found.append(parse_receive(str(entry)))
        except ValueError as error:
            log.error("parameter-refused receive: %s", error)
    return found


def _list_parameter(name: str) -> list[object]:
    value = rospy.get_param("~" + name, [])
    if isinstance(value, list):
        return value
    log.error("parameter-refused %s: expected a list, found %r", name, value)
    return []
