"""Laws of a radio's other addresses: the ones seen on hardware are among them, and no node takes another's."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.topology import alternate_macs, with_alternates


@pytest.mark.parametrize(
    ("first", "second"),
    [
        # hwsim on 24.10.7 and 25.12.5, as recorded; ath9k with a global and with a local address (common.uc)
        ("02:00:00:00:01:00", "42:00:00:00:01:00"),
        ("04:18:d6:11:22:33", "06:18:d6:11:22:33"),
        ("02:18:d6:11:22:33", "06:18:d6:11:22:33"),
    ],
)
def test_macs_before_and_after_a_radio_restart_are_alternates_of_each_other(first: str, second: str) -> None:
    assert second in alternate_macs(first)
    assert first in alternate_macs(second)


def test_a_node_is_recognized_by_its_alternate_mac() -> None:
    names = with_alternates({"04:18:d6:11:22:33": "b01", "04:18:d6:11:22:34": "b02"})
    assert names["06:18:d6:11:22:33"] == "b01"
    assert names["04:18:d6:11:22:34"] == "b02"


def test_an_ambiguous_alternate_address_is_left_out() -> None:
    names = with_alternates({"04:18:d6:11:22:33": "b01", "02:18:d6:11:22:33": "b02"})
    assert names["04:18:d6:11:22:33"] == "b01"
    assert names["02:18:d6:11:22:33"] == "b02"
    assert "06:18:d6:11:22:33" not in names


@given(st.dictionaries(st.sampled_from([f"{n:02x}:aa" for n in range(0, 256, 2)]), st.sampled_from("abc"), max_size=9))
def test_a_known_mac_takes_precedence_over_an_alternate(names: dict[str, str]) -> None:
    assert names.items() <= with_alternates(names).items()


def test_an_invalid_mac_has_no_alternates() -> None:
    assert [alternate_macs(text) for text in ("", "base", "zz:00", "123:00")] == [()] * 4
