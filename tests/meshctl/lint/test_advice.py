"""Findings whose advice or expectation depends on the fleet: following it must help."""

import re
from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)


def _found(example: Example | str, directory: Path) -> list[Diagnostic]:
    given = Example(example) if isinstance(example, str) else example
    return list(check_path(write(given, directory), _REGDB, environment(given)).diagnostics)


def _codes(example: Example | str, directory: Path) -> list[str]:
    return [item.code for item in _found(example, directory)]


@pytest.mark.parametrize("last", ["40", "99"])
def test_a_mesh_at_the_longest_interval_gets_advice_that_helps(last: str, tmp_path: Path) -> None:
    """With 99 beacons, it named a `reconnect_s` that the inventory refused."""
    nodes = f'nodes: {{"c[01-{last}]": {{state: carried, address: {{from: 10.42.0.121}}}}}}'
    robots = f'robots: {{husky1: {{carries: ["c[01-{last}]", b01]}}}}'

    def fragment(mesh: str) -> str:
        return f"{{meshes: {{main: {{{mesh}}}}}, {nodes}, {robots}}}"

    found = _found(fragment("reconnect_s: 20"), tmp_path)
    hint = next(item.hint for item in found if item.code in {"MC501", "MC502"})
    interval, target = re.findall(r"`(?:batman: {(orig_interval_ms: \d+)}|(reconnect_s: [\d.]+))`", hint)
    followed = set(_codes(fragment(f"{target[1]}, batman: {{{interval[0]}}}"), tmp_path))
    assert not {"MC501", "MC502", "MC504", "INV021"} & followed


def test_the_time_to_heal_of_a_long_interval_is_a_number_of_seconds(tmp_path: Path) -> None:
    found = _found("meshes: {main: {reconnect_s: 60, batman: {orig_interval_ms: 20000}}}", tmp_path)
    (finding,) = (item for item in found if item.code == "MC504")
    assert "found 20000 ms, which heals in 100 s" in str(finding)


@pytest.mark.parametrize(
    ("release", "characters", "is_reported"),
    [("22.03", 64, True), ("22.03", 63, False), ("22.03", 65, False), ("23.05", 64, False)],
)
def test_up_to_22_03_a_key_of_64_characters_joins_no_sae_mesh(
    release: str, characters: int, *, is_reported: bool, tmp_path: Path
) -> None:
    """hostapd.sh takes it for a raw key and sets no SAE password. `openssl rand -hex 32` makes one."""
    fragment = f'{{hardware: {{rocket: {{release: "{release}"}}}}, meshes: {{main: {{mode: mesh, encryption: sae}}}}}}'
    found = _found(
        Example(fragment, environment={"MESH_KEY": "a1" * (characters // 2) + "f" * (characters % 2)}), tmp_path
    )
    assert any(item.code == "MC409" for item in found) == is_reported


def test_the_mesh_that_a_bad_change_takes_down_is_named(tmp_path: Path) -> None:
    (finding,) = (item for item in _found("apply: {max_down: 3}", tmp_path) if item.code == "MC613")
    assert re.search(r"of mesh main, which has \d nodes", finding.message)
    assert "found 3" in str(finding)
