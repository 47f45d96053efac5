"""The block of peers in a hosts file: what gets into it, what stays outside it, and how it is replaced."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.cli.hosts_file import BEGIN, END, HostEntry, hosts_of, merge, without_block

DEBIAN = "127.0.0.1\tlocalhost\n127.0.1.1\thusky1\n\n# The following lines\n::1     localhost ip6-localhost\n"
SPOT, BASE = HostEntry("spot1", "10.42.0.12"), HostEntry("base", "10.42.0.1")


def _peer(name: str, address: str | None = "10.42.0.12:8700", **fields: object) -> Mapping[str, object]:
    return {"name": name, "address": address, "legacy": False, **fields}


def test_hosts_are_sorted_by_peer_name() -> None:
    peers = [_peer("spot1"), _peer("base", "10.42.0.1:8700"), _peer("uav", "[fd00::2]:8700")]
    assert hosts_of(peers) == (BASE, SPOT, HostEntry("uav", "fd00::2"))


@pytest.mark.parametrize(
    "peer",
    [
        _peer("spot1", None),
        _peer("spot1", "127.0.0.1:8700"),
        _peer("spot1", "169.254.3.4:8700"),
        _peer("spot1", "[fe80::1%wlan0]:8700"),
        _peer("spot1", "0.0.0.0:8700"),
        _peer("spot1", "spot1:8700"),
        _peer("spot1", legacy=True),
        _peer("localhost"),
        _peer("spot 1"),
        _peer("spot_1"),
        _peer("-spot"),
        _peer("10"),
        _peer("spot1.example.com"),
        _peer("spot1\n10.0.0.1 github.com"),
        _peer("s" * 64),
    ],
)
def test_a_peer_with_an_unusable_or_unsafe_name_or_address_is_omitted(peer: Mapping[str, object]) -> None:
    assert hosts_of([peer]) == ()


def test_the_former_name_of_a_renamed_peer_is_omitted() -> None:
    peers = [
        {"name": "spot1", "address": "10.42.0.12:8700", "online": False},
        {"name": "rover9", "address": "10.42.0.12:8700", "online": True},
        {"name": "spot2", "address": "10.42.0.13:8700", "online": False},
    ]
    assert hosts_of(peers) == (HostEntry("rover9", "10.42.0.12"), HostEntry("spot2", "10.42.0.13"))


def test_a_block_is_appended_replaced_and_removed_and_the_rest_stays() -> None:
    first = merge(DEBIAN, [BASE, SPOT]).text
    assert first == f"{DEBIAN}{BEGIN}\n10.42.0.1  base\n10.42.0.12 spot1\n{END}\n"
    edited = first + "10.9.9.9 printer\n"
    second = merge(edited, [BASE]).text
    assert second == f"{DEBIAN}{BEGIN}\n10.42.0.1 base\n{END}\n10.9.9.9 printer\n"
    assert merge(second, []).text == without_block(second) == f"{DEBIAN}10.9.9.9 printer\n"


def test_a_name_defined_by_another_line_is_reported_as_conflict_and_not_written() -> None:
    merged = merge(DEBIAN, [HostEntry("Husky1", "10.42.0.10"), SPOT])
    assert merged.conflicts == (HostEntry("Husky1", "10.42.0.10"),)
    assert "10.42.0.10" not in merged.text
    assert "10.42.0.12 spot1" in merged.text


def test_a_block_without_its_end_marker_ends_before_foreign_lines() -> None:
    cut = f"{DEBIAN}{BEGIN}\n10.42.0.1 base\n10.9.9.9 printer printer.example.com\n# a comment\n"
    assert without_block(cut) == f"{DEBIAN}10.9.9.9 printer printer.example.com\n# a comment\n"


_LINES = st.lists(
    st.sampled_from([BEGIN, END, "10.42.0.1 base", "::1 localhost", "# base", "", "x", "10.0.0.1 a b"]), max_size=8
)


@given(_LINES, st.booleans(), st.lists(st.sampled_from([BASE, SPOT]), unique=True))
def test_writing_twice_changes_nothing_and_removing_restores_the_text(
    lines: list[str], ends: bool, hosts: list[HostEntry]
) -> None:
    text = "\n".join(lines) + ("\n" if ends else "")
    bare = without_block(text)
    while without_block(bare) != bare:
        bare = without_block(bare)
    merged = merge(bare, hosts)
    assert merge(merged.text, hosts) == merged
    assert without_block(merged.text).rstrip("\n") == bare.rstrip("\n")
