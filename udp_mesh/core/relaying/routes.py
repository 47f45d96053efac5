"""The next hop to each node behind a relay, by least cost, free of loops.

Distance vectors with the feasibility condition of DSDV and Babel (RFC 8966, 2.4): every node numbers its own hellos,
and an entry carries the number it follows from. A relay uses an entry only if that is newer than what it last announced
for the node, or of the same age and nearer than it announced: so no two relays ever point at each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from udp_mesh.core.relaying.neighbors import HopNeighbor
from udp_mesh.wire.relay import UNREACHABLE, RelayedNode

KEEP_FACTOR = 1.25
"""A route is left for another one only if that is better by this factor: costs are measured and fluctuate."""
OFFER_FOR_INTERVALS = 3.5
"""Intervals of its relay after which an entry that is not repeated is gone."""
MAX_OFFERS = 4096
"""Entries kept, over all neighbors: a member that invents nodes."""
INFEASIBLE_FOR_S = 30.0
"""A node whose offers were all infeasible for this long is treated as new: the node that announced a later round of it
than there is has gone, and nothing that follows from our own announcement is left."""
RETRACT_ROUNDS = 3
"""Hellos in which a lost node is listed as unreachable: one may be lost."""


class HopRoute(NamedTuple):
    """How a node is reached."""

    boot_id: bytes
    name: str
    via: bytes
    """Boot id of the next hop: that of a relay, or the node's own."""
    hops: int
    cost: int
    mtu: int
    round: int
    open: bool
    proofs: tuple[bytes, ...]

    @property
    def direct(self) -> bool:
        return self.via == self.boot_id


class _Offer(NamedTuple):
    node: RelayedNode
    at: float


