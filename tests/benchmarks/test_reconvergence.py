"""The airtime of batman-adv's own packets, and the table of what was measured."""

from __future__ import annotations

import pytest

from benchmarks.reconvergence_udp_mesh import OVERHEARD_S, airtime_us, share_of_air, table

# DIFS, half of the first contention window
SPACING_US = 28 + 67.5


def test_airtime_is_what_802_11_says() -> None:
    # 12 Mbit/s: 48 bits per symbol of 4 us; 100 bytes, checksum and service bits are 18 symbols
    assert airtime_us(24, 100, "ogm") == SPACING_US + 20 + 18 * 4 + 6
    # 1 Mbit/s, long preamble
    assert airtime_us(2, 100, "ogm") == SPACING_US + 192 + 8 * 104
    # a probe at an 802.11n rate is acknowledged
    assert airtime_us(0, 1500, "probe") == SPACING_US + 36 + 47 * 4 + 6 + 54


def test_the_share_of_the_air_is_the_sum_of_all_nodes_packets() -> None:
    overheard = [{"kind": "ogm", "rate": 24, "bytes": 100, "count": 1000}]
    assert share_of_air(overheard) == pytest.approx(1000 * airtime_us(24, 100, "ogm") / (OVERHEARD_S * 1e6))


def test_a_row_tells_median_and_every_run() -> None:
    overheard = [{"kind": "ogm", "rate": 24, "bytes": 100, "count": 200}]
    case = {"algorithm": "BATMAN_IV", "interval_ms": 500, "overheard": overheard}
    rows = table([{**case, "pause_s": pause_s} for pause_s in (4.0, 1.0, 2.5)]).splitlines()
    assert rows[2:] == ["| BATMAN_IV | 500 ms | 2.5 s (1.0, 2.5, 4.0) | 10 | 0.19% |"]
