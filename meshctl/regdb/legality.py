"""Check a channel of a given width against a country's rules, as the kernel's cfg80211 does.

`check_span` finds the rules that cover the occupied range (adjacent rules combine only if they have AUTO_BW) and
returns what they allow; `legal_channels` lists the channels that would pass.
"""

from __future__ import annotations

from dataclasses import dataclass

from meshctl.model import Band
from meshctl.regdb.channels import CHANNELS, Span, center_mhz, occupied_span, width_mhz
from meshctl.regdb.values import NO_FLAGS, Country, Flag, FrequencyRule

NO_INITIATE = Flag.DFS | Flag.NO_IR
"""The flags of rules under which a radio may not start to transmit by itself."""


@dataclass(frozen=True, slots=True)
class Legality:
    """A country's rule for a range of frequencies.

    `covered` is False if part of the range is outside every rule (`flags` and `max_eirp_dbm` are then meaningless).
    `max_bandwidth_khz` is the widest channel allowed there, `max_eirp_dbm` the lowest limit of the rules.
    """

    covered: bool
    max_eirp_dbm: float = 0.0
    max_bandwidth_khz: int = 0
    flags: Flag = NO_FLAGS

    def allows(self, span_mhz: int) -> bool:
        return self.covered and span_mhz * 1000 <= self.max_bandwidth_khz


def check_span(country: Country, span: Span, *, ofdm: bool = True) -> Legality:
    """Check the range `span`; `ofdm` False includes rules for 802.11b only (channel 14 in Japan)."""
    low, high = span.low_mhz * 1000, span.high_mhz * 1000
    whole = _covering_rule(country, low, high, ofdm=ofdm)
    if whole is not None:
        joined = _joined_khz(country, whole) if whole.flags & Flag.AUTO_BW else whole.max_bandwidth_khz
        return Legality(True, whole.max_eirp_dbm, max(whole.max_bandwidth_khz, joined), whole.flags)
    pieces = _auto_bw_chain(country, low, high)
    if not pieces:
        return Legality(False)
    flags = NO_FLAGS
    for rule in pieces:
        flags |= rule.flags
    return Legality(True, min(rule.max_eirp_dbm for rule in pieces), high - low, flags)


def legal_channels(country: Country, band: Band, htmode: str, *, forbidden: Flag) -> tuple[int, ...]:
    """The channels of `band` allowed with `htmode` in the country, by rules without `forbidden` flags.

    Raises ValueError for an unknown htmode.
    """
    width = width_mhz(htmode)
    legal = []
    for channel in CHANNELS[band]:
        span = occupied_span(band, channel, htmode)
        if span is None:
            continue
        verdict = check_span(country, span)
        if verdict.allows(width) and not verdict.flags & forbidden:
            legal.append(channel)
    return tuple(legal)


def initiating_channels(country: Country | None, band: Band) -> tuple[int, ...]:
    """The 20 MHz channels of `band` on which a radio may start a cell or an access point in the country; all of the
    band's without one."""
    return legal_channels(country, band, "HT20", forbidden=NO_INITIATE) if country else CHANNELS[band]


def primary_span(band: Band, channel: int) -> Span:
    """The primary 20 MHz of a channel. Raises ValueError for an unknown channel."""
    center = center_mhz(band, channel)
    return Span(center - 10, center + 10)


def _covering_rule(country: Country, low_khz: int, high_khz: int, *, ofdm: bool) -> FrequencyRule | None:
    """The rule that covers the whole range; the least restrictive one if there are several."""
    covering = [
        rule
        for rule in country.rules
        if rule.start_khz <= low_khz and high_khz <= rule.end_khz and not (ofdm and rule.flags & Flag.NO_OFDM)
    ]
    return min(covering, key=lambda rule: (rule.flags & ~Flag.AUTO_BW).bit_count(), default=None)


def _auto_bw_chain(country: Country, low_khz: int, high_khz: int) -> tuple[FrequencyRule, ...]:
    """Adjacent AUTO_BW rules that cover the range together; empty if there are none."""
    chain: list[FrequencyRule] = []
    reached = low_khz
    for rule in sorted(country.rules, key=lambda rule: rule.start_khz):
        if rule.flags & Flag.AUTO_BW and rule.start_khz <= reached < rule.end_khz:
            chain.append(rule)
            reached = rule.end_khz
            if reached >= high_khz:
                return tuple(chain)
    return ()


def _joined_khz(country: Country, rule: FrequencyRule) -> int:
    """The width of the contiguous AUTO_BW range that contains `rule`."""
    low, high = rule.start_khz, rule.end_khz
    adjacent = [other for other in country.rules if other.flags & Flag.AUTO_BW]
    for other in sorted(adjacent, key=lambda other: other.start_khz):
        if other.start_khz <= high < other.end_khz:
            high = other.end_khz
    for other in sorted(adjacent, key=lambda other: other.end_khz, reverse=True):
        if other.start_khz < low <= other.end_khz:
            low = other.start_khz
    return high - low