class Routes:
    """`selected` maps boot ids to routes. `own_round` is that of our newest hello."""

    def __init__(self) -> None:
        self.selected: dict[bytes, HopRoute] = {}
        self._offers: dict[bytes, dict[bytes, _Offer]] = {}
        """By node, then by the relay that offers it."""
        self._count = 0
        self._announced: dict[bytes, tuple[int, int]] = {}
        """What this node last announced: round and least cost. No larger offer is used (feasibility)."""
        self._infeasible_since: dict[bytes, float] = {}
        self._retracting: dict[bytes, tuple[HopRoute, int]] = {}

    def on_offers(self, relay: bytes, nodes: Iterable[RelayedNode], own: bytes, now: float) -> set[bytes]:
        """Record the entries of a hello; returns the nodes they are about."""
        about = set()
        for node in nodes:
            if node.boot_id in (own, relay):
                continue
            about.add(node.boot_id)
            offers = self._offers.get(node.boot_id, {})
            known = relay in offers
            if node.cost == UNREACHABLE:
                if known:
                    self._remove(node.boot_id, relay)
            elif known or self._count < MAX_OFFERS:
                self._count += not known
                self._offers.setdefault(node.boot_id, {})[relay] = _Offer(node, now)
        return about

    def _remove(self, boot_id: bytes, relay: bytes) -> None:
        offers = self._offers[boot_id]
        del offers[relay]
        self._count -= 1
        if not offers:
            del self._offers[boot_id]

    def expire(self, neighbors: Mapping[bytes, HopNeighbor], now: float) -> None:
        """Drop entries that were not repeated, or whose relay is gone."""
        for boot_id, offers in list(self._offers.items()):
            for relay, offer in list(offers.items()):
                neighbor = neighbors.get(relay)
                if neighbor is None or now - offer.at > OFFER_FOR_INTERVALS * neighbor.interval_s:
                    self._remove(boot_id, relay)

    def known(self) -> set[bytes]:
        """Every node that is offered or selected."""
        return set(self._offers) | set(self.selected)

    def names(self) -> dict[bytes, str]:
        """Boot id -> name of every node that a relay offers."""
        return {
            boot_id: offer.node.name for boot_id, offers in self._offers.items() for offer in list(offers.values())[:1]
        }

    def select(
        self,
        boot_ids: Iterable[bytes],
        neighbors: Mapping[bytes, HopNeighbor],
        own_round: int,
        max_hops: int,
        now: float,
    ) -> list[tuple[HopRoute | None, HopRoute | None]]:
        """Choose the routes to these nodes again. Returns (before, after) of those that changed their next hop."""
        changed = []
        costs = {boot_id: neighbor.cost(own_round, now) for boot_id, neighbor in neighbors.items()}
        for boot_id in boot_ids:
            before = self.selected.get(boot_id)
            candidates = [
                route for route in self._candidates(boot_id, neighbors, costs, own_round, now) if route.hops <= max_hops
            ]
            after = min(candidates, key=lambda route: (route.cost, route.hops, route.via), default=None)
            if before is not None and after is not None and after.via != before.via:
                kept = next((route for route in candidates if route.via == before.via), None)
                if kept is not None and kept.cost < KEEP_FACTOR * after.cost:
                    after = kept
            if after is not None:
                self.selected[boot_id] = after
                self._retracting.pop(boot_id, None)
            elif before is not None:
                del self.selected[boot_id]
                self._retracting[boot_id] = (before, RETRACT_ROUNDS)
            if (before and before.via) != (after and after.via):
                changed.append((before, after))
        return changed

    def _candidates(
        self,
        boot_id: bytes,
        neighbors: Mapping[bytes, HopNeighbor],
        costs: Mapping[bytes, int | None],
        own_round: int,
        now: float,
    ) -> Iterable[HopRoute]:
        direct, cost = neighbors.get(boot_id), costs.get(boot_id)
        if direct is not None and cost is not None:
            link = direct.best_link(own_round, now)
            mtu = link.mtu if link is not None else 0
            yield HopRoute(boot_id, direct.name, boot_id, 1, cost, mtu, direct.round, True, direct.proofs)
        for relay, offer in self._offers.get(boot_id, {}).items():
            node, cost = offer.node, costs.get(relay)
            neighbor = neighbors.get(relay)
            if neighbor is None or cost is None or not neighbor.relays or not (node.open or neighbor.passes_us):
                continue
            if not self._is_feasible(node):
                continue
            link = neighbor.best_link(own_round, now)
            mtu = min(node.mtu, link.mtu if link is not None else node.mtu)
            total = min(UNREACHABLE - 1, node.cost + cost)
            yield HopRoute(boot_id, node.name, relay, node.hops + 1, total, mtu, node.round, node.open, node.proofs)

    def _is_feasible(self, node: RelayedNode) -> bool:
        announced = self._announced.get(node.boot_id)
        return (
            announced is None or node.round > announced[0] or (node.round == announced[0] and node.cost < announced[1])
        )

    def announce(self, max_hops: int, is_open: Mapping[str, bool] | None) -> list[RelayedNode]:
        """The entries of the next hello. `is_open` says so by name (None: every node is open)."""
        nodes = []
        for boot_id, route in self.selected.items():
            if route.hops + 1 > max_hops:
                continue
            announced = self._announced.get(boot_id)
            if announced is None or route.round > announced[0]:
                self._announced[boot_id] = (route.round, route.cost)
            elif route.round == announced[0]:
                self._announced[boot_id] = (announced[0], min(announced[1], route.cost))
            opened = route.open and (is_open is None or is_open.get(route.name, False))
            nodes.append(_entry(route, route.cost, opened))
        for boot_id, (route, rounds) in list(self._retracting.items()):
            nodes.append(_entry(route, UNREACHABLE, True))
            if rounds > 1:
                self._retracting[boot_id] = (route, rounds - 1)
            else:
                del self._retracting[boot_id]
        return nodes

    def forget_announced(self, now: float) -> None:
        """Drop what was announced for nodes that are no longer offered, so that restarted boots do not accumulate, or
        only in ways that are infeasible."""
        for boot_id in list(self._announced):
            if boot_id in self.selected or boot_id in self._retracting:
                self._infeasible_since.pop(boot_id, None)
            elif (
                boot_id not in self._offers or now - self._infeasible_since.setdefault(boot_id, now) > INFEASIBLE_FOR_S
            ):
                del self._announced[boot_id]
                self._infeasible_since.pop(boot_id, None)


def _entry(route: HopRoute, cost: int, opened: bool) -> RelayedNode:
    return RelayedNode(
        route.boot_id, route.round, cost, min(route.hops, 8), route.mtu, opened, route.name, route.proofs
    )
