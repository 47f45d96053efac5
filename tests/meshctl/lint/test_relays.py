"""Findings about relays stand at the entry in question (MC761 to MC763)."""

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
