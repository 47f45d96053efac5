"""Topologies for tests of relays: chains and rings of nodes, each link a network of its own."""

from __future__ import annotations

from collections.abc import Callable

from udp_mesh.core.events import Event
from udp_mesh.core.relaying.conditions import RelayConditions
from udp_mesh.core.settings import RelaySettings, Settings, Topic
from udp_mesh.crypto import Key
from udp_mesh.sim.topology import Topology

KEY = Key(bytes(range(32)))
EVERY = RelaySettings(all=True)


def node(name: str, relay: RelaySettings | None = None, *topics: Topic, keys: tuple[Key, ...] = (KEY,)) -> Settings:
    return Settings(name=name, keys=keys, topics=topics, undeclared=Topic("any"), relay=relay or RelaySettings())


def chain(count: int, seed: int = 1, *, loss: float = 0.0, relay: RelaySettings = EVERY) -> Topology:
    """n1 - n2 - ... : those between the ends relay. The networks are called after their left end."""
    topology = Topology(seed)
    for number in range(1, count):
        topology.network(f"n{number}", loss=loss)
    for number in range(1, count + 1):
        networks = [f"n{number - 1}"] * (number > 1) + [f"n{number}"] * (number < count)
        topology.add(node(f"n{number}", relay if 1 < number < count else None), networks)
    return topology


def ring(seed: int = 1, *, loss: float = 0.0, make: Callable[[int], Topology] = Topology) -> Topology:
    """a and d are joined by two paths: a - b - d and a - c - e - d."""
    topology = make(seed)
    for network in ("ab", "bd", "ac", "ce", "ed"):
        topology.network(network, loss=loss)
    topology.add(node("a"), ["ab", "ac"])
    for name, networks in (("b", ["ab", "bd"]), ("c", ["ac", "ce"]), ("e", ["ce", "ed"])):
        topology.add(node(name, EVERY), networks)
    topology.add(node("d"), ["bd", "ed"])
    return topology


def online(topology: Topology, at: str, name: str) -> bool:
    return any(peer.name == name and peer.online for peer in topology.conditions(at).peers)


def reported(topology: Topology, name: str, kind: type[Event]) -> list[tuple[float, Event]]:
    return [(at, event) for at, event in topology.events[name] if isinstance(event, kind)]


def relaying(topology: Topology, name: str) -> RelayConditions:
    return topology.nodes[name].relaying(topology.now)


def via(topology: Topology, at: str, name: str) -> tuple[str, ...]:
    return next((route.via for route in relaying(topology, at).routes if route.name == name), ())
