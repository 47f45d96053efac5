"""The binary regulatory database is read whole or refused with the place that is wrong."""

import contextlib
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.regdb import SHIPPED, DfsRegion, Flag, FrequencyRule, RegdbError, decode, load, shipped_version

_DATA = SHIPPED.read_bytes()


def test_the_shipped_database_has_the_expected_us_and_de_rules() -> None:
    regdb = load(SHIPPED)
    us = regdb.countries["US"]
    assert us.dfs_region is DfsRegion.FCC
    assert FrequencyRule(2_400_000, 2_472_000, 40_000, 30.0) in us.rules
    assert FrequencyRule(5_250_000, 5_350_000, 80_000, 24.0, Flag.DFS | Flag.AUTO_BW) in us.rules
    germany = regdb.countries["DE"]
    assert germany.dfs_region is DfsRegion.ETSI
    assert FrequencyRule(2_400_000, 2_483_500, 40_000, 20.0) in germany.rules
    assert len(regdb.countries) > 150


def _minimal(rule: bytes) -> bytes:
    """A database of one country whose collection (padded) and rule stand at words 5 and 7."""
    header = struct.pack(">II2sHHH", 0x52474442, 20, b"XA", 5, 0, 0) + b"\0" * 4
    assert len(header) == 20
    return header + struct.pack(">BBBxHxx", 3, 1, 1, 7) + rule


def test_unknown_trailing_fields_of_a_rule_are_ignored() -> None:
    rule = struct.pack(">BBHIII", 20, 0b1000, 1234, 5_170_000, 5_250_000, 80_000) + b"\1\2\3\4"
    country = decode(_minimal(rule), "x").countries["XA"]
    assert country.rules == (FrequencyRule(5_170_000, 5_250_000, 80_000, 12.34, Flag.NO_IR),)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "x: ends at byte 0"),
        (b"PNG\0" + _DATA[4:], "expected a regulatory database starting with RGDB"),
        (_DATA[:4] + b"\0\0\0\x15" + _DATA[8:], "version 20, found 21"),
        (_DATA[:300], "ends at byte 300, expected 3 bytes at byte 4764"),
        (_DATA[:8] + b"a!" + _DATA[10:], "expected a country code of two letters at byte 8"),
        (_DATA[:12] + _DATA[8:12] + _DATA[16:], "duplicate country 00 at byte 12"),
        (b"RGDB" * 80_000, "at most"),
        (_minimal(struct.pack(">BBHIII", 8, 0, 0, 1, 2, 3)), "a rule of at least 16 bytes at byte 28, found 8"),
        (_minimal(struct.pack(">BBHIII", 16, 0, 0, 9, 2, 3)), "a rising frequency range at byte 28, found 9-2"),
    ],
)
def test_a_damaged_database_is_rejected_with_the_reason(data: bytes, message: str) -> None:
    with pytest.raises(RegdbError, match=message):
        decode(data, "x")


@given(st.integers(0, len(_DATA) - 1), st.binary(min_size=1, max_size=8), st.integers(0, len(_DATA)))
def test_arbitrary_bytes_decode_or_raise_a_regdb_error(offset: int, patch: bytes, end: int) -> None:
    damaged = (_DATA[:offset] + patch + _DATA[offset + len(patch) :])[: max(end, offset)]
    with contextlib.suppress(RegdbError):
        assert decode(damaged, "fuzzed").source == "fuzzed"


def test_the_shipped_database_states_its_source_version() -> None:
    assert shipped_version().startswith("wireless-regdb ")


def test_an_unreadable_database_is_reported_by_path(tmp_path: Path) -> None:
    with pytest.raises(RegdbError, match=r"absent\.db: cannot be read"):
        load(tmp_path / "absent.db")
