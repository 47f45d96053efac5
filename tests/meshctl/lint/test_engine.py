"""Findings stand where the value was written, are said once, and cost what the fleet's size costs."""

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from meshctl.diagnostics import Diagnostic, Severity
from meshctl.inventory import load_fleet
from meshctl.lint import BY_CODE, RULES, DiskFiles, Example, LintContext, check_path, lint
from meshctl.lint.example import BASE, ENVIRONMENT, environment, write
from meshctl.model import Fleet
from meshctl.regdb import SHIPPED, load
from meshctl.resources import shipped

_REGDB = load(SHIPPED)


def _found(fragment: str, directory: Path) -> list[Diagnostic]:
    example = Example(fragment)
    return list(check_path(write(example, directory), _REGDB, environment(example)).diagnostics)


def test_a_group_value_is_reported_once_at_its_definition(tmp_path: Path) -> None:
    fragment = """
groups: {strong: {radios: {radio0: {tx_power_dbm: 30}}}}
nodes: {"c[01-07]": {groups: [strong], address: {from: 10.42.0.121}}}
"""
    (finding,) = (item for item in _found(fragment, tmp_path) if item.code == "MC343")
    text = (tmp_path / "fleet.yaml").read_text(encoding="utf-8").splitlines()
    assert "tx_power_dbm: 30" in text[finding.position.line - 1]
    assert finding.path == "nodes.c01.radios.radio0.tx_power_dbm"
    assert "also c02, c03, c04, c05 and 2 more" in finding.message


def test_a_mistake_in_the_options_of_nodes_alike_is_found_in_each(tmp_path: Path) -> None:
    """One node of each kind is rendered: the others were missing, also at lines of their own."""
    wrong = "{wireless.mesh0.network: nothing}"
    own_lines = f"""
    nodes:
      b01: {{extra_uci: {wrong}}}
      b02: {{role: beacon, address: 10.42.0.112, hardware: rocket, extra_uci: {wrong}}}
    """
    found = [item for item in _found(own_lines, tmp_path) if item.code == "MC904"]
    assert [(item.path, item.message) for item in found] == [
        (f"nodes.{name}.extra_uci.wireless.mesh0.network", "no interface of network") for name in ("b01", "b02")
    ]
    assert len({item.position for item in found}) == 2


def test_findings_are_in_file_order(tmp_path: Path) -> None:
    found = _found("{meshes: {main: {channel: 13, mtu: 1400}}, apply: {quorum: 0.1}, country: XX}", tmp_path)
    assert [item.code for item in found] == ["MC321", "MC506", "MC615"]
    assert found == sorted(found, key=lambda item: item.position)


def test_the_power_calculation_is_shown(tmp_path: Path) -> None:
    example = BY_CODE["MC342"].failing
    (finding,) = check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics
    assert finding.found == "27 drive + 6 amplifier = 33 dBm"
    assert finding.expected == "at most 30 dBm conducted (country US)"
    assert "3 dB above the limit" in finding.message


def test_the_fcc_limit_drops_1_db_per_dbi_above_6_dbi(tmp_path: Path) -> None:
    found = _found("{hardware: {rocket: {radios: {radio0: {antenna_gain_dbi: 9, cable_loss_db: 0.5}}}}}", tmp_path)
    (finding,) = (item for item in found if item.code == "MC342")
    assert finding.expected == "at most 27 dBm conducted (country US: 30 less 3 for an antenna of 9 dBi)"
    assert finding.found == "28 drive - 0.5 cable = 27.5 dBm"


def test_the_eirp_includes_amplifier_cable_and_antenna(tmp_path: Path) -> None:
    fragment = """
country: DE
hardware: {rocket: {radios: {radio0: {rated_power_dbm: 30, amplifier_gain_db: 3, cable_loss_db: 1}}}}
"""
    (finding,) = (item for item in _found(fragment, tmp_path) if item.code == "MC341")
    assert finding.expected == "at most 20 dBm EIRP (country DE, channel 6)"
    assert finding.found == "28 drive + 3 amplifier, at most 30 rated - 1 cable + 5 antenna = 34 dBm EIRP"


def test_secrets_are_checked_but_never_shown(tmp_path: Path) -> None:
    example = Example("{udp_mesh: {port: 8701}}", environment={"MESH_KEY": "zu-kurz", "UDP_MESH_KEY": "geheimnis-1234"})
    examined = check_path(write(example, tmp_path), _REGDB, environment(example))
    assert {item.code for item in examined.diagnostics} == {"MC409", "MC445"}
    assert "zu-kurz" not in repr(examined)
    assert "geheimnis" not in repr(examined)


def test_unavailable_environment_secrets_are_not_reported(tmp_path: Path) -> None:
    example = Example("udp_mesh: {port: 8701}")
    assert check_path(write(example, tmp_path), _REGDB, {}).diagnostics == ()


