"""Properties of station tables: half deafness and what ends it (docs/lab.md, "What only real radios showed")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from meshlab import mesh_model
from meshlab.mesh_model import Edge, EffectiveState
from meshlab.spec import LinkSpec
from meshlab.station_tables import DEAF_S, EXPIRY_S, StationTables, TrafficClass
from tests.meshlab.test_mesh_model import node

BOOTS = {"a": 1, "b": 1}
A, B = "02:00:00:00:00:01", "02:00:00:00:00:02"


class Pair:
    """Two nodes that hear each other, and a clock."""

    def __init__(self) -> None:
        self.stations = StationTables()
        self.nodes = {"a": node(1, index=21), "b": node(2, index=21)}
        self.now_s = 1000.0
        self.boots = dict(BOOTS)
        self.hear()

    def graph(self) -> Mapping[str, list[Edge]]:
        return mesh_model.edges(self.nodes, [LinkSpec("a", "b")])

    def hear(self, *, after_s: float = 1.0) -> None:
        self.now_s += after_s
        self.stations.update(self.graph(), self.boots, self.now_s)

    def change(self, name: str, **changes: object) -> None:
        cell = replace(self.nodes[name].interfaces[0], **changes)  # type: ignore[arg-type]
        self.nodes[name] = EffectiveState((cell,), self.nodes[name].addresses)

    def restart(self, name: str, *, away_s: float = 1.0) -> None:
        """Recreate the interface; meanwhile no one hears it."""
        cell = self.nodes[name].interfaces[0]
        self.nodes[name] = EffectiveState((), self.nodes[name].addresses)
        self.hear()
        self.nodes[name] = EffectiveState((replace(cell, index=cell.index + 1),), self.nodes[name].addresses)
        self.hear(after_s=away_s)

    def passes(self) -> bool:
        return self.stations.passes("a", self.boots, self.graph()["a"][0])

    def connected_s(self, name: str) -> list[float]:
        return [self.now_s - entry.since_s for entry in self.stations.entries_of(name)]


@pytest.fixture
def pair() -> Pair:
    return Pair()


def test_two_new_neighbors_hear_each_other(pair: Pair) -> None:
    pair.hear(after_s=100)
    assert pair.passes()
    assert pair.connected_s("a") == pair.connected_s("b") == [100]


def test_a_recreated_radio_is_not_heard_by_a_former_neighbor_until_it_deletes_the_entry(pair: Pair) -> None:
    pair.hear(after_s=100)
    pair.restart("b")
    assert not pair.passes()
    assert pair.connected_s("a") == [102]
    assert pair.connected_s("b") == [0]
    pair.stations.delete("a", "mesh0", B, pair.now_s)
    pair.hear()
    assert pair.passes()
    assert pair.connected_s("a") == [0]


def test_a_radio_with_a_new_mac_gets_a_new_entry_and_the_old_one_goes_silent(pair: Pair) -> None:
    pair.change("b", mac="42:00:00:00:00:02", index=22)
    pair.hear(after_s=10)
    assert pair.passes()
    silent = {entry.mac: entry.silent_since_s for entry in pair.stations.entries_of("a")}
    assert silent == {B: pair.now_s, "42:00:00:00:00:02": None}
    pair.hear(after_s=EXPIRY_S)
    assert [entry.mac for entry in pair.stations.entries_of("a")] == ["42:00:00:00:00:02"]


def test_deleting_a_running_radios_entry_blocks_traffic_until_it_deletes_its_own(pair: Pair) -> None:
    pair.stations.delete("a", "mesh0", B, pair.now_s)
    pair.hear()
    assert not pair.passes()
    pair.stations.delete("b", "mesh0", A, pair.now_s)
    pair.hear()
    assert pair.passes()


def test_a_restarted_radio_is_heard_again_after_the_deaf_period(pair: Pair) -> None:
    pair.restart("b")
    pair.hear(after_s=DEAF_S - 1)
    assert not pair.passes()
    pair.hear(after_s=2)
    assert pair.passes()


def test_a_radio_away_past_station_expiry_is_heard_immediately(pair: Pair) -> None:
    cells = pair.nodes["b"].interfaces
    pair.nodes["b"] = EffectiveState()
    pair.hear()
    assert pair.stations.next_change_s() == pair.now_s + EXPIRY_S
    pair.hear(after_s=EXPIRY_S + 1)
    assert pair.stations.entries_of("a") == []
    pair.nodes["b"] = EffectiveState((replace(cells[0], index=22),))
    pair.hear()
    assert pair.passes()


def test_a_brief_link_failure_does_not_clear_stale_station_entries(pair: Pair) -> None:
    pair.restart("b")
    nodes, pair.nodes = pair.nodes, {}
    pair.hear()
    pair.nodes = nodes
    pair.hear()
    assert not pair.passes()


def test_deleting_the_entry_of_a_silent_radio_does_not_block_its_return(pair: Pair) -> None:
    cells = pair.nodes["b"].interfaces
    pair.nodes["b"] = EffectiveState()
    pair.hear()
    pair.stations.delete("a", "mesh0", B, pair.now_s)
    pair.nodes["b"] = EffectiveState((replace(cells[0], index=22),))
    pair.hear()
    assert pair.passes()


def test_a_reboot_clears_the_nodes_own_station_table(pair: Pair) -> None:
    pair.boots["a"] = 2
    pair.hear(after_s=50)
    assert pair.connected_s("a") == [0]
    assert pair.connected_s("b") == [50]
    assert not pair.passes()


@pytest.mark.parametrize("dropped", TrafficClass)
def test_a_stale_entry_may_drop_one_traffic_class_and_pass_the_other(pair: Pair, dropped: TrafficClass) -> None:
    pair.stations = StationTables([dropped])
    pair.hear()
    pair.restart("b")
    edge = pair.graph()["a"][0]
    # a's server answers in a class that its own neighbor b, whose entry of a is new, does not drop
    assert pair.passes() == (dropped is TrafficClass.LOGINS)
    assert pair.stations.logs_in("a", pair.boots, edge) == (dropped is TrafficClass.ORDINARY)
    assert pair.stations.logs_in("b", pair.boots, pair.graph()["b"][0]) == (dropped is TrafficClass.LOGINS)
    pair.stations.delete("a", "mesh0", B, pair.now_s)
    assert pair.passes()
    assert pair.stations.logs_in("a", pair.boots, edge)


def test_deleting_an_entry_that_is_not_stale_drops_every_class(pair: Pair) -> None:
    pair.stations = StationTables([TrafficClass.LOGINS])
    pair.hear()
    pair.stations.delete("a", "mesh0", B, pair.now_s)
    assert not pair.passes()
    assert not pair.stations.logs_in("b", pair.boots, pair.graph()["b"][0])
