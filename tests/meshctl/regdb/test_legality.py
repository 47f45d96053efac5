"""Channels are judged as the kernel judges them."""

import pytest

from meshctl.model import Band
from meshctl.regdb import (
    CHANNELS,
    SHIPPED,
    Flag,
    Span,
    center_mhz,
    channel_at,
    check_span,
    legal_channels,
    load,
    occupied_span,
    width_mhz,
)

_REGDB = load(SHIPPED)
_US = _REGDB.countries["US"]
_DE = _REGDB.countries["DE"]
_ADHOC = Flag.DFS | Flag.NO_IR


@pytest.mark.parametrize(("band", "channel"), [(band, channel) for band in Band for channel in CHANNELS[band]])
def test_a_channel_and_its_frequency_convert_both_ways(band: Band, channel: int) -> None:
    assert channel_at(center_mhz(band, channel)) == (band, channel)


def test_frequencies_between_channels_belong_to_none() -> None:
    assert channel_at(2413) is None
    assert channel_at(5181) is None
    assert channel_at(2477) is None
    with pytest.raises(ValueError, match="no channel 7"):
        center_mhz(Band.G5, 7)


@pytest.mark.parametrize(
    ("band", "channel", "htmode", "low", "high"),
    [
        (Band.G2, 6, "HT20", 2427, 2447),
        (Band.G2, 6, "NOHT", 2427, 2447),
        (Band.G2, 1, "HT40", 2402, 2442),
        (Band.G2, 11, "HT40", 2432, 2472),
        (Band.G2, 6, "HT40-", 2407, 2447),
        (Band.G2, 14, "HT20", 2474, 2494),
        (Band.G5, 36, "HT40+", 5170, 5210),
        (Band.G5, 40, "HT40-", 5170, 5210),
        (Band.G5, 149, "VHT80", 5735, 5815),
        (Band.G5, 161, "HE80", 5735, 5815),
        (Band.G5, 100, "VHT160", 5490, 5650),
    ],
)
def test_a_wide_channel_occupies_its_whole_channel_group(
    band: Band, channel: int, htmode: str, low: int, high: int
) -> None:
    assert occupied_span(band, channel, htmode) == Span(low, high)


@pytest.mark.parametrize(
    ("band", "channel", "htmode"),
    [
        (Band.G2, 1, "HT40-"),
        (Band.G2, 11, "HT40+"),
        (Band.G2, 14, "HT40"),
        (Band.G2, 6, "VHT80"),
        (Band.G5, 36, "HT40-"),
        (Band.G5, 144, "VHT160"),
        (Band.G5, 40, "HT40+"),
    ],
)
def test_a_wide_channel_without_its_other_half_is_invalid(band: Band, channel: int, htmode: str) -> None:
    assert occupied_span(band, channel, htmode) is None


def test_an_unknown_htmode_raises_a_value_error() -> None:
    with pytest.raises(ValueError, match="unknown htmode"):
        width_mhz("HT30")


def test_the_us_allows_2_4_ghz_channels_only_up_to_11() -> None:
    assert legal_channels(_US, Band.G2, "HT20", forbidden=_ADHOC) == tuple(range(1, 12))
    assert legal_channels(_DE, Band.G2, "HT20", forbidden=_ADHOC) == tuple(range(1, 14))
    assert legal_channels(_US, Band.G2, "HT40+", forbidden=_ADHOC) == tuple(range(1, 8))


def test_ad_hoc_mode_excludes_radar_and_no_ir_channels() -> None:
    assert legal_channels(_US, Band.G5, "HT20", forbidden=_ADHOC) == (36, 40, 44, 48, 149, 153, 157, 161, 165)
    assert 52 in legal_channels(_US, Band.G5, "HT20", forbidden=Flag.NO_IR)
    assert legal_channels(_US, Band.G5, "VHT80", forbidden=_ADHOC) == (36, 40, 44, 48, 149, 153, 157, 161)


def test_a_span_over_several_rules_has_their_lowest_power_limit() -> None:
    verdict = check_span(_US, Span(5170, 5330))
    assert verdict.covered
    assert verdict.max_eirp_dbm == 23.0
    assert verdict.flags & Flag.DFS
    assert verdict.allows(160)


def test_a_range_outside_every_rule_is_not_covered() -> None:
    verdict = check_span(_US, Span(2457, 2477))
    assert not verdict.covered
    assert not verdict.allows(20)


def test_channel_14_is_allowed_only_without_ofdm_in_japan() -> None:
    japan = _REGDB.countries["JP"]
    assert not check_span(japan, Span(2474, 2494)).covered
    assert check_span(japan, Span(2474, 2494), ofdm=False).covered