def test_key_material_is_found_even_if_the_inventory_does_not_load(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(
        "meshctl: 1\nnonsense: |\n  -----BEGIN OPENSSH PRIVATE KEY-----\n  b3BlbnNzaC1rZXk\n", encoding="utf-8"
    )
    examined = check_path(path, _REGDB, {})
    assert [(item.code, item.position.line) for item in examined.diagnostics if item.code == "MC441"] == [("MC441", 3)]
    assert any(item.code.startswith("INV") for item in examined.diagnostics)


@pytest.mark.parametrize(
    "line",
    [
        "  keys: [b4f8e7f0c3a94c21a1d2d9a0f5c36e7722d1b6c8e3f04a5b9c7d8e1f2a3b4c5d]",
        "  key: 'tPjn8MOpTCGh0tmg9cNudyLRtsjj8EpbnH2OHyo7TF0='",
        "# AGE-SECRET-KEY-1QQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQQ",
        "wpa_key=correcthorse",
        "  key: {env: b4f8e7f0c3a94c21a1d2d9a0f5c36e77}",
    ],
)
def test_key_material_on_any_line_is_reported_without_showing_it(line: str, tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(f"meshctl: 1\n{line}\n", encoding="utf-8")
    found = [item for item in check_path(path, _REGDB, {}).diagnostics if item.code == "MC441"]
    assert [item.position.line for item in found] == [2]
    assert not any(word in str(found) for word in ("b4f8e7", "tPjn8M", "1QQQQQ", "correcthorse"))


def test_a_hash_is_not_reported_as_a_key(tmp_path: Path) -> None:
    example = BY_CODE["MC801"].passing
    assert check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics == ()


def test_secret_references_are_not_reported_as_secrets(tmp_path: Path) -> None:
    fragment = """
udp_mesh: {keys: [{file: ../password.yaml, key: udp_mesh_secret_key}, {env: THE_PASSWORD}]}
operators: {password_login: false}
"""
    # the file is not on this machine
    assert [item.code for item in _found(fragment, tmp_path)] == ["MC452"]


@pytest.mark.parametrize(("name", "expected"), [("subt-final", []), ("starter", ["MC423"])])
def test_the_shipped_inventories_have_only_the_expected_findings(name: str, expected: list[str]) -> None:
    found = check_path(shipped("inventory") / name, _REGDB, ENVIRONMENT).diagnostics
    assert [item.code for item in found if item.severity is not Severity.NOTE] == expected


def test_a_missing_inventory_is_a_finding(tmp_path: Path) -> None:
    examined = check_path(tmp_path / "absent.yaml", _REGDB, {})
    assert not examined.is_readable
    assert [item.code for item in examined.diagnostics] == ["INV001"]


def _large(nodes: int, directory: Path) -> Fleet:
    """A fleet in which every node collides with another and every name is unknown: the worst case for grouping."""
    lines = [BASE.replace("10.42.0.0/24", "10.42.0.0/16")]
    rows = [
        f"  n{number:04d}: {{role: robot, state: carried, address: 10.42.{number // 400}.{number // 2 % 200 + 1},"
        f" label: L{number // 2}, serial: S{number // 2}, mac: 00:15:6d:01:{number // 512:02x}:{number // 2 % 256:02x},"
        f" robot: ghost{number}, ssh: {{jump: n{(number + 1) % nodes:04d}}}}}"
        for number in range(nodes)
    ]
    lines[0] = lines[0].replace("robots:\n", "\n".join([*rows, "robots:\n"]), 1)
    path = directory / f"large{nodes}.yaml"
    path.write_text("".join(lines), encoding="utf-8")
    return load_fleet(path)


def _work(fleet: Fleet) -> int:
    """How many function calls lint makes: a measure of work that no other load on the machine changes."""
    calls = 0

    def count(_frame: FrameType, _event: str, _argument: Any) -> None:
        nonlocal calls
        calls += 1

    sys.setprofile(count)
    try:
        lint(fleet, LintContext(_REGDB, DiskFiles()))
    finally:
        sys.setprofile(None)
    return calls


def test_lint_work_grows_linearly_with_fleet_size(tmp_path: Path) -> None:
    small, large = _large(600, tmp_path), _large(1800, tmp_path)
    lint(small, LintContext(_REGDB, DiskFiles()))
    assert _work(large) < 3.3 * _work(small)


def test_rule_codes_are_unique() -> None:
    assert len({rule.code for rule in RULES}) == len(RULES) > 150


def test_a_host_key_pinned_twice_is_found_across_inventory_and_known_hosts(tmp_path: Path) -> None:
    key = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8A"
    example = Example(
        "operators: {known_hosts: pins}", files={"pins": f"base {key}\nb01,other {key}\n@revoked b02 {key}\n"}
    )
    (finding,) = check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics
    assert (finding.code, finding.path) == ("MC115", "nodes.b01.host_keys")
