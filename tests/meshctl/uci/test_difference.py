"""What people read of a difference."""

from __future__ import annotations

import pytest

from meshctl.model import MASK
from meshctl.uci import apply, diff, is_secret_option, masked_changes, parse

OLD = """
config wifi-device 'radio0'
	option channel '6'
	option htmode 'HT20'

config wifi-iface 'mesh0'
	option key 'old secret'

config rule
	option name 'a'

config rule
	option name 'b'
"""
NEW = """
config wifi-device 'radio0'
	option channel '11'
	list ports 'eth0'

config wifi-iface 'mesh0'
	option key 'new secret'

config rule
	option name 'b'

config rule 'c'
	option name 'c'
"""


def test_a_diff_is_printed_line_by_line_with_secrets_masked() -> None:
    lines = list(diff(parse(OLD, "x"), parse(NEW, "x")).lines())
    assert lines == [
        "- x.@rule[0] (rule)",
        "~ x.radio0.htmode: 'HT20' -> (none)",
        "~ x.radio0.channel: '6' -> '11'",
        "~ x.radio0.ports: (none) -> ['eth0']",
        f"~ x.mesh0.key: {MASK} -> {MASK}",
        "+ x.c (rule)",
        "+ x.c.name: (none) -> 'c'",
    ]


def test_a_section_that_changes_position_is_reported_as_moved() -> None:
    before = parse("config t a\nconfig t b\nconfig t c\n", "x")
    after = parse("config t c\nconfig t a\nconfig t b\n", "x")
    assert list(diff(before, after).lines()) == ["~ x.c: place 2 -> 0"]


def test_option_order_does_not_produce_a_diff() -> None:
    assert not diff(
        parse("config t n\noption a 1\noption b 2\n", "x"), parse("config t n\noption b 2\noption a 1\n", "x")
    )


def test_a_diff_cannot_be_applied_to_another_package() -> None:
    change = diff(parse(OLD, "x"), parse(NEW, "x"))
    with pytest.raises(ValueError, match="differs from the base of the diff"):
        apply(change, parse(NEW, "x"))
    with pytest.raises(ValueError, match="expected package x"):
        apply(change, parse(OLD, "y"))


@pytest.mark.parametrize("name", ["key", "key1", "password", "sae_password", "wpa_psk", "auth_secret", "priv_key_pwd"])
def test_options_that_hold_keys_are_secret(name: str) -> None:
    assert is_secret_option(name)


@pytest.mark.parametrize("name", ["ssid", "keyboard", "PasswordAuth", "RootPasswordAuth", "network"])
def test_other_options_are_shown(name: str) -> None:
    assert not is_secret_option(name)


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("wireless.mesh0.key='it'\\''s; a secret'", "wireless.mesh0.key=********"),
        ("wireless.@wifi-iface[0].sae_password=plain", "wireless.@wifi-iface[0].sae_password=********"),
        ("-wireless.mesh0.key", "-wireless.mesh0.key"),
        ("wireless.mesh0.key='1'", "wireless.mesh0.key='1'"),
        ("network.wg0.private_key='a\nb'", "network.wg0.private_key=********"),
        ("network.wg0.private_key='cut off\nnetwork.lan.mtu", "network.wg0.private_key=********"),
        ("system.ntp.server+='key'", "system.ntp.server+='key'"),
        (
            "uncommitted: network.lan.mtu='9';wireless.m.key='x y';",
            "uncommitted: network.lan.mtu='9';wireless.m.key=********;",
        ),
    ],
)
def test_secrets_in_uncommitted_changes_are_masked(line: str, shown: str) -> None:
    assert masked_changes(line) == shown
