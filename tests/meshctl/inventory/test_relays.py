"""Relays in the inventory: `relay` of a robot and `relay_hops` of the transport."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.meshctl.inventory.inventories import HEAD, errors_of, fleet_of


def test_a_robot_lists_whom_it_relays_for_and_the_limit_holds_for_all(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, "udp_mesh: {relay_hops: 3}\nrobots: {husky1: {relay: [uav1, all]}, uav1: {}}\n")
    assert fleet.robots["husky1"].relay == ("uav1", "all")
    assert fleet.robots["uav1"].relay == ()
    assert fleet.udp_mesh.relay_hops == 3
    origin = fleet.where("robots", "husky1", "relay", "1")
    assert (origin.position.line, origin.position.column) == (HEAD.count("\n") + 2, 33)


def test_by_default_no_robot_relays_and_paths_have_at_most_four_links(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, "robots: {husky1: {}}\n")
    assert (fleet.robots["husky1"].relay, fleet.udp_mesh.relay_hops) == ((), 4)


def test_a_misspelled_key_gets_a_hint(tmp_path: Path) -> None:
    (found,) = errors_of(tmp_path, "robots: {husky1: {relays: [uav1]}}\n")
    assert found.hint == "did you mean 'relay'?"


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        ("robots:\n  husky1: {relay: uav1}\n", "INV021", "robots.husky1.relay: expected a list, found a single value"),
        ("robots:\n  husky1: {relay: [[uav1]]}\n", "INV021", "robots.husky1.relay.0: expected text"),
        ("robots:\n  husky1: {relays: [uav1]}\n", "INV020", "unknown key 'relays'"),
        ("robots:\n  husky1: {relay_hops: 2}\n", "INV020", "unknown key 'relay_hops'"),
        ("udp_mesh:\n  relay_hops: 0\n", "INV021", "udp_mesh.relay_hops: expected at least 1, found '0'"),
        ("udp_mesh:\n  relay_hops: 9\n", "INV021", "udp_mesh.relay_hops: expected at most 8, found '9'"),
        ("udp_mesh:\n  relay_hops: two\n", "INV021", "udp_mesh.relay_hops: expected a whole number, found 'two'"),
        ("udp_mesh:\n  relay: [uav1]\n", "INV020", "unknown key 'relay'"),
    ],
)
def test_an_invalid_relay_is_rejected_with_its_line(text: str, code: str, message: str, tmp_path: Path) -> None:
    (found,) = errors_of(tmp_path, text)
    assert found.code == code
    assert message in found.text
    assert found.position.line == HEAD.count("\n") + 2
