"""Every rule's examples do what its page says."""

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import RULES, Example, Rule, check_path
from meshctl.lint.example import environment, write
from meshctl.lint.rules.housekeeping import STALE_BASELINE
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
# needs a baseline, see test_baseline.py
_CHECKED = [rule for rule in RULES if rule is not STALE_BASELINE]


def _found(example: Example, directory: Path) -> tuple[Diagnostic, ...]:
    return tuple(check_path(write(example, directory), _REGDB, environment(example)).diagnostics)


def _codes(example: Example, directory: Path) -> set[str]:
    return {item.code for item in _found(example, directory)}


@pytest.mark.parametrize("rule", _CHECKED, ids=lambda rule: rule.code)
def test_the_failing_example_yields_exactly_its_code(rule: Rule, tmp_path: Path) -> None:
    assert _codes(rule.failing, tmp_path) == {rule.code, *rule.failing.also}


@pytest.mark.parametrize("rule", _CHECKED, ids=lambda rule: rule.code)
def test_the_passing_example_yields_nothing(rule: Rule, tmp_path: Path) -> None:
    assert _codes(rule.passing, tmp_path) == set(rule.passing.also)


def test_the_base_inventory_has_no_findings(tmp_path: Path) -> None:
    assert _codes(Example("apply: {canary: true}"), tmp_path) == set()


@pytest.mark.parametrize(
    ("country", "channel", "window_s", "is_too_short"),
    [("US", 120, 200, False), ("DE", 116, 200, False), ("DE", 120, 200, True), ("DE", 120, 920, False)],
)
def test_weather_radar_needs_a_longer_window_in_europe(
    tmp_path: Path, country: str, channel: int, window_s: int, *, is_too_short: bool
) -> None:
    fragment = f"""
    country: {country}
    meshes: {{main: {{band: 5g, channel: {channel}, mode: mesh, encryption: sae}}}}
    defaults: {{radios: {{radio0: {{mesh: null}}, radio1: {{mesh: main}}}}}}
    hardware: {{rocket: {{confirm_window_s: {window_s}}}}}
    """
    assert ("MC620" in _codes(Example(fragment), tmp_path)) == is_too_short


@pytest.mark.parametrize(
    ("cell", "code"), [("channel: 6, bssid: '02:ca:fe:00:00:01'", "MC304"), ("channel: 9", "MC305")]
)
@pytest.mark.parametrize(("site", "is_reported"), [("north", True), ("south", False)])
def test_meshes_at_different_sites_do_not_hear_each_other(
    tmp_path: Path, cell: str, code: str, site: str, *, is_reported: bool
) -> None:
    fragment = f"""
    sites: {{north: {{}}, south: {{}}}}
    meshes: {{other: {{ssid: other, mode: mesh, band: 2g, {cell}, network: 10.43.0.0/24}}}}
    defaults: {{site: north, radios: {{radio0: {{mesh: main}}}}}}
    nodes: {{s1: {{site: {site}, role: base, address: 10.43.0.1, radios: {{radio0: {{mesh: other}}}}}}}}
    """
    assert (code in _codes(Example(fragment), tmp_path)) == is_reported


@pytest.mark.parametrize(
    ("target", "is_reported"), [("x86/64", False), ("bcm27xx/bcm2711", False), ("ath79/generic", True)]
)
def test_profiles_of_some_targets_are_not_named_after_the_board(
    tmp_path: Path, target: str, *, is_reported: bool
) -> None:
    fragment = f"hardware: {{rocket: {{board: pc-engines-apu2, profile: generic, target: {target}}}}}"
    assert ("MC825" in _codes(Example(fragment), tmp_path)) == is_reported


def test_a_radio_without_a_mesh_may_serve_an_access_point(tmp_path: Path) -> None:
    fragment = """
    nodes:
      b01:
        radios: {radio0: {mesh: main}, radio1: {mesh: null}}
        extra_uci: {wireless.radio1.disabled: '0', wireless.radio1.channel: '36', wireless.radio0.channel: '1'}
    """
    found = [item for item in _found(Example(fragment), tmp_path) if item.code == "MC529"]
    assert [item.path.rpartition("extra_uci.")[2] for item in found] == ["wireless.radio0.channel"]


@pytest.mark.parametrize(
    ("server", "expected"),
    [
        ("2001:db8::123", "an IPv4 address, as gateway 10.42.0.254, or an address of a mesh's network"),
        ("192.0.2.9", ""),
        ("pool.ntp.org", ""),
    ],
)
def test_a_gateway_leads_to_hosts_of_its_own_family(server: str, expected: str, tmp_path: Path) -> None:
    text = f'nodes: {{b01: {{gateway: 10.42.0.254}}}}\nsystem: {{ntp_servers: ["{server}"], log_host: "{server}"}}\n'
    example = Example(text)
    found = check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics
    of_hosts = {one.code: one.expected for one in found if one.code in ("MC212", "MC213")}
    assert of_hosts == ({"MC212": expected, "MC213": expected} if expected else {})
