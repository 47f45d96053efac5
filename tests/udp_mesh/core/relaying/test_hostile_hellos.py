"""Relay hellos of attackers: without the key, recorded ones, and those of a member that lies."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.relaying.topologies import EVERY, KEY, chain, node, relaying, reported, via
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.relaying.hop_channel import HopChannels
from udp_mesh.core.relaying.relaying import MAX_NEIGHBORS
from udp_mesh.core.relaying.routes import MAX_OFFERS
from udp_mesh.crypto import Key
from udp_mesh.sim.topology import Topology
from udp_mesh.wire.limits import MAX_RELAYED_NODES
from udp_mesh.wire.relay import RELAY_BYTE, RelayedNode, RelayHello, encode_hello

MALLORY = ("10.1.0.99", 8700)


def hello(boot_id: bytes, nodes: tuple[RelayedNode, ...] = (), key: Key = KEY) -> bytes:
    frame = RelayHello("mallory", True, 1000, 1, (), (), nodes)
    return HopChannels((key,), boot_id).seal_hello(encode_hello(frame))


def boot(topology: Topology, name: str) -> bytes:
    return topology.nodes[name]._state.boot_id


def works(topology: Topology) -> bool:
    """Whether a message still goes from one end of a chain of four to the other."""
    before = len(reported(topology, "n1", MessageDelivered))
    topology.send("n1", "note", b"still there", destination="n4")
    return topology.run(20, lambda: len(reported(topology, "n1", MessageDelivered)) > before)


def test_a_hello_under_another_key_is_counted_and_changes_nothing() -> None:
    topology = chain(4)
    topology.run(6)
    before = relaying(topology, "n2")
    lie = RelayedNode(boot(topology, "n4"), 1 << 30, 1, 1, 1500, True, "n4", ())
    topology.nodes["n2"].receive(hello(b"m" * 16, (lie,), Key(b"\x05" * 32)), "n1", MALLORY, topology.now)
    after = relaying(topology, "n2")
    assert after.counters.dropped_unauthenticated == before.counters.dropped_unauthenticated + 1
    assert (after.neighbours, after.routes) == (before.neighbours, before.routes)


def test_recorded_hellos_of_a_dead_relay_bring_no_route_back() -> None:
    topology = chain(4)
    recorded: list[bytes] = []

    def record(name: str, network: str, datagram: Datagram, now: float) -> None:
        if (name, network) == ("n2", "n1") and datagram.data[0] == RELAY_BYTE:
            recorded.append(bytes(datagram.data))

    topology.on_datagram = record
    topology.run(8)
    topology.stop("n2")
    topology.run(15)
    assert via(topology, "n1", "n4") == ()
    before = relaying(topology, "n1").counters.dropped_unauthenticated
    assert recorded
    for data in recorded:
        topology.nodes["n1"].receive(data, "n1", MALLORY, topology.now)
        topology.run(0.1)
        assert via(topology, "n1", "n4") == ()
    assert relaying(topology, "n1").counters.dropped_unauthenticated == before + len(recorded)


@pytest.mark.parametrize("cost", [0, 1, 65_534])
@pytest.mark.parametrize("later_rounds", [1, (1 << 32) - 1])
def test_a_member_that_lies_about_distances_is_forgotten_with_its_lies(cost: int, later_rounds: int) -> None:
    topology = chain(4)
    topology.run(6)
    assert works(topology)
    mallory = topology.add(node("mallory", EVERY), ["n2"])
    target = boot(topology, "n4")
    real = topology.nodes["n4"]._relaying.round
    lie = RelayedNode(target, min((1 << 32) - 1, real + later_rounds), cost, 1, 1500, True, "n4", ())
    mallory._relaying.routes.announce = lambda *_: [lie]  # type: ignore[method-assign]
    topology.run(10)
    topology.stop("mallory")
    topology.run(75)
    assert via(topology, "n2", "n4") == ("n3",)
    assert works(topology)


def test_invented_nodes_and_neighbors_are_bounded() -> None:
    topology = chain(4)
    topology.run(6)
    n2 = topology.nodes["n2"]
    for number in range(2 * MAX_NEIGHBORS):
        own = number.to_bytes(16, "big")
        invented = tuple(
            RelayedNode(bytes((1, entry)) + own[2:], 1, 1, 1, 1500, True, f"m{number}-{entry}", ())
            for entry in range(min(MAX_RELAYED_NODES, 20))
        )
        n2.receive(hello(own, invented), "n1", MALLORY, topology.now)
    routes = n2._relaying.routes
    assert len(n2._relaying.neighbors) <= MAX_NEIGHBORS
    assert routes._count <= MAX_OFFERS
    # None of them answers, so none is used or becomes a peer.
    assert {route.name for route in routes.selected.values()} == {"n1", "n3", "n4"}
    assert sorted(peer.name for peer in topology.conditions("n2").peers) == ["n1", "n3", "n4"]
    topology.run(5)
    assert works(topology)
