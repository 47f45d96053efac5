"""Airtime of the originator messages of a BATMAN_IV mesh: bytes -> frame -> airtime -> fraction of the channel.

The estimate is for the worst case: a cell in which every node hears every other, so all of them share one channel. Each
node sends its own message once per interval and repeats everyone else's once, which makes the cost grow with the square
of the number of nodes. Multicast frames go out once, at the multicast rate, without acknowledgment.
"""

from __future__ import annotations

from math import ceil

# struct batadv_ogm_packet is 24 bytes; followed by the TVLVs that our nodes announce: translation table (4 + 4 + 8
# for one VLAN), distributed ARP table (4), multicast flags (4 + 4), by uapi/linux/batadv_packet.h.
ORIGINATOR_BYTES = 24 + 16 + 4 + 8
# batman-adv packs messages up to this size and for this long (main.h: MAX_AGGREGATION_BYTES, MAX_AGGREGATION_MS).
AGGREGATE_BYTES = 512
AGGREGATE_MS = 100
# 802.11 data header 24, LLC/SNAP 8, frame check sequence 4.
FRAME_BYTES = 24 + 8 + 4

# Rates of 802.11b; everything else is OFDM.
DSSS_RATES_KBPS = frozenset({1000, 2000, 5500, 11000})
# OFDM in 2.4 GHz (clause 18): preamble and signal 20 us, signal extension 6 us, SIFS 10 + 2 slots of 9 us, and on
# average half of the smallest contention window of 15 slots. A 5 GHz frame takes 6 us less.
OFDM_PREAMBLE_US = 20 + 6
OFDM_ACCESS_US = 28 + 15 / 2 * 9
OFDM_SYMBOL_US = 4
# service field and tail, in bits, around the frame
OFDM_EXTRA_BITS = 16 + 6
# 802.11b: long preamble and header 192 us, SIFS 10 + 2 slots of 20 us, half of a window of 31 slots.
DSSS_PREAMBLE_US = 192
DSSS_ACCESS_US = 50 + 31 / 2 * 20


def originator_airtime(nodes: int, orig_interval_ms: int, mcast_rate_kbps: int, *, is_aggregated: bool = True) -> float:
    """The fraction of airtime that `nodes` in one cell spend on originator messages; above 1 if it exceeds the channel.

    Raises ValueError for an interval or a rate that is not positive.
    """
    if orig_interval_ms <= 0 or mcast_rate_kbps <= 0:
        raise ValueError("interval and rate must be positive")
    if nodes <= 0:
        return 0.0
    packets, payload_bytes = _packets_per_node(nodes, orig_interval_ms, is_aggregated=is_aggregated)
    busy_us = nodes * packets * frame_airtime_us(payload_bytes, mcast_rate_kbps)
    return busy_us / (orig_interval_ms * 1000)


def _packets_per_node(nodes: int, orig_interval_ms: int, *, is_aggregated: bool) -> tuple[float, float]:
    """Frames that one node sends per interval, and the message bytes in each."""
    # its own message, and each other node's message once
    messages = nodes
    if not is_aggregated:
        return messages, ORIGINATOR_BYTES
    # aggregated per AGGREGATE_MS and spread over the interval, so a slow mesh sends many small packets
    windows = max(1, orig_interval_ms / AGGREGATE_MS)
    fullest = ceil(messages / (AGGREGATE_BYTES // ORIGINATOR_BYTES))
    packets = max(fullest, min(messages, windows))
    return packets, messages * ORIGINATOR_BYTES / packets


def frame_airtime_us(payload_bytes: float, rate_kbps: int) -> float:
    """Time on the channel of one multicast frame: channel access, preamble, frame."""
    bits = (payload_bytes + FRAME_BYTES) * 8
    if rate_kbps in DSSS_RATES_KBPS:
        return DSSS_ACCESS_US + DSSS_PREAMBLE_US + bits / rate_kbps * 1000
    symbols = ceil((bits + OFDM_EXTRA_BITS) / (rate_kbps / 1000 * OFDM_SYMBOL_US))
    return OFDM_ACCESS_US + OFDM_PREAMBLE_US + symbols * OFDM_SYMBOL_US
