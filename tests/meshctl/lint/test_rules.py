"""Every rule's examples do what its page says."""

from pathlib import Path

import pytest

from meshctl.lint import RULES, Example, Rule, check_path
from meshctl.lint.example import environment, write
from meshctl.lint.rules.housekeeping import STALE_BASELINE
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
# needs a baseline, see test_baseline.py
_CHECKED = [rule for rule in RULES if rule is not STALE_BASELINE]


def _codes(example: Example, directory: Path) -> set[str]:
    path = write(example, directory)
    return {item.code for item in check_path(path, _REGDB, environment(example)).diagnostics}


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
