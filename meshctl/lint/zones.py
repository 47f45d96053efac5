"""Time zones: names, their POSIX strings, and validation of POSIX strings.

`scripts/update-zones` generates the table from tzdata, so that lint gives the same result on every machine.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

_TABLE = Path(__file__).with_name("zones.tsv")

_NAME = r"(?:[A-Za-z]{3,}|<[A-Za-z0-9+-]{3,}>)"
_TIME = r"[+-]?\d{1,3}(?::\d{2}){0,2}"
_RULE = rf",(?:M\d{{1,2}}\.[1-5]\.[0-6]|J?\d{{1,3}})(?:/{_TIME})?"
# IEEE 1003.1, chapter 8.3, TZ; three-digit hours by RFC 8536
_POSIX = re.compile(rf"{_NAME}{_TIME}(?:{_NAME}(?:{_TIME})?(?:{_RULE}{_RULE})?)?")
_OFFSET = re.compile(rf"{_NAME}(?P<sign>[+-]?)(?P<time>\d{{1,3}}(?::\d{{2}}){{0,2}})")


@cache
def zones() -> Mapping[str, str]:
    """Name -> POSIX time zone string: `America/Denver` -> `MST7MDT,M3.2.0,M11.1.0`."""
    return MappingProxyType({name: posix for name, posix, _ in _rows()})


@cache
def _rows() -> tuple[tuple[str, str, str], ...]:
    """Name, POSIX string and comma-separated countries of each zone."""
    lines = (line for line in _TABLE.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    return tuple((name, posix, countries) for name, posix, countries in (line.split("\t") for line in lines))


def is_posix(text: str) -> bool:
    """Whether OpenWrt's libc accepts the text as a time zone; OpenWrt's default `UTC` counts."""
    return text in ("UTC", "GMT") or _POSIX.fullmatch(text) is not None


def posix_of(name: str) -> str | None:
    """The POSIX string of a zone name, which may have spaces for underscores; None for an unknown name."""
    return zones().get(name.replace(" ", "_"))


def countries_of(name: str) -> tuple[str, ...]:
    """The countries that use a zone; none for an unknown one, and for zones such as UTC, CET and US/Eastern."""
    wanted = name.replace(" ", "_")
    return next((tuple(countries.split(",")) for zone, _, countries in _rows() if zone == wanted and countries), ())


def zones_of(country: str) -> tuple[str, ...]:
    """The names of a country's zones."""
    return tuple(name for name, _, countries in _rows() if country in countries.split(","))


def standard_offset_s(posix: str) -> int:
    """Seconds of standard time west of Greenwich, as POSIX counts: -3600 of `CET-1CEST,M3.5.0,M10.5.0/3`."""
    offset = _OFFSET.match(posix)
    if offset is None:
        return 0
    hours, minutes, seconds, *_ = (*map(int, offset["time"].split(":")), 0, 0)
    return (-1 if offset["sign"] == "-" else 1) * (hours * 3600 + minutes * 60 + seconds)


def same_clock(zone: str, other: str) -> bool:
    """Whether two POSIX strings describe the same local time, ignoring abbreviations."""
    return _unnamed(zone) == _unnamed(other)


def _unnamed(posix: str) -> str:
    """Without abbreviations; `UTC` is an offset of zero."""
    return "x0" if posix in ("UTC", "GMT") else re.sub(_NAME, "x", posix)
