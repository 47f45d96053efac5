"""Calls of services across the mesh, as effects for a bridge to execute. Pure: no clock, no ROS.

1. `offer` sets what this robot offers; peers learn it when they come online, and create a proxy per service.
2. `call` sends a local program's request to the peer; the peer's bridge gets an `Invoke` and answers with `reply`.
3. Every call ends exactly once, in `Finish`: with the response, or with the reason why there is none. Reasons are the
   deadline, a peer that goes offline, a peer's bridge that was started again, and a service that is no longer offered.

A request is invoked at most once: it is never sent again, and a number that was seen is not invoked again. A call that
failed may still have been executed, since its response may be what was lost; the error says so. The exception is a
call without a deadline: it only waits for an action's result, so it is sent again when the peer is back.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Dict, Iterable, List, NamedTuple, Optional, Set, Tuple, Union

from udp_mesh.bridges.call_messages import (
    Call,
    CallMessage,
    CallMessageError,
    Event,
    Offer,
    Offers,
    Reply,
    decode_call_message,
    encode_call_message,
)

MAX_PENDING = 256
"""Calls waiting for a response: each holds a thread in ROS 1."""
MAX_SEEN = 4096
"""Numbers of calls remembered, so that none is invoked twice."""
MAY_HAVE_RUN = "the call may have been executed"


class SendCall(NamedTuple):
    """Publish on the calls' mesh topic, to one peer."""

    peer: str
    payload: bytes


class AddProxy(NamedTuple):
    """Create a local server for a peer's service."""

    peer: str
    offer: Offer


class RemoveProxy(NamedTuple):
    """The peer no longer offers this, or is offline: callers must see that the service is not available."""

    peer: str
    name: str


class Invoke(NamedTuple):
    """Call a local service, then `reply`."""

    peer: str
    run: str
    number: int
    name: str
    request: bytes
    timeout_s: float


class Finish(NamedTuple):
    """End a local caller's call: with a response, or (`error` is not "") without."""

    number: int
    error: str
    response: bytes


class Deliver(NamedTuple):
    """Publish a message of a peer's topic beside a service, such as an action's feedback."""

    peer: str
    name: str
    payload: bytes


class Warn(NamedTuple):
    text: str


CallEffect = Union[SendCall, AddProxy, RemoveProxy, Invoke, Finish, Deliver, Warn]


class _Pending(NamedTuple):
    peer: str
    offer: Offer
    deadline: Optional[float]
    offline_since: Optional[float]
    request: bytes


