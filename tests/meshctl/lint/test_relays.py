"""Findings about relays stand at the entry in question (MC761 to MC767)."""

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import BY_CODE, Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)


def _found(fragment: str, directory: Path) -> tuple[list[Diagnostic], list[str]]:
    example = Example(fragment)
    path = write(example, directory)
    return list(check_path(path, _REGDB, environment(example)).diagnostics), path.read_text().splitlines()


def _excerpt(finding: Diagnostic, lines: list[str]) -> str:
    return lines[finding.position.line - 1][finding.position.column - 1 :]


def test_each_unknown_robot_is_reported_at_its_entry_with_the_closest_name(tmp_path: Path) -> None:
    found, lines = _found("robots: {husky1: {relay: [base-station, base-statoin, nobody]}}", tmp_path)
    assert [(item.code, _excerpt(item, lines)) for item in found] == [("MC761", "base-statoin"), ("MC761", "nobody")]
    assert found[0].path == "robots.husky1.relay.1"
    assert (found[0].expected, found[0].found) == ("one of all, base-station, husky1", "base-statoin")
    assert [item.hint for item in found] == ["did you mean 'base-station'?", BY_CODE["MC761"].fix]


def test_a_relay_for_itself_is_reported_at_its_entry(tmp_path: Path) -> None:
    found, lines = _found("robots: {husky1: {relay: [base-station, husky1]}}", tmp_path)
    assert [(item.code, item.path, _excerpt(item, lines)) for item in found] == [
        ("MC762", "robots.husky1.relay.1", "husky1")
    ]


def test_relays_that_are_turned_off_are_reported_once_at_the_limit(tmp_path: Path) -> None:
    fragment = "udp_mesh: {relay_hops: 1}\nrobots: {base-station: {relay: [husky1]}, husky1: {relay: [all]}}"
    found, lines = _found(fragment, tmp_path)
    assert [(item.code, item.path, _excerpt(item, lines)) for item in found] == [("MC763", "udp_mesh.relay_hops", "1")]
    assert "base-station is a relay" in found[0].text


@pytest.mark.parametrize(
    "fragment",
    [
        "robots: {husky1: {relay: [all]}}",
        "robots: {husky1: {relay: [base-station, all]}}",
        "robots: {husky1: {relay: []}}\nudp_mesh: {relay_hops: 1}",
        "robots: {husky1: {relay: [base-station]}}\nudp_mesh: {relay_hops: 2}",
    ],
)
def test_valid_relays_have_no_findings(fragment: str, tmp_path: Path) -> None:
    assert _found(fragment, tmp_path)[0] == []


_RADIO = "nodes: {husky2-front: {role: robot, address: 10.42.0.12}}"
_UAV = "uav1: {computer: {address: 10.50.0.2/24, ssh: {user: robot}}}"
_BETWEEN = "husky1: {RELAY computer: {links: [{address: 10.50.0.1}]}}"
_BY_INTERFACE = "husky1: {RELAY computer: {links: [{interface: wlan1}]}}"
_FIXED = "husky1: {RELAY computer: {links: [{interface: wlan1, neighbors: {uav1: 10.50.0.2}}]}}"


@pytest.mark.parametrize("between", [_BETWEEN, _BY_INTERFACE, _FIXED])
@pytest.mark.parametrize(
    ("relay", "expected"),
    [
        ("", "none"),
        ("relay: [husky2],", "husky2"),
        ("relay: [all],", None),
        ("relay: [uav1],", None),
        ("relay: [base-station],", None),
    ],
)
def test_a_robot_behind_one_that_is_no_relay_for_it_is_reported(
    between: str, relay: str, expected: str | None, tmp_path: Path
) -> None:
    """Deleting `relay: [all]` cut off everything behind, and lint had no finding."""
    other = "husky2: {nodes: [husky2-front], computer: {address: 10.42.0.120/24, ssh: {user: robot}}}"
    found, _ = _found(f"robots: {{{between.replace('RELAY', relay)}, {_UAV}, {other}}}\n{_RADIO}", tmp_path)
    assert "MC609" not in [item.code for item in found]
    found = [item for item in found if item.code == "MC767"]
    if expected is None:
        assert found == []
        return
    (finding,) = found
    assert (finding.expected, finding.found) == ("uav1, or all", expected)
    assert finding.path.startswith("robots.husky1")
    assert "uav1 and base-station" in finding.text


def test_relays_in_a_row_need_enough_hops(tmp_path: Path) -> None:
    row = """
    robots:
      husky1: {relay: [all], computer: {links: [{address: 10.50.0.1}]}}
      husky2: {relay: [all], computer: {address: 10.50.0.2/24, ssh: {user: robot}, links: [{address: 10.60.0.1}]}}
      uav1: {computer: {address: 10.60.0.2/24, ssh: {user: robot}}}
    udp_mesh: {relay_hops: HOPS}
    """
    few, _ = _found(row.replace("HOPS", "2"), tmp_path)
    ((path, expected),) = [(item.path, item.expected) for item in few if item.code == "MC767"]
    assert (path, expected) == ("udp_mesh.relay_hops", "at least 3")
    assert not [item for item in _found(row.replace("HOPS", "3"), tmp_path)[0] if item.code == "MC767"]


def test_robots_in_routed_lans_need_no_relay(tmp_path: Path) -> None:
    text = """
    nodes: {husky1-front: {}}
    robots:
      husky1: {lan: 10.60.1.0/24, computer: {address: 10.60.1.2/24, gateway: 10.60.1.1}}
      base-station: {computer: {gateway: 10.42.0.1}}
    """
    assert not [item for item in _found(text, tmp_path)[0] if item.code == "MC767"]


def test_a_robot_without_a_radio_in_the_network_of_the_mesh_still_lacks_one(tmp_path: Path) -> None:
    text = """
    robots:
      husky1: {computer: {links: [{interface: wlan1}]}}
      uav1: {computer: {address: 10.42.0.120/24, ssh: {user: robot}}}
    """
    assert [item.path for item in _found(text, tmp_path)[0] if item.code == "MC609"] == ["robots.uav1"]


@pytest.mark.parametrize(
    "uav",
    [
        "husky1: {relay: [uav1]}, uav1: {computer: {address: 10.42.0.120/24, ssh: {user: robot}}}",
        "uav1: {fielded: 10.42.0.120}",
        "uav1: {computer: {address: 10.42.0.120/24}, thin: {number: 2, ports: {lora: /dev/ttyUSB0}}}",
    ],
)
def test_a_robot_that_is_reached_otherwise_needs_no_radio(uav: str, tmp_path: Path) -> None:
    """The guide to relays has such a UAV."""
    text = f"robots: {{{uav}}}\nudp_mesh: {{thin_links: {{lora: {{bits_per_s: 5470, frame_bytes: 120, band: eu868}}}}}}"
    assert "MC609" not in [item.code for item in _found(text, tmp_path)[0]]


def test_a_base_station_without_its_radio_is_shown_which_one_it_is(tmp_path: Path) -> None:
    (finding,) = [i for i in _found("robots: {base-station: {nodes: []}}", tmp_path)[0] if i.code == "MC609"]
    assert finding.expected == "the base's radio, base"
