"""Decode the kernel's binary regulatory database, `regulatory.db`, format version 20.

The layout is big-endian, with pointers in units of four bytes from the start of the file (Linux net/wireless/reg.c,
struct fwdb_header, fwdb_country, fwdb_collection, fwdb_rule): a header, a list of countries terminated by a zero entry,
then collections of rule pointers, and rules. Unknown extra bytes of collections and rules are skipped.
"""

from __future__ import annotations

import struct
from types import MappingProxyType
from typing import Any

from meshctl.errors import InputError
from meshctl.regdb.values import Country, DfsRegion, Flag, FrequencyRule, Regdb

# "RGDB"
_MAGIC = 0x52474442
_VERSION = 20
# the database is about 6 KiB; pointers (16-bit counts of 4-byte words) reach 256 KiB
MAX_BYTES = 1 << 18

_HEADER = struct.Struct(">II")
_COUNTRY = struct.Struct(">2sH")
_COLLECTION = struct.Struct(">BBB")
_RULE = struct.Struct(">BBHIII")
_POINTER = struct.Struct(">H")
_WORD_BYTES = 4
_MBM_PER_DBM = 100


class RegdbError(InputError):
    """Not a regulatory database of version 20; the message has the byte offset."""


def decode(data: bytes, source: str) -> Regdb:
    """The database in `data`; `source` names it in errors. Raises RegdbError."""
    if len(data) > MAX_BYTES:
        raise RegdbError(f"{source}: expected a regulatory database of at most {MAX_BYTES} bytes, found {len(data)}")
    magic, version = _unpack(_HEADER, data, 0, source)
    if magic != _MAGIC:
        raise RegdbError(f"{source}: expected a regulatory database starting with RGDB, found {data[:4]!r}")
    if version != _VERSION:
        raise RegdbError(f"{source}: expected regulatory database version {_VERSION}, found {version}")
    countries: dict[str, Country] = {}
    collections: dict[int, tuple[DfsRegion, tuple[FrequencyRule, ...]]] = {}
    offset = _HEADER.size
    while True:
        raw, pointer = _unpack(_COUNTRY, data, offset, source)
        if raw == b"\0\0":
            break
        alpha2 = _alpha2(raw, offset, source)
        if alpha2 in countries:
            raise RegdbError(f"{source}: duplicate country {alpha2} at byte {offset}")
        if pointer not in collections:
            collections[pointer] = _collection(data, pointer * _WORD_BYTES, source)
        countries[alpha2] = Country(alpha2, *collections[pointer])
        offset += _COUNTRY.size
    return Regdb(MappingProxyType(countries), source)


def _alpha2(raw: bytes, offset: int, source: str) -> str:
    text = raw.decode("ascii", errors="replace")
    if raw != b"00" and not (text.isascii() and text.isalpha() and text.isupper()):
        raise RegdbError(f"{source}: expected a country code of two letters at byte {offset}, found {raw!r}")
    return text


def _collection(data: bytes, offset: int, source: str) -> tuple[DfsRegion, tuple[FrequencyRule, ...]]:
    length, count, region = _unpack(_COLLECTION, data, offset, source)
    if length < _COLLECTION.size:
        raise RegdbError(f"{source}: expected at least {_COLLECTION.size} bytes in the rules at byte {offset}")
    # the region is in the two low bits
    dfs_region = DfsRegion(region & 3)
    pointers = offset + length + length % 2
    rules = []
    for index in range(count):
        (pointer,) = _unpack(_POINTER, data, pointers + index * _POINTER.size, source)
        rules.append(_rule(data, pointer * _WORD_BYTES, source))
    return dfs_region, tuple(rules)


def _rule(data: bytes, offset: int, source: str) -> FrequencyRule:
    length, flags, max_eirp_mbm, start_khz, end_khz, bandwidth_khz = _unpack(_RULE, data, offset, source)
    if length < _RULE.size:
        raise RegdbError(f"{source}: expected a rule of at least {_RULE.size} bytes at byte {offset}, found {length}")
    if not start_khz < end_khz:
        raise RegdbError(f"{source}: expected a rising frequency range at byte {offset}, found {start_khz}-{end_khz}")
    known = Flag(flags & (Flag.NO_OFDM | Flag.NO_OUTDOOR | Flag.DFS | Flag.NO_IR | Flag.AUTO_BW))
    return FrequencyRule(start_khz, end_khz, bandwidth_khz, max_eirp_mbm / _MBM_PER_DBM, known)


def _unpack(layout: struct.Struct, data: bytes, offset: int, source: str) -> tuple[Any, ...]:
    if offset + layout.size > len(data):
        raise RegdbError(f"{source}: ends at byte {len(data)}, expected {layout.size} bytes at byte {offset}")
    return layout.unpack_from(data, offset)
