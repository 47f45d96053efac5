"""Connects subscriptions with the rest of a node: tables asked for, answered and taken in; withheld messages released.

`publish` asks `State.selection` about each message. Messages that it withholds are admitted again here, when they are
due or the peer's table changes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from udp_mesh.core import publish
from udp_mesh.core.events import ExpiryReason, Rejected
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.sender.message import AcceptedMessage
from udp_mesh.core.state import State
from udp_mesh.core.subscriptions.conditions import PeerSubscriptions, SubscriptionConditions
from udp_mesh.core.subscriptions.messages import (
    ASK_TOPIC,
    TABLE_TOPIC,
    Subscription,
    SubscriptionTable,
    decode_message,
    encode_ask,
    is_about_subscriptions,
)
from udp_mesh.core.subscriptions.own import OwnSubscriptions
from udp_mesh.core.subscriptions.selection import Withheld
from udp_mesh.core.subscriptions.table import KnownTable
from udp_mesh.wire.errors import DecodeError


class SelectiveSending:
    """The subscriptions of one node and of its peers."""

    def __init__(self, state: State, now: float) -> None:
        self._state = state
        self._own = OwnSubscriptions(now)
        state.selection.apply(state.settings)
        state.selection.on_drop = self._report
        state.on_subscriptions = self.on_message

    def _report(self, destination: str | None, accepted: AcceptedMessage, reason: ExpiryReason) -> None:
        """A broadcast has no outcome."""
        if destination is not None:
            publish.report_expired(self._state, destination, accepted, reason)

    def apply(self) -> None:
        """Take over changed settings."""
        self._state.selection.apply(self._state.settings)

    def set_subscriptions(self, subscriptions: Iterable[Subscription], now: float) -> None:
        """Set what the programs of this node read from now on. Until the first call, they read everything."""
        self._own.set(subscriptions, now)

    @property
    def next_at(self) -> float:
        return min(self._own.next_at, self._state.selection.next_at)

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        state = self._state
        if state.closed:
            return
        if state.selection.next_at <= now:
            for withheld in state.selection.take_due(now):
                self._admit_again(withheld, now)
            self._ask(now)
        if self._own.next_at <= now:
            for session in self._own.due(now):
                sent = publish.send(state, TABLE_TOPIC, self._own.table(), session.name, "", now)
                self._own.on_announced(session, now, sent=not isinstance(sent, Rejected))

    def _ask(self, now: float) -> None:
        to_ask, self._state.selection.to_ask = self._state.selection.to_ask, {}
        for session in to_ask:
            if session.is_current:
                publish.send(self._state, ASK_TOPIC, encode_ask(), session.name, "", now)

    def _admit_again(self, withheld: Withheld, now: float) -> None:
        if withheld.destination is None:
            publish.broadcast_wanted(self._state, withheld.accepted, now)
        else:
            publish.enqueue(self._state, withheld.destination, withheld.accepted, now)

    def on_message(self, session: Session, topic: str, payload: bytes, now: float) -> bool:
        """Whether the message was one about subscriptions."""
        if not is_about_subscriptions(topic):
            return False
        try:
            table = decode_message(payload)
        except DecodeError:
            self._state.event_queue.counters.dropped_malformed += 1
            return True
        if not self._state.settings.selective:
            return True
        if table is None:
            self._own.on_ask(session, self._state.settings.limits.peers, now)
        else:
            self._on_table(session, table, now)
        return True

    def _on_table(self, session: Session, table: SubscriptionTable, now: float) -> None:
        known = session.subscriptions
        if known is not None and table.generation < known.table.generation:
            # Overtaken by the one after it.
            return
        if known is not None and table.generation == known.table.generation:
            known.confirmed_at = now
        else:
            session.subscriptions = KnownTable(table, now)
        peer = session.peer
        if peer is None or peer.session is not session:
            return
        for withheld in self._state.selection.take_for(peer.name):
            self._admit_again(withheld, now)
        self._drop_unread(peer, now)

    def _drop_unread(self, peer: Peer, now: float) -> None:
        """End the messages that wait for this peer and that no program reads there."""
        state, sender = self._state, peer.sender
        if sender is None:
            return
        for message in list(sender.pending):
            accepted = message.accepted
            if message.started or accepted.broadcast_number is not None:
                continue
            if state.selection.is_unread(peer, accepted.channel.topic, now):
                state.selection.count(peer.name, accepted, ExpiryReason.NOT_WANTED)
                sender.finish(message, ExpiryReason.NOT_WANTED)
        publish.report_ended(state, peer, now)

    def conditions(self) -> SubscriptionConditions:
        """A snapshot."""
        selection = self._state.selection
        peers = []
        for name, peer in sorted(self._state.peer_table.peers.items()):
            table = peer.session.subscriptions if peer.session is not None else None
            read = None if table is None or table.table.everything else table.table.subscriptions
            peers.append(PeerSubscriptions(name, table is not None, read, replace(selection.saved(name))))
        broadcasts = replace(selection.saved(None))
        return SubscriptionConditions(self._state.settings.selective, self._own.shown(), tuple(peers), broadcasts)
