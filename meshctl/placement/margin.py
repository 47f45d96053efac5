"""The margin of a link: what is left of its signal after noise, the needed modulation and fading. Pure.

    margin = filtered SNR of the worse direction - SNR that the offered load needs - fade allowance

The allowance is `UNMEASURED_FADE_DB` until the link has been measured for `FADE_WINDOW_S`, then 1.65 standard
deviations of that window: 95 % of normally distributed fades are smaller.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

# Free space attenuates 2.4 GHz by 40 dB and 5.8 GHz by 48 dB per meter (FSPL); with 20 dBm and no antenna gain a radio
# within a meter is stronger than this even through a chassis of 30 dB.
RACK_DBM = -60
UNMEASURED_FADE_DB = 10.0
FADE_WINDOW_S = 10.0
FADE_DEVIATIONS = 1.65
MIN_FADE_SAMPLES = 5
"""Fewer samples in the window say little about their deviation."""
FILTER_S = 3.0
"""Time constant of the filtered signal."""
_FILTER_SAMPLES = 15
FALL_DB = 6.0
"""A fall of two samples in a row by more than this below the filtered signal is no fading."""
DEFAULT_NOISE_DBM = -95.0
"""Thermal noise of 20 MHz with a noise figure of 6 dB, for radios that do not report theirs."""
MAX_SHARED_HOPS = 3
"""Hops that hear each other share one channel; hops farther apart send at the same time."""

_MCS: tuple[tuple[float, float], ...] = (
    # Mbit/s of one stream of 20 MHz with the long guard interval, least sensitivity in dBm (IEEE 802.11-2016, tables
    # 19-27 and 19-23)
    (6.5, -82.0),
    (13.0, -79.0),
    (19.5, -77.0),
    (26.0, -74.0),
    (39.0, -70.0),
    (52.0, -66.0),
    (58.5, -65.0),
    (65.0, -64.0),
)
_STANDARD_NOISE_DBM = -86.0
"""Noise at which the standard's sensitivities hold: thermal noise with the 10 dB of noise figure and the 5 dB of
implementation margin that it assumes."""
_GOODPUT = 0.6
"""Share of the modulation's rate that user data gets, after preambles, acknowledgments and contention."""


def required_snr_db(load_mbit_s: float, hops: int = 1) -> float:
    """The signal-to-noise ratio of the slowest modulation that carries this load over this many hops of one channel.

    The fastest one's for a load that none carries.
    """
    needed_mbit_s = load_mbit_s * max(1, min(hops, MAX_SHARED_HOPS)) / _GOODPUT
    for rate_mbit_s, sensitivity_dbm in _MCS:
        if rate_mbit_s >= needed_mbit_s:
            return sensitivity_dbm - _STANDARD_NOISE_DBM
    return _MCS[-1][1] - _STANDARD_NOISE_DBM


def rate_mbit_s(snr_db: float) -> float:
    """User data rate of a link with this ratio; 0 below the slowest modulation."""
    usable = [rate for rate, sensitivity_dbm in _MCS if snr_db >= sensitivity_dbm - _STANDARD_NOISE_DBM]
    return _GOODPUT * usable[-1] if usable else 0.0


def path_rate_mbit_s(least_rate_mbit_s: float, hops: int) -> float:
    """About what a path carries whose hops share one channel."""
    return least_rate_mbit_s / max(1, min(hops, MAX_SHARED_HOPS))


class Sample(NamedTuple):
    """The worse direction of one link at one moment; `driven_m` is the way that the robot had driven."""

    at_s: float
    snr_db: float
    driven_m: float


def worse_snr_db(
    signal_dbm: float,
    noise_dbm: float | None = None,
    back_dbm: float | None = None,
    back_noise_dbm: float | None = None,
) -> float:
    """The signal-to-noise ratio of the worse direction; of one direction if the other is unknown."""

    def over(noise: float | None) -> float:
        return DEFAULT_NOISE_DBM if noise is None else noise

    here = signal_dbm - over(noise_dbm)
    return here if back_dbm is None else min(here, back_dbm - over(back_noise_dbm))


def filtered_snr_db(samples: Sequence[Sample]) -> float:
    """The exponentially weighted mean at the last sample's time; around a corner, where the signal falls by more than
    its fading, the mean of the last two samples. Needs one sample."""
    newest, recent = samples[-1].at_s, samples[-_FILTER_SAMPLES:]
    weights = [math.exp((sample.at_s - newest) / FILTER_S) for sample in recent]
    smooth_db = sum(weight * sample.snr_db for weight, sample in zip(weights, recent, strict=True)) / sum(weights)
    last_db = fresh_snr_db(samples)
    return last_db if last_db < smooth_db - FALL_DB else smooth_db


def fresh_snr_db(samples: Sequence[Sample]) -> float:
    """The mean of the last two samples. Needs one."""
    return sum(sample.snr_db for sample in samples[-2:]) / len(samples[-2:])


def fade_allowance_db(samples: Sequence[Sample]) -> float:
    """1.65 standard deviations of the last 10 s; 10 dB until there are that many seconds of samples."""
    newest = samples[-1].at_s
    recent = [sample.snr_db for sample in samples if newest - sample.at_s <= FADE_WINDOW_S]
    # a look takes its time: nine tenths of the window are the whole of it
    if newest - samples[0].at_s < 0.9 * FADE_WINDOW_S or len(recent) < MIN_FADE_SAMPLES:
        return UNMEASURED_FADE_DB
    mean = sum(recent) / len(recent)
    return FADE_DEVIATIONS * math.sqrt(sum((value - mean) ** 2 for value in recent) / len(recent))


def slope_db_per_m(samples: Sequence[Sample], window_m: float, min_m: float) -> float | None:
    """The least-squares change of the ratio per driven meter over the last `window_m`; None below `min_m`."""
    newest = samples[-1].driven_m
    recent = [sample for sample in samples if newest - sample.driven_m <= window_m]
    driven = [sample.driven_m for sample in recent]
    if driven[-1] - driven[0] < min_m or len(recent) < MIN_FADE_SAMPLES:
        return None
    center_m = sum(driven) / len(driven)
    spread = sum((way - center_m) ** 2 for way in driven)
    return sum((way - center_m) * sample.snr_db for way, sample in zip(driven, recent, strict=True)) / spread
