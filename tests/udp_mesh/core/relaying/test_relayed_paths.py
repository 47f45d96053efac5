"""Nodes behind relays are peers like others: discovery, messages, outcomes, other paths, priority."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.udp_mesh.core.relaying.topologies import EVERY, chain, node, online, relaying, reported, ring, via
from udp_mesh.core.events import MessageDelivered, MessageReceived, PeerOffline, PeerOnline, PeerRouteChanged
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import RELAY_LINK, RelaySettings, Topic
from udp_mesh.crypto import Key
from udp_mesh.sim.topology import Topology
from udp_mesh.wire.relay import RELAY_BYTE


def test_the_ends_of_a_chain_of_four_meet_and_each_message_arrives_once() -> None:
    topology = chain(4)
    assert topology.run(5, lambda: online(topology, "n1", "n4") and online(topology, "n4", "n1"))
    topology.send("n1", "map", bytes(200_000), destination="n4")
    topology.run(3)
    assert via(topology, "n1", "n4") == ("n2", "n3")
    relays = {peer.name: peer.via for peer in topology.conditions("n1").peers}
    assert relays == {"n2": (), "n3": ("n2",), "n4": ("n2", "n3")}
    assert len(reported(topology, "n4", MessageReceived)) == 1
    assert len(reported(topology, "n1", MessageDelivered)) == 1
    assert relaying(topology, "n2").counters.dropped_loop == 0


def test_every_message_arrives_once_although_every_hop_loses_a_tenth() -> None:
    topology = chain(4, loss=0.1)
    topology.run(12, lambda: online(topology, "n1", "n4") and online(topology, "n4", "n1"))
    for _ in range(50):
        topology.send("n1", "note", bytes(300), destination="n4")
    topology.run(10)
    assert len(reported(topology, "n4", MessageReceived)) == 50
    assert len(reported(topology, "n1", MessageDelivered)) == 50


def test_a_broadcast_reaches_nodes_behind_relays() -> None:
    topology = chain(3)
    topology.run(4)
    topology.send("n1", "status", b"to all")
    topology.run(1)
    assert len(reported(topology, "n3", MessageReceived)) == 1


def test_a_path_longer_than_configured_is_not_used() -> None:
    topology = chain(4, relay=RelaySettings(all=True, hops=2))
    topology.run(6)
    assert online(topology, "n1", "n3")
    assert not online(topology, "n1", "n4")


def test_a_relay_for_named_nodes_passes_on_only_what_is_to_or_from_them() -> None:
    topology = Topology()
    for network in ("mesh", "tether", "other"):
        topology.network(network)
    topology.add(node("base"), ["mesh"])
    topology.add(node("uav"), ["tether"])
    topology.add(node("stranger"), ["other"])
    topology.add(node("husky", RelaySettings(names=("uav",))), ["mesh", "tether", "other"])
    topology.run(6)
    assert online(topology, "base", "uav")
    assert online(topology, "uav", "base")
    assert not online(topology, "base", "stranger")


def hidden_ends(relay: RelaySettings) -> Topology:
    """One network on which `base` and `uav` hear `husky` alone."""
    topology = Topology()
    topology.network("mesh").losses = {("base", "uav"): 1.0, ("uav", "base"): 1.0}
    for name in ("base", "uav"):
        topology.add(node(name), ["mesh"])
    topology.add(node("husky", relay), ["mesh"])
    return topology


def test_a_relay_with_one_link_joins_nodes_of_its_network_that_do_not_hear_each_other() -> None:
    topology = hidden_ends(RelaySettings(("uav",)))
    assert topology.run(10, lambda: online(topology, "base", "uav") and online(topology, "uav", "base"))
    topology.send("base", "map", bytes(50_000), destination="uav")
    topology.run(3)
    assert via(topology, "base", "uav") == ("husky",)
    assert len(reported(topology, "uav", MessageReceived)) == 1
    assert len(reported(topology, "base", MessageDelivered)) == 1


@pytest.mark.parametrize("off", [RelaySettings(), RelaySettings(hops=1)])
def test_a_running_node_becomes_a_relay_and_none_again(off: RelaySettings) -> None:
    topology = hidden_ends(off)
    topology.run(10)
    assert online(topology, "base", "husky")
    assert not online(topology, "base", "uav")
    husky = topology.nodes["husky"]
    husky.apply(node("husky", RelaySettings(("uav",))), topology.now)
    assert topology.run(15, lambda: online(topology, "base", "uav") and online(topology, "uav", "base"))
    husky.apply(node("husky", off), topology.now)
    assert topology.run(60, lambda: not online(topology, "base", "uav") and not online(topology, "uav", "base"))
    assert online(topology, "base", "husky")


def test_a_relay_that_dies_is_replaced_by_the_other_path_and_nothing_is_lost() -> None:
    topology = ring()
    topology.run(6)
    assert via(topology, "a", "d") == ("b",)
    topology.send("a", "map", bytes(2_000_000), destination="d")
    topology.run(0.5)
    died_at = topology.now
    topology.stop("b")
    assert topology.run(30, lambda: bool(reported(topology, "a", MessageDelivered)))
    assert via(topology, "a", "d") == ("c", "e")
    changed = [at for at, event in reported(topology, "a", PeerRouteChanged) if at > died_at]
    assert changed
    assert changed[0] - died_at < 3.0
    assert len(reported(topology, "d", MessageReceived)) == 1
    assert not [at for at, event in reported(topology, "a", PeerOffline) if event.peer == "d"]  # type: ignore[union-attr]


def test_a_direct_link_replaces_the_relay_once_there_is_one() -> None:
    topology = chain(3)
    topology.network("direct")
    topology.run(5)
    assert next(peer for peer in topology.conditions("n1").peers if peer.name == "n3").link == RELAY_LINK
    for name in ("n1", "n3"):
        topology.connect(name, "direct")
    topology.run(6)
    assert next(peer for peer in topology.conditions("n1").peers if peer.name == "n3").link == "direct"


def test_a_relay_without_the_fleet_key_passes_on_what_it_cannot_read_and_is_distinguished() -> None:
    hop_keys = (Key(b"\x07" * 32),)
    other = Key(b"\x09" * 32)
    topology = Topology()
    for network in ("left", "right"):
        topology.network(network)
    ends = RelaySettings(keys=hop_keys)
    topology.add(node("a", ends), ["left"])
    topology.add(node("foreign", RelaySettings(all=True, keys=hop_keys), keys=(other,)), ["left", "right"])
    topology.add(node("d", ends), ["right"])
    topology.run(8)
    topology.send("a", "map", bytes(50_000), destination="d")
    topology.run(3)
    assert len(reported(topology, "d", MessageReceived)) == 1
    assert not reported(topology, "foreign", PeerOnline)
    (route,) = relaying(topology, "a").routes
    assert (route.name, route.via, route.readable_by, route.common_key) == ("d", ("foreign",), (), True)
    (neighbour,) = relaying(topology, "a").neighbours
    assert not neighbour.member
    member = chain(3)
    member.run(5)
    assert relaying(member, "n1").routes[0].readable_by == ("n2",)


def test_a_node_without_relays_keeps_working_beside_those_with_them_and_sees_none_of_their_datagrams() -> None:
    topology = chain(3)
    seen: list[Datagram] = []
    old = replace(node("old"), relay=RelaySettings(hops=1))
    topology.network("plain")
    topology.add(old, ["plain"])
    topology.connect("n2", "plain")
    topology.on_datagram = lambda name, network, datagram, now: (
        seen.append(datagram) if network == "plain" and datagram.data[0] == RELAY_BYTE else None
    )
    topology.run(6)
    assert online(topology, "n2", "old")
    assert online(topology, "n1", "n3")
    assert not seen


def test_a_fleet_without_relays_sends_no_relay_datagram() -> None:
    topology = Topology()
    topology.network("mesh")
    seen: list[Datagram] = []
    topology.on_datagram = lambda name, network, datagram, now: (
        seen.append(datagram) if datagram.data[0] == RELAY_BYTE else None
    )
    for name in ("a", "b", "c"):
        topology.add(node(name), ["mesh"])
    topology.run(10)
    assert online(topology, "a", "c")
    assert not seen


@pytest.mark.parametrize("seed", [1, 2])
def test_urgent_messages_overtake_bulk_in_a_busy_relay(seed: int) -> None:
    topology = Topology(seed)
    topology.network("fast", rate_bits_per_s=50e6)
    topology.network("slow", rate_bits_per_s=5e6)
    topics = (Topic("stop", priority=0), Topic("bulk", priority=15))
    for name, relay, networks in (
        ("a", None, ["fast"]),
        ("b", None, ["fast"]),
        ("r", EVERY, ["fast", "slow"]),
        ("d", None, ["slow"]),
    ):
        topology.add(node(name, relay, *topics), networks)
    topology.run(6)
    for name in ("b", "r"):
        for _ in range(10):
            topology.send(name, "bulk", bytes(1_000_000), destination="d")
    topology.run(2)
    for _ in range(40):
        topology.send("a", "stop", bytes(100), destination="d")
        topology.run(0.05)
    topology.run(1)
    latencies = [event.latency_s for _, event in reported(topology, "a", MessageDelivered)]  # type: ignore[union-attr]
    assert len(latencies) == 40
    # Two hops of 5 ms there and back, and what the network of the slow hop has queued of two bulk flows.
    assert sorted(latencies)[38] < 0.1


def test_the_path_mtu_behind_a_relay_is_known_before_anything_is_lost() -> None:
    topology = Topology()
    topology.network("wide")
    topology.network("narrow", mtu=1000)
    topology.add(node("a"), ["wide"])
    topology.add(node("r", EVERY), ["wide", "narrow"])
    topology.add(node("d"), ["narrow"])
    topology.run(6)
    topology.send("a", "map", bytes(100_000), destination="d")
    topology.run(3)
    assert topology.networks["narrow"].dropped == 0
    assert len(reported(topology, "d", MessageReceived)) == 1


def test_what_is_sent_to_a_node_whose_only_relay_died_is_counted_and_leaves_on_no_link() -> None:
    topology = hidden_ends(RelaySettings(("uav",)))
    assert topology.run(10, lambda: online(topology, "base", "uav") and online(topology, "uav", "base"))
    topology.stop("husky")
    before = relaying(topology, "base").counters.dropped_unreachable
    topology.send("base", "map", bytes(50_000), destination="uav")
    # The network refuses a link that it does not have.
    topology.run(40)
    assert relaying(topology, "base").counters.dropped_unreachable > before
    topology.add(node("husky", RelaySettings(("uav",))), ["mesh"])
    assert topology.run(20, lambda: len(reported(topology, "uav", MessageReceived)) == 1)
