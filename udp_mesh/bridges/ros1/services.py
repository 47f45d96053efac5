"""Services of ROS 1 across the mesh: `calls`, joined to rospy.

Requests and responses stay bytes: a proxy is a rospy.Service whose messages are opaque, with the type and md5sum that
the real server reports, so no message package is needed here. Three kinds of threads meet in `Calls`, under one lock:
the daemon client's, rospy's (one per caller, which waits until its call ends), and one per request of another robot.
Only the main thread, in `refresh`, talks to the master: it looks for servers, and creates and removes proxies.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, Callable, Deque, Dict, Iterable, List, NamedTuple, Optional, Tuple, Union

import rosgraph
import rospy

from udp_mesh.bridges.call_messages import Offer
from udp_mesh.bridges.calls import AddProxy, CallEffect, Finish, Invoke, RemoveProxy, SendCall, Warn
from udp_mesh.bridges.configuration import ServiceOptions
from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.mesh_calls import MeshCalls
from udp_mesh.bridges.names import inbound_name
from udp_mesh.bridges.ros1.service_client import ServiceError, ServiceType, call_service, service_type

TOPIC = "bridge/ros1-calls"
PROBE_S = 0.5
"""For a server to report its type: it is on this robot."""
PROBE_INTERVAL_S = 3.0
"""A server that crashed stays registered with the master."""
MAX_INVOKED = 64
"""Requests of other robots in progress: each has a thread and a connection."""


class _Waiting:
    """A local caller's call, until `finish`."""

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._error, self._response = "", b""

    def finish(self, error: str, response: bytes) -> None:
        self._error, self._response = error, response
        self._ended.set()

    def response(self) -> bytes:
        """Waits for the end. Raises rospy.ServiceException with the reason if there is no response."""
        self._ended.wait()
        if self._error:
            raise rospy.ServiceException(self._error)
        return self._response


class _Server(NamedTuple):
    uri: str
    type: ServiceType
    seen_at: float