class Calls:
    """Calls of one bridge. Times are monotonic seconds."""

    def __init__(self, run: str) -> None:
        """`run`: random, a new one for each start of the bridge."""
        self._run = run
        self._number = 0
        self._offers: Dict[str, Offer] = {}
        self._events: Dict[str, str] = {}
        self._callers: Dict[str, Set[str]] = {}
        self._runs: Dict[str, str] = {}
        self._proxies: Dict[Tuple[str, str], Offer] = {}
        self._pending: "OrderedDict[int, _Pending]" = OrderedDict()
        self._seen: "OrderedDict[Tuple[str, str, int], None]" = OrderedDict()
        self._online: Set[str] = set()

    # What this robot offers

    def offer(self, offers: Iterable[Offer], events: Iterable[Tuple[str, str]] = ()) -> List[CallEffect]:
        """Sets the services offered now, and by topic the service whose callers get its messages."""
        self._events = dict(events)
        found = {offer.name: offer for offer in offers}
        if found == self._offers:
            return []
        self._offers = found
        return [self._announcement(peer, answer=False) for peer in sorted(self._online)]

    def _announcement(self, peer: str, *, answer: bool) -> CallEffect:
        return self._send(peer, Offers(self._run, tuple(self._offers.values()), answer))

    def _send(self, peer: str, message: CallMessage) -> CallEffect:
        try:
            return SendCall(peer, encode_call_message(message))
        except CallMessageError as error:
            return Warn("services: {}".format(error))

    def event(self, topic: str, payload: bytes) -> List[CallEffect]:
        """A message of an offered action's topic: to those who called it."""
        callers = self._callers.get(self._events.get(topic, ""), set()) & self._online
        return [self._send(peer, Event(topic, payload)) for peer in sorted(callers)]

    def reply(self, invoked: Invoke, response: bytes, error: str = "") -> List[CallEffect]:
        """Answers a peer's call."""
        return [self._send(invoked.peer, Reply(invoked.run, invoked.number, error, response))]

    # What peers offer

    def call(self, peer: str, name: str, request: bytes, now: float) -> Tuple[int, List[CallEffect]]:
        """Sends a local program's request; its number, by which `Finish` names it."""
        self._number += 1
        number = self._number
        offer = self._proxies.get((peer, name))
        if offer is None:
            return number, [Finish(number, "{} does not offer {} now".format(peer, name), b"")]
        if len(self._pending) >= MAX_PENDING:
            return number, [Finish(number, "{} calls are waiting already".format(MAX_PENDING), b"")]
        deadline = now + offer.timeout_s if offer.timeout_s else None
        self._pending[number] = _Pending(peer, offer, deadline, None, b"" if deadline else request)
        return number, [self._send(peer, Call(self._run, number, name, request))]

    # From the mesh

    def from_mesh(self, peer: str, data: bytes) -> List[CallEffect]:
        """Handles a message of a peer's bridge."""
        try:
            message = decode_call_message(data)
        except CallMessageError as error:
            return [Warn("invalid message from {}: {}".format(peer, error))]
        if isinstance(message, Offers):
            return self._on_offers(peer, message)
        if isinstance(message, Call):
            return self._on_call(peer, message)
        if isinstance(message, Event):
            return [Deliver(peer, message.name, message.payload)]
        pending = self._pending.get(message.number)
        if message.run != self._run or pending is None or pending.peer != peer:
            # a reply to an earlier run, or to a call that has ended
            return []
        return [self._finish(message.number, message.error, message.response)]

    def _on_offers(self, peer: str, message: Offers) -> List[CallEffect]:
        effects: List[CallEffect] = []
        self._online.add(peer)
        if self._runs.get(peer, message.run) != message.run:
            reason = "the bridge of {} was started again; {}".format(peer, MAY_HAVE_RUN)
            effects += self._fail(peer, reason)
        self._runs[peer] = message.run
        offered = {offer.name: offer for offer in message.offers}
        for name in [name for other, name in self._proxies if other == peer]:
            if offered.get(name) != self._proxies[peer, name]:
                effects += self._withdraw(peer, name, "{} no longer offers {}".format(peer, name))
        for name, offer in offered.items():
            if (peer, name) not in self._proxies:
                self._proxies[peer, name] = offer
                effects.append(AddProxy(peer, offer))
        for number, each in list(self._pending.items()):
            if each.peer == peer and each.offline_since is not None:
                self._pending[number] = each._replace(offline_since=None)
                effects.append(self._send(peer, Call(self._run, number, each.offer.name, each.request)))
        if message.answer:
            effects.append(self._announcement(peer, answer=False))
        return effects

    def _on_call(self, peer: str, message: Call) -> List[CallEffect]:
        key = (peer, message.run, message.number)
        offer = self._offers.get(message.name)
        if key in self._seen and (offer is None or offer.timeout_s):
            return []
        self._seen[key] = None
        if len(self._seen) > MAX_SEEN:
            self._seen.popitem(last=False)
        if offer is None:
            text = "{} is not offered".format(message.name)
            return [self._send(peer, Reply(message.run, message.number, text, b""))]
        self._callers.setdefault(message.name, set()).add(peer)
        return [Invoke(peer, message.run, message.number, message.name, message.request, offer.timeout_s)]

    # Peers and time

    def on_daemon_up(self, online: Iterable[str]) -> List[CallEffect]:
        """Announces the services after each connect to the daemon."""
        effects: List[CallEffect] = []
        found = set(online)
        for peer in sorted(self._online - found):
            effects += self.on_peer_offline(peer, None)
        for peer in sorted(found):
            effects += self.on_peer_online(peer)
        return effects

    def on_peer_online(self, peer: str) -> List[CallEffect]:
        self._online.add(peer)
        return [self._announcement(peer, answer=True)]

    def on_peer_offline(self, peer: str, now: Optional[float]) -> List[CallEffect]:
        """Ends the peer's calls and withdraws its services. Calls without a deadline (an action's result) end after
        `lost_s` (`tick`); `now` None ends them at once."""
        self._online.discard(peer)
        effects: List[CallEffect] = []
        reason = "{} is offline; {}".format(peer, MAY_HAVE_RUN)
        for number, each in list(self._pending.items()):
            if each.peer != peer:
                continue
            if each.deadline is None and now is not None:
                self._pending[number] = each._replace(offline_since=now)
            else:
                effects.append(self._finish(number, reason, b""))
        kept = {each.offer.name for each in self._pending.values() if each.peer == peer}
        for name in [name for other, name in self._proxies if other == peer and name not in kept]:
            del self._proxies[peer, name]
            effects.append(RemoveProxy(peer, name))
        return effects

    def tick(self, now: float) -> List[CallEffect]:
        """Ends calls whose time is over."""
        effects: List[CallEffect] = []
        for number, each in list(self._pending.items()):
            if each.deadline is not None and now >= each.deadline:
                text = "no response from {} within {:g} s; {}".format(each.peer, each.offer.timeout_s, MAY_HAVE_RUN)
                effects.append(self._finish(number, text, b""))
            elif each.offline_since is not None and now - each.offline_since >= each.offer.lost_s:
                text = "{} has been offline for {:g} s; {}".format(each.peer, each.offer.lost_s, MAY_HAVE_RUN)
                effects.append(self._finish(number, text, b""))
                if each.peer not in self._online:
                    effects += self._withdraw(each.peer, each.offer.name, text)
        return effects

    def _finish(self, number: int, error: str, response: bytes) -> CallEffect:
        del self._pending[number]
        return Finish(number, error, response)

    def _fail(self, peer: str, reason: str, name: Optional[str] = None) -> List[CallEffect]:
        numbers = [
            number
            for number, each in self._pending.items()
            if each.peer == peer and (name is None or each.offer.name == name)
        ]
        return [self._finish(number, reason, b"") for number in numbers]

    def _withdraw(self, peer: str, name: str, reason: str) -> List[CallEffect]:
        effects = self._fail(peer, reason, name)
        if self._proxies.pop((peer, name), None) is not None:
            effects.append(RemoveProxy(peer, name))
        return effects
