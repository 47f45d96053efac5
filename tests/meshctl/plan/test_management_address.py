"""The management address in a network file, which may hold anything."""

from __future__ import annotations

import pytest

from meshctl.plan.observed_files import management_address


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("option ipaddr '10.42.0.11'", "10.42.0.11"),
        ("list ipaddr '10.42.0.11/24'", "10.42.0.11"),
        ("option ip6addr 'fd42::11/64'", "fd42::11"),
        ("option ipaddr 'fd42::11'", "fd42::11"),
        ("option ipaddr 'none'", "None"),
        ("option proto 'dhcp'", "None"),
    ],
)
def test_an_address_of_either_family_is_found_and_other_text_is_none(option: str, expected: str) -> None:
    assert str(management_address(f"config interface 'lan'\n\t{option}\n")) == expected
