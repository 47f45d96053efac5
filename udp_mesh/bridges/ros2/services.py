"""Services and actions of ROS 2 across the mesh: `calls`, joined to rclpy.

An action is three services and two topics below `ACTION/_action/`; each is carried as such, so that goal ids, states
and cancellation are those of the robot's own server. Everything here runs on the executor's thread, except
`on_daemon_up` and `on_frame`, which only queue work for it. No callback waits: a request is answered when the mesh has
answered.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from typing import Any, Callable, Deque, Dict, Iterable, List, Optional, Tuple

from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

from udp_mesh.bridges.call_messages import Offer
from udp_mesh.bridges.calls import AddProxy, CallEffect, Deliver, Finish, Invoke, RemoveProxy, SendCall
from udp_mesh.bridges.configuration import BridgeConfiguration
from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.mesh_calls import MeshCalls
from udp_mesh.bridges.names import inbound_name
from udp_mesh.bridges.ros2.interfaces import failed_response, interface_class, unknown_type
from udp_mesh.bridges.ros2.publishers import steady_timer
from udp_mesh.bridges.ros2.quality import ros2_name

log = logging.getLogger(__name__)

TOPIC = "bridge/ros2-calls"
BAD_BYTES = (RuntimeError, TypeError, ValueError)
"""Exceptions that rclpy raises for bytes that are not of the type."""
TICK_S = 0.2
REFRESH_TICKS = 5
LINGER_S = 5.0
"""A server that goes takes its unread responses with it (seen with Fast DDS 3.2): a busy caller would wait forever."""
SEND_GOAL, GET_RESULT, CANCEL_GOAL = "/_action/send_goal", "/_action/get_result", "/_action/cancel_goal"
FEEDBACK, STATUS = "/_action/feedback", "/_action/status"
STATUS_TYPE = "action_msgs/msg/GoalStatusArray"


class _Proxy:
    """A local server for a peer's service. Its callback returns the call's number; the response follows later."""

    def __init__(self, node: Any, name: str, offer: Offer, call: Callable[[bytes], int]) -> None:
        self.offer = offer
        self._class = interface_class(offer.type, "srv", "action")
        self._headers: Dict[int, Any] = {}
        self._early: Dict[int, Tuple[str, bytes]] = {}
        self.responded_at: Optional[float] = None
        self._service = node.create_service(
            self._class, name, lambda request, _response: call(bytes(serialize_message(request)))
        )
        self._send = self._service.send_response
        # the executor passes what the callback returned, and the request's header
        self._service.send_response = self._defer

    def _defer(self, number: int, header: Any) -> None:
        self._headers[number] = header
        if number in self._early:
            self.finish(number, *self._early.pop(number))

    def finish(self, number: int, error: str, response: bytes) -> None:
        if number not in self._headers:
            # ended inside of the callback
            self._early[number] = (error, response)
            return
        header = self._headers.pop(number)
        answer = None
        if not error:
            try:
                answer = deserialize_message(response, self._class.Response)
            except BAD_BYTES as wrong:
                error = "the response is not of type {}: {}".format(self.offer.type, wrong)
        if error:
            log.warning("call-failed service=%s %s", self.offer.name, error)
            answer = failed_response(self.offer.type, self._class.Response(), error)
        if answer is not None:
            self._send(answer, header)
            self.responded_at = time.monotonic()

    def is_awaited(self, now: float) -> bool:
        """Whether a caller may not have read its response yet."""
        return self.responded_at is not None and now - self.responded_at < LINGER_S

    def destroy(self, node: Any) -> None:
        node.destroy_service(self._service)


class Ros2Calls(MeshCalls):
    """Services and actions that are offered here, and proxies for those of the peers."""

    def __init__(self, node: Any, daemon: DaemonClient, own: str, options: BridgeConfiguration, run: str) -> None:
        super().__init__(daemon, TOPIC, run)
        self._node, self._own, self._options = node, own, options
        self._inbox: Deque[Callable[[], List[CallEffect]]] = deque()
        self._proxies: Dict[Tuple[str, str], _Proxy] = {}
        self._leaving: Dict[Tuple[str, str], _Proxy] = {}
        self._callers: Dict[int, _Proxy] = {}
        self._publishers: Dict[Tuple[str, str], Any] = {}
        self._clients: Dict[str, Tuple[str, Any]] = {}
        self._events: Dict[str, Any] = {}
        self._asked: List[Tuple[float, Any, Any]] = []
        self._ticks = 0
        self._wake = node.create_guard_condition(self._work)
        steady_timer(node, TICK_S, self._tick)

    def _take(self, work: Callable[[], List[CallEffect]]) -> None:
        self._inbox.append(work)
        self._wake.trigger()

    # The executor's thread

    def _work(self) -> None:
        while self._inbox:
            self._execute(self._inbox.popleft()())

    def _tick(self) -> None:
        now = time.monotonic()
        self._work()
        self._execute(self._calls.tick(now))
        for deadline, client, future in [each for each in self._asked if each[0] <= now]:
            client.remove_pending_request(future)
            self._asked.remove((deadline, client, future))
        for key in [key for key, proxy in self._leaving.items() if not proxy.is_awaited(now)]:
            self._leaving.pop(key).destroy(self._node)
        self._ticks += 1
        if self._ticks % REFRESH_TICKS == 1:
            self._refresh()

    def _refresh(self) -> None:
        """Offers those of the configured services and actions that have a server now."""
        if not self._options.services and not self._options.actions:
            return
        found = {name: types[0] for name, types in self._node.get_service_names_and_types()}
        offers = [
            Offer(name, found[name], "", options.timeout_s)
            for name, options in self._options.services.items()
            if name in found and self._client(name, found[name]).service_is_ready()
        ]
        events: List[Tuple[str, str]] = []
        for name, action in self._options.actions.items():
            parts = [(name + SEND_GOAL, action.timeout_s), (name + CANCEL_GOAL, action.timeout_s)]
            parts.append((name + GET_RESULT, 0.0))
            if all(part in found and self._client(part, found[part]).service_is_ready() for part, _ in parts):
                offers += [
                    Offer(part, found[part], "", timeout_s, 0.0 if timeout_s else action.lost_s)
                    for part, timeout_s in parts
                ]
                events += [(name + FEEDBACK, name + SEND_GOAL), (name + STATUS, name + SEND_GOAL)]
                self._watch(name, found[name + SEND_GOAL])
        offered = {offer.name for offer in offers}
        self.note_missing("service", [name for name in self._options.services if name not in offered])
        self.note_missing("action", [name for name in self._options.actions if name + SEND_GOAL not in offered])
        self._execute(self._calls.offer(offers, events))

    def _client(self, name: str, type_name: str) -> Any:
        known = self._clients.get(name)
        if known is None or known[0] != type_name:
            if known is not None:
                self._node.destroy_client(known[1])
            known = (type_name, self._node.create_client(interface_class(type_name, "srv", "action"), name))
            self._clients[name] = known
        return known[1]

    def _watch(self, action: str, type_name: str) -> None:
        """Subscribes to feedback and status of an action that is offered."""
        types = {FEEDBACK: type_name.replace("_SendGoal", "_FeedbackMessage"), STATUS: STATUS_TYPE}
        for suffix, topic_type in types.items():
            name = action + suffix
            if name not in self._events:
                self._events[name] = self._node.create_subscription(
                    interface_class(topic_type, "msg", "action"), name, self._forward(name), _profile(suffix), raw=True
                )

    def _forward(self, name: str) -> Callable[[bytes], None]:
        return lambda data: self._execute(self._calls.event(name, bytes(data)))

    def _execute(self, effects: Iterable[CallEffect]) -> None:
        for effect in effects:
            if isinstance(effect, SendCall):
                self._daemon.publish(TOPIC, effect.payload, effect.peer, "call")
            elif isinstance(effect, AddProxy):
                self._add_proxy(effect.peer, effect.offer)
            elif isinstance(effect, RemoveProxy):
                self._remove_proxy(effect.peer, effect.name)
            elif isinstance(effect, Invoke):
                self._invoke(effect)
            elif isinstance(effect, Finish):
                self._callers.pop(effect.number).finish(*effect)
            elif isinstance(effect, Deliver):
                publisher = self._publishers.get((effect.peer, effect.name))
                if publisher is not None:
                    publisher.publish(effect.payload)
            else:
                self._warn_once(effect.text)

    # Callers here

    def _add_proxy(self, peer: str, offer: Offer) -> None:
        name = self._proxy_name(peer, offer.name)

        def call(request: bytes) -> int:
            number, effects = self._calls.call(peer, offer.name, request, time.monotonic())
            self._callers[number] = proxy
            self._execute(effects)
            return number

        leaving = self._leaving.pop((peer, offer.name), None)
        if leaving is not None and leaving.offer.type != offer.type:
            leaving.destroy(self._node)
            leaving = None
        try:
            # one that is back at once keeps the responses that are not read yet
            proxy = leaving or _Proxy(self._node, name, offer, call)
            if offer.name.endswith(SEND_GOAL):
                self._publish_events(peer, offer)
        except (AttributeError, ModuleNotFoundError, ValueError) as error:
            self._warn_once("{} (service {})".format(unknown_type(offer.type, error), name))
            return
        self._proxies[peer, offer.name] = proxy

    def _proxy_name(self, peer: str, name: str) -> str:
        base, action, part = name.partition("/_action/")
        return ros2_name(inbound_name(self._own, peer, base)) + action + part

    def _publish_events(self, peer: str, offer: Offer) -> None:
        action = offer.name[: -len(SEND_GOAL)]
        types = {FEEDBACK: offer.type.replace("_SendGoal", "_FeedbackMessage"), STATUS: STATUS_TYPE}
        for suffix, type_name in types.items():
            self._publishers[peer, action + suffix] = self._node.create_publisher(
                interface_class(type_name, "msg", "action"),
                self._proxy_name(peer, action + suffix),
                _profile(suffix),
            )

    def _remove_proxy(self, peer: str, name: str) -> None:
        proxy = self._proxies.pop((peer, name), None)
        if proxy is not None and proxy.is_awaited(time.monotonic()):
            self._leaving[peer, name] = proxy
        elif proxy is not None:
            proxy.destroy(self._node)
        if name.endswith(SEND_GOAL):
            for suffix in (FEEDBACK, STATUS):
                publisher = self._publishers.pop((peer, name[: -len(SEND_GOAL)] + suffix), None)
                if publisher is not None:
                    self._node.destroy_publisher(publisher)

    # Callers on other robots

    def _invoke(self, call: Invoke) -> None:
        type_name, client = self._clients[call.name]
        if not client.service_is_ready():
            self._execute(self._calls.reply(call, b"", "{} has no server now".format(call.name)))
            return
        request_class = interface_class(type_name, "srv", "action").Request
        try:
            future = client.call_async(deserialize_message(call.request, request_class))
        except BAD_BYTES as error:
            self._execute(self._calls.reply(call, b"", "the request is not of type {}: {}".format(type_name, error)))
            return
        if call.timeout_s:
            self._asked.append((time.monotonic() + call.timeout_s, client, future))

        def done(ended: Any) -> None:
            self._asked = [each for each in self._asked if each[2] is not ended]
            response = bytes(serialize_message(ended.result()))
            self._execute(self._calls.reply(call, response))

        future.add_done_callback(done)


def _profile(suffix: str) -> Any:
    """rclpy's own for an action's topics."""
    latched = suffix == STATUS
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=1 if latched else 10, durability=durability)
