"""What a first inventory gets wrong: one error for each mistake, and a hint that solves it."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.inventory import load
from meshctl.resources import shipped

_STARTER = (shipped("inventory") / "starter" / "fleet.yaml").read_bytes().decode("utf-8")


def _errors(old: str, new: str, directory: Path) -> list[Diagnostic]:
    assert old in _STARTER
    path = directory / "fleet.yaml"
    path.write_text(_STARTER.replace(old, new, 1), encoding="utf-8")
    return list(load(path).diagnostics)


@pytest.mark.parametrize(
    ("old", "new", "hint"),
    [
        ("quorum: 0.8", "quorum: 80", "a share from 0 to 1: 80 % is 0.8"),
        ("quorum: 0.8", "quorum: 80%", "a share from 0 to 1: 80 % is 0.8"),
        ("reconnect_s: 5 ", "reconnect_s: 2,5 ", "write a point: 2.5"),
        (
            "base: {role: base,",
            "base: {role: base, gateway: none,",
            "write `null` to remove the value of an earlier layer",
        ),
        ("base: {role: base,", "base: {role: base, position: {x: 1, y_m: 2},", "did you mean 'x_m'?"),
        ("ssid: my-fleet", "mesh_id: my-fleet", "did you mean 'ssid'?"),
        ("base: {role: base, address:", "base: {role: base, ipaddr:", "did you mean 'address'?"),
        ("htmode: HT20", "width: HT20", "did you mean 'htmode'?"),
        ("mode: adhoc", "mode: ibss", "did you mean 'adhoc'?"),
        ("band: 2g\n", "band: 2.4 GHz\n", "did you mean '2g'?"),
        ("base: {role: base,", "base: {role: gateway,", "did you mean 'base'?"),
        (
            "encryption: none ",
            "encryption: psk2+ccmp\n    key: {env: $MESH_KEY}\n    # ",
            "write the variable's name alone, without `$`",
        ),
        (
            "hardware:\n",
            "x-packages: &packages [iw]\nhardware:\n",
            "no key holds values for anchors alone: set the anchor (`&`) where its value is first used",
        ),
        ("# include: [topics.yaml]", 'include: ["*.yaml"]', "patterns are not expanded: list each file"),
        ('carries: ["rover1-b[01-06]"]', "carries: [rover1-b[01-06]]", 'quote a range in a list: ["b[01-12]"]'),
        (
            "base: {role: base,",
            "base: {role: base",
            "separate entries with commas; quote a value that contains a colon and a space",
        ),
    ],
)
def test_one_error_has_the_hint(old: str, new: str, hint: str, tmp_path: Path) -> None:
    assert [one.hint for one in _errors(old, new, tmp_path)] == [hint]


def test_a_wrong_rule_is_shown(tmp_path: Path) -> None:
    """It said "found a mapping"."""
    (error,) = _errors("{from: 10.42.0.101}", "{rule: network + 0x64}", tmp_path)
    assert error.found == "{rule: network + 0x64}"


def test_a_key_beside_a_rule_that_may_be_secret_is_not_shown(tmp_path: Path) -> None:
    (error,) = _errors("{from: 10.42.0.101}", "{from: 10.42.0.101, key: hunter2}", tmp_path)
    assert error.found == "{from: 10.42.0.101, key: ...}"


@pytest.mark.parametrize("wrong", ["[01..06]", "[06-01]", "(01-06)"])
def test_a_wrong_range_is_the_only_error_beside_an_entry_of_its_node(wrong: str, tmp_path: Path) -> None:
    """The entry's missing address was reported, too; `[01..06]` was a name."""
    entry = "  rover1-b03: {label: B3}\n"
    old = "  rover1-b[01-06]: {groups"
    (error,) = [one for one in _errors(old, entry + old.replace("[01-06]", wrong), tmp_path) if one.code != "MC104"]
    assert error.code == "INV030"
    assert ("write 01-06" in error.message) == (wrong == "[01..06]")


def test_a_misspelled_node_of_a_range_is_one_error(tmp_path: Path) -> None:
    old = "  rover1-b[01-06]: {groups"
    (error,) = _errors(old, "  rover1-b3: {state: lost}\n" + old, tmp_path)
    assert (error.code, error.hint.partition(" Or ")[0]) == ("INV036", "did you mean 'rover1-b03'?")
