"""Laws of turning nodes' reports into one graph."""

from __future__ import annotations

from meshctl.topology import HeardNeighbor, Link, Report, Sighting, heard_by_name, observed_graph, seen_by

BASE = Report("base", ("02:00:00:00:00:01",), (HeardNeighbor("02:00:00:00:00:02", 100, 0.9),))
B01 = Report(
    "b01",
    ("02:00:00:00:00:02",),
    (HeardNeighbor("02:00:00:00:00:01", 200, 0.7), HeardNeighbor("02:00:00:00:00:03", 4000, 0.5, -71)),
)


def test_a_link_has_the_worse_quality_of_its_two_directions() -> None:
    graph = observed_graph([BASE, B01])
    assert graph.neighbors["base"]["b01"].quality == graph.neighbors["b01"]["base"].quality == 0.7


def test_an_unresponsive_node_is_identified_in_the_graph_by_its_known_mac() -> None:
    graph = observed_graph([BASE, B01], known_macs={"02:00:00:00:00:03": "b02"})
    assert graph.neighbors["b02"]["b01"].quality == 0.5


def test_an_unknown_node_is_listed_by_its_mac() -> None:
    assert "02:00:00:00:00:03" in observed_graph([BASE, B01])


def test_a_stale_neighbor_is_not_a_link() -> None:
    stale = Report("b01", ("02:00:00:00:00:02",), (HeardNeighbor("02:00:00:00:00:01", 60_000, 1.0),))
    assert observed_graph([stale], known_macs={"02:00:00:00:00:01": "base"}).links == ()


def test_two_radios_of_a_robot_are_joined_by_their_wire() -> None:
    graph = observed_graph([Report("front", ()), Report("rear", ())], wires=[("front", "rear")])
    assert graph.links == (Link("front", "rear", 1.0, wired=True),)


def test_the_nodes_that_hear_an_unreachable_one_are_listed_with_age() -> None:
    assert seen_by([BASE, B01], {"02:00:00:00:00:03": "b02"})["b02"] == (Sighting("b01", 4000, -71),)


def test_the_best_measured_radio_of_a_neighbor_is_used() -> None:
    names = {"02:00:00:00:00:01": "husky", "02:00:00:00:00:02": "husky", "02:00:00:00:00:03": "husky"}
    front, rear = HeardNeighbor("02:00:00:00:00:01", 100, 0.4, -60), HeardNeighbor("02:00:00:00:00:02", 900, 0.8, -75)
    unmeasured = HeardNeighbor("02:00:00:00:00:03", 10, None, -40)
    assert heard_by_name(Report("base", (), (front, rear, unmeasured)), names) == {"husky": rear}
    assert heard_by_name(Report("base", (), (unmeasured, front)), names) == {"husky": front}


def test_a_second_radio_has_the_quality_of_the_path_that_ends_there() -> None:
    """A relay whose originator has the address of its first radio is heard on its second one."""
    names = {"02:00:00:00:00:01": "relay", "02:00:00:00:00:02": "relay", "02:00:00:00:00:03": "base"}
    paths = {"02:00:00:00:00:01": 0.6, "02:00:00:00:00:03": 0.5}
    end = Report("end", (), (HeardNeighbor("02:00:00:00:00:02", 10, paths=paths),))
    assert heard_by_name(end, names)["relay"].quality == 0.6
    graph = observed_graph([end], known_macs=names)
    assert graph.neighbors["end"]["relay"].quality == 0.6


def test_without_quality_the_strongest_signal_wins_then_the_latest_sighting() -> None:
    names = {"02:00:00:00:00:01": "husky", "02:00:00:00:00:02": "husky"}
    weak, strong = HeardNeighbor("02:00:00:00:00:01", 10, None, -80), HeardNeighbor("02:00:00:00:00:02", 900, None, -60)
    assert heard_by_name(Report("base", (), (weak, strong)), names) == {"husky": strong}
    early, late = HeardNeighbor("02:00:00:00:00:01", 900), HeardNeighbor("02:00:00:00:00:02", 10)
    assert heard_by_name(Report("base", (), (early, late)), names) == {"husky": late}


def test_a_node_is_not_its_own_neighbor() -> None:
    own = Report("husky", ("02:00:00:00:00:01",), (HeardNeighbor("02:00:00:00:00:02", 10, 0.9),))
    assert heard_by_name(own, {"02:00:00:00:00:02": "husky"}) == {}
