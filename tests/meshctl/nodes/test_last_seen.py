"""The report about an unreachable node: when it was last seen, and which other nodes hear it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from meshctl.device.observation import MeshNeighbor, Observation, Originator, Station
from meshctl.fleet.journal import LastKnown
from meshctl.nodes.last_seen import LastSeen, last_seen_of
from tests.meshctl.plan.support import fleet, running

LOST = "02:00:00:00:01:03"
KNOWN = {
    "b03": LastKnown(
        "b03", 10_000.0, {"macs": LOST, "uptime_s": "7300", "version": "23.05.5", "revision": "r24106-10cc5fcd00"}
    )
}
NOW_S = 10_095.0


def hears(name: str, age_ms: int, **changes: Any) -> Observation:
    seen = running(fleet(), name, neighbors=())
    return replace(seen, neighbors=(MeshNeighbor(LOST.upper(), "mesh0", age_ms),), **changes)


def of(**observations: Observation) -> LastSeen:
    return last_seen_of(fleet(), ["b03"], observations, KNOWN)["b03"]


def test_the_last_sighting_is_shown_with_the_nodes_that_hear_it_latest_first() -> None:
    stations = (Station("mesh0", LOST, signal_dbm=-61, inactive_ms=40),)
    place = of(b01=hears("b01", 42_000), b02=hears("b02", 400, stations=stations), b04=running(fleet(), "b04"))
    assert place.text(NOW_S) == (
        "last seen 95 s ago (02:46:40 UTC), up 2.0 h then, 23.05.5, r24106-10cc5fcd00; "
        "heard by b02 0.4 s ago (-61 dBm), b01 42 s ago"
    )
    assert place.facts == {"last_seen_s": "10000", "heard_by": "b02:400ms b01:42000ms", "asked": "3"}


def test_without_a_neighbor_that_hears_it_a_known_route_is_shown() -> None:
    far = replace(
        running(fleet(), "base"), originators=(Originator(LOST, "02:00:00:00:01:00", "mesh0", 12_000, True, 90),)
    )
    assert (
        of(base=far).text(NOW_S).endswith("; no reachable neighbor hears it; a route to it is known by base 12 s ago")
    )


def test_if_no_node_hears_it_the_number_of_queried_nodes_is_shown() -> None:
    assert (
        of(b01=running(fleet(), "b01"), b02=running(fleet(), "b02"))
        .text(NOW_S)
        .endswith("; heard by none of the 2 nodes that answered")
    )
    assert of().text(NOW_S).endswith("; no other node is reachable")


def test_a_batman_neighbor_not_heard_for_long_does_not_count() -> None:
    assert of(b01=hears("b01", 200_001)).heard == ()


def test_a_node_never_seen_is_reported_and_an_old_sighting_is_dated() -> None:
    assert last_seen_of(fleet(), ["b04"], {}, {})["b04"].text(NOW_S) == (
        "never seen before; no other node is reachable"
    )
    assert "last seen 3 d ago (1970-01-01 02:46 UTC)" in of().text(10_000.0 + 3 * 86400)


def test_the_missing_nodes_own_earlier_observation_does_not_count() -> None:
    assert of(b03=hears("b03", 10)).asked == 0