class Ros1Calls(MeshCalls):
    """Services that are offered here, and proxies for those of the peers."""

    def __init__(
        self,
        daemon: DaemonClient,
        own: str,
        services: Dict[str, ServiceOptions],
        run: str,
        on_offer: Callable[[str, Offer], bool] = lambda peer, offer: False,
        on_withdrawn: Callable[[str, str], bool] = lambda peer, name: False,
    ) -> None:
        """`on_offer` and `on_withdrawn`: what a peer offers or no longer does, before it is taken for a service; True
        if it is none."""
        self._on_offer, self._on_withdrawn = on_offer, on_withdrawn
        super().__init__(daemon, TOPIC, run)
        self._own, self._services = own, dict(services)
        self._lock = threading.Lock()
        self._waiting: Dict[int, _Waiting] = {}
        self._changes: Deque[Union[AddProxy, RemoveProxy]] = deque()
        self._proxies: Dict[Tuple[str, str], Any] = {}
        self._servers: Dict[str, _Server] = {}
        self._invoked = 0

    # Any thread

    def _take(self, work: Callable[[], List[CallEffect]]) -> None:
        with self._lock:
            self._execute(work())

    def _execute(self, effects: Iterable[CallEffect]) -> None:
        """Under the lock. None of these waits."""
        for effect in effects:
            if isinstance(effect, SendCall):
                self._daemon.publish(TOPIC, effect.payload, effect.peer, "call")
            elif isinstance(effect, (AddProxy, RemoveProxy)):
                self._changes.append(effect)
            elif isinstance(effect, Invoke):
                self._invoke(effect)
            elif isinstance(effect, Finish):
                self._waiting.pop(effect.number).finish(effect.error, effect.response)
            elif isinstance(effect, Warn):
                self._warn_once(effect.text)

    # The main thread

    def tick(self, now: float) -> None:
        """Ends calls whose time is over."""
        self._take(lambda: self._calls.tick(now))

    def refresh(self, more: Iterable[Offer] = ()) -> None:
        """Offers `more` and those of the configured services that have a server now, and creates and removes proxies.
        Waits for the master, and raises one of MASTER_ERRORS."""
        offers = list(more)
        for name, options in self._services.items():
            found = self._server(name)
            if found is not None:
                offers.append(Offer(name, found.name, found.md5sum, options.timeout_s))
        offered = {offer.name for offer in offers}
        self.note_missing("service", [name for name in self._services if name not in offered])
        self._take(lambda: self._calls.offer(offers))
        while self._changes:
            change = self._changes.popleft()
            if isinstance(change, AddProxy):
                if not self._on_offer(change.peer, change.offer):
                    self._add_proxy(change.peer, change.offer)
            elif not self._on_withdrawn(change.peer, change.name):
                self._remove_proxy(change.peer, change.name)

    def _server(self, name: str) -> Optional[ServiceType]:
        """The type of the service's server; None without one that answers."""
        known, now = self._servers.get(name), time.monotonic()
        try:
            uri = str(rosgraph.Master(rospy.get_name()).lookupService(name))
            if known is None or known.uri != uri or now - known.seen_at >= PROBE_INTERVAL_S:
                known = _Server(uri, service_type(uri, name, rospy.get_name(), PROBE_S), now)
        except (rosgraph.MasterError, ServiceError) as error:
            if isinstance(error, ServiceError):
                self._warn_once("service-unavailable service={} {}".format(name, error))
            self._servers.pop(name, None)
            return None
        self._servers[name] = known
        return known.type

    def registrations(self) -> List[Tuple[str, str]]:
        """Names and URIs of the proxies, for a master that was restarted."""
        return [(proxy.resolved_name, proxy.uri) for proxy in self._proxies.values()]

    # Callers here

    def _add_proxy(self, peer: str, offer: Offer) -> None:
        self._remove_proxy(peer, offer.name)
        service_class = _opaque_service(offer)

        def serve(request: Any) -> Any:
            response = service_class._response_class()
            response._buff = self._call(peer, offer, bytes(request._buff))
            return response

        name = inbound_name(self._own, peer, offer.name)
        self._proxies[peer, offer.name] = rospy.Service(name, service_class, serve, buff_size=1 << 16)

    def _call(self, peer: str, offer: Offer, request: bytes) -> bytes:
        """Raises rospy.ServiceException with the reason if there is no response."""
        waiting = _Waiting()
        with self._lock:
            number, effects = self._calls.call(peer, offer.name, request, time.monotonic())
            self._waiting[number] = waiting
            self._execute(effects)
        return waiting.response()

    def _remove_proxy(self, peer: str, name: str) -> None:
        proxy = self._proxies.pop((peer, name), None)
        if proxy is not None:
            proxy.shutdown("the peer's service is gone")

    # Callers on other robots

    def _invoke(self, call: Invoke) -> None:
        known = self._servers.get(call.name)
        if known is None or self._invoked >= MAX_INVOKED:
            reason = "has no server now" if known is None else "is busy with {} calls".format(MAX_INVOKED)
            self._execute(self._calls.reply(call, b"", "{} {}".format(call.name, reason)))
            return
        self._invoked += 1
        threading.Thread(target=self._run, args=(call, known), daemon=True).start()

    def _run(self, call: Invoke, server: _Server) -> None:
        error, response, own = "", b"", rospy.get_name()
        try:
            response = call_service(server.uri, call.name, server.type.md5sum, own, call.request, call.timeout_s)
        except ServiceError as failed:
            error = "{}: {}".format(call.name, failed)
        with self._lock:
            self._invoked -= 1
            self._execute(self._calls.reply(call, response, error))


def _opaque_service(offer: Offer) -> Any:
    """A service class as rospy expects one, whose messages are the bytes of the wire."""
    parts = {
        "_{}_class".format(part.lower()): type(part, (rospy.AnyMsg,), {"_type": offer.type + part})
        for part in ("Request", "Response")
    }
    return type("Opaque", (), {"_type": offer.type, "_md5sum": offer.checksum, **parts})
