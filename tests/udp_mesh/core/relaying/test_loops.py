"""Whatever changes, next hops never form a loop; once the changes end, all that are connected are reached."""

from __future__ import annotations

import random

import pytest

from tests.udp_mesh.core.relaying.topologies import EVERY, node, relaying
from udp_mesh.sim.topology import Topology

MAX_HOPS = EVERY.hops
STEP_S = 0.2


class RandomTopology(Topology):
    """Relays on random networks, whose links fail and return, and which restart."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.choices = random.Random(seed)
        self.homes: dict[str, tuple[str, ...]] = {}
        names = [f"r{number}" for number in range(self.choices.randint(4, 7))]
        networks = [f"net{number}" for number in range(self.choices.randint(3, 7))]
        for network in networks:
            self.network(network, loss=self.choices.choice((0.0, 0.05, 0.2)), delay_s=self.choices.choice((0.002, 0.1)))
        for name in names:
            self.homes[name] = tuple(self.choices.sample(networks, self.choices.randint(1, 3)))
            self.add(node(name, EVERY), self.homes[name])

    def change(self) -> None:
        """Cut or restore a network or one direction of a link, or stop or restart a node."""
        match self.choices.randrange(3):
            case 0:
                network = self.choices.choice(list(self.networks.values()))
                network.up = not network.up
            case 1:
                network = self.choices.choice(list(self.networks.values()))
                if len(network.members) > 1:
                    pair = tuple(self.choices.sample(network.members, 2))
                    network.losses[pair[0], pair[1]] = self.choices.choice((0.0, 0.5, 1.0))
            case _:
                name = self.choices.choice(list(self.homes))
                if name in self.nodes and len(self.nodes) > 2:
                    self.stop(name)
                elif name not in self.nodes:
                    self.add(node(name, EVERY), self.homes[name])

    def repair(self) -> None:
        """All networks and nodes work."""
        for network in self.networks.values():
            network.up, network.loss = True, 0.0
            network.losses.clear()
        for name, home in self.homes.items():
            if name not in self.nodes:
                self.add(node(name, EVERY), home)

    def loops(self) -> list[tuple[str, ...]]:
        """Cycles of next hops toward any node, as they are at this moment."""
        by_boot = {endpoint._state.boot_id: name for name, endpoint in self.nodes.items()}
        found = []
        for target in by_boot:
            for start in self.nodes:
                path, at = [start], start
                while (route := self.nodes[at]._relaying.routes.selected.get(target)) and route.via in by_boot:
                    at = by_boot[route.via]
                    if at in path:
                        found.append((*path, at))
                        break
                    path.append(at)
                    if route.via == target:
                        break
        return found

    def links_between(self, start: str) -> dict[str, int]:
        """The fewest links from a node to every other one."""
        distance, frontier = {start: 0}, [start]
        while frontier:
            at = frontier.pop(0)
            for network in self.homes[at]:
                for other in self.networks[network].members:
                    if other not in distance:
                        distance[other] = distance[at] + 1
                        frontier.append(other)
        return distance


def play(seed: int) -> None:
    """40 s of changes, then none."""
    topology = RandomTopology(seed)
    for _ in range(round(40 / STEP_S)):
        topology.run(STEP_S)
        assert topology.loops() == [], f"at {topology.now:.1f} s"
        if topology.choices.random() < 0.15:
            topology.change()
    topology.repair()
    topology.run(45)
    assert topology.loops() == []
    for name in topology.nodes:
        selected = {route.name for route in topology.nodes[name]._relaying.routes.selected.values()}
        within = {other for other, links in topology.links_between(name).items() if 0 < links <= MAX_HOPS}
        assert within <= selected
    assert sum(relaying(topology, name).counters.dropped_loop for name in topology.nodes) == 0


@pytest.mark.parametrize("seed", range(5))
def test_no_loop_forms_whatever_changes(seed: int) -> None:
    play(seed)


@pytest.mark.proof
@pytest.mark.timeout(3600)
def test_no_loop_forms_in_three_hundred_topologies() -> None:
    for seed in range(300):
        try:
            play(seed)
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error
