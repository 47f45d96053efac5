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


@cache
def zones() -> Mapping[str, str]:
    """Name -> POSIX time zone string: `America/Denver` -> `MST7MDT,M3.2.0,M11.1.0`."""
    rows = (line.split("\t") for line in _TABLE.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    return MappingProxyType({row[0]: row[1] for row in rows})


def is_posix(text: str) -> bool:
    """Whether OpenWrt's libc accepts the text as a time zone; OpenWrt's default `UTC` counts."""
    return text in ("UTC", "GMT") or _POSIX.fullmatch(text) is not None


def posix_of(name: str) -> str | None:
    """The POSIX string of a zone name, which may have spaces for underscores; None for an unknown name."""
    return zones().get(name.replace(" ", "_"))


def same_clock(zone: str, other: str) -> bool:
    """Whether two POSIX strings describe the same local time, ignoring abbreviations."""
    return _unnamed(zone) == _unnamed(other)


def _unnamed(posix: str) -> str:
    """Without abbreviations; `UTC` is an offset of zero."""
    return "x0" if posix in ("UTC", "GMT") else re.sub(_NAME, "x", posix)
