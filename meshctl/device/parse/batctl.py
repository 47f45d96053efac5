"""`batctl`: JSON from 2021.1 on (OpenWrt 21.02), text tables before (19.07 has 2019.2)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from types import MappingProxyType, NoneType
from typing import Any

from meshctl.device.observation import MeshInfo, MeshNeighbor, Originator
from meshctl.device.parse.jsontext import integer, mapping, maps, parse_json, string

_MAC = r"((?:[0-9a-f]{2}:){5}[0-9a-f]{2})"
_SEEN = r"(\d{1,9})\.(\d{3})s"
# ` * 02:..:02    0.320s   (251) 02:..:02 [     mesh0]`; BATMAN_V writes Mbit/s as (       10.4)
_ORIGINATOR = re.compile(
    rf"^ ?(\*?) *{_MAC} +{_SEEN} +\( *(\d{{1,9}})(?:\.(\d))?\) +{_MAC} +\[ *(\S+)\]", re.IGNORECASE
)
# BATMAN_IV: `        mesh0<tab>  02:..:02    0.120s`; BATMAN_V: `02:..:02    0.120s (    10.4) [     mesh0]`
_NEIGHBOR_IV = re.compile(rf"^ *(\S+)\s+{_MAC} +{_SEEN}", re.IGNORECASE)
_NEIGHBOR_V = re.compile(rf"^ *{_MAC} +{_SEEN} +\([^)]*\) +\[ *(\S+)\]", re.IGNORECASE)
_HEADER = re.compile(r"\[B\.A\.T\.M\.A\.N\. adv ([^,]+),.*?(BATMAN_I?V)\)?")


def parse_statistics(text: str) -> Mapping[str, int]:
    """`statistics`: `<tab>tx_bytes: 5930`, one counter per line; other lines are left out."""
    found = (re.fullmatch(r"\s*([a-z][a-z0-9_]{0,40}): (\d{1,20})\s*", line) for line in text.splitlines())
    return MappingProxyType({match[1]: int(match[2]) for match in found if match})


def parse_transglobal(text: str) -> tuple[int, int] | None:
    """Counts of `transglobal` by observe.sh: entries of unicast and of multicast addresses."""
    found = re.fullmatch(r"unicast (\d{1,9})\nmulticast (\d{1,9})\n*", text)
    return (int(found[1]), int(found[2])) if found else None


def parse_originators_count(text: str) -> tuple[int, int] | None:
    """Counts of `originators_json` by observe.sh, where it left out rows: paths in use, and others."""
    found = re.fullmatch(r"(\d{1,9}) (\d{1,9})\s*", text)
    return (int(found[1]), int(found[2])) if found else None


def parse_mesh_json(text: str) -> MeshInfo | None:
    """`mesh_json`: version, algorithm and every setting as text."""
    data = mapping(parse_json(text))
    if not string(data.get("version")) and not string(data.get("algo_name")):
        return None
    settings = {
        key: string(value)
        for key, value in data.items()
        if key not in {"version", "algo_name"} and isinstance(value, str | int | float)
    }
    return MeshInfo(
        version=string(data.get("version")),
        algorithm=string(data.get("algo_name")),
        settings=MappingProxyType(settings),
    )


def parse_hardifs_json(text: str, names: Mapping[int, str]) -> tuple[str, ...] | None:
    """`hardifs_json`: the names of the hard interfaces."""
    data = parse_json(text)
    if not isinstance(data, list):
        return None
    return tuple(name for item in maps(data) if (name := _interface(item, names)))


def _interface(item: Mapping[str, object], names: Mapping[int, str]) -> str:
    """`hard_ifname` came with batctl 2021.2; before (21.02) there is only the index, which `names` translates."""
    index = integer(item.get("hard_ifindex"))
    return string(item.get("hard_ifname")) or ("" if index is None else names.get(index, ""))


def parse_interfaces_text(text: str) -> tuple[str, ...] | None:
    """`batctl if`: `mesh0: active`."""
    lines = [line for line in text.splitlines() if line.strip()]
    if not all(re.fullmatch(r"\S+: \w+", line.strip()) for line in lines):
        return None
    return tuple(line.split(":", 1)[0].strip() for line in lines)


def parse_neighbors_json(text: str, names: Mapping[int, str]) -> tuple[MeshNeighbor, ...] | None:
    """`neighbors_json`."""
    data = parse_json(text)
    if not isinstance(data, list):
        return None
    return tuple(
        MeshNeighbor(
            mac=string(item.get("neigh_address")).lower(),
            ifname=_interface(item, names),
            last_seen_ms=integer(item.get("last_seen_msecs")) or 0,
        )
        for item in maps(data)
        if string(item.get("neigh_address"))
    )


def parse_neighbors_text(text: str) -> tuple[MeshNeighbor, ...] | None:
    """`batctl n`. None when there is not even a header."""
    if "Neighbor" not in text:
        return () if not text.strip() else None
    found = []
    for line in text.splitlines():
        if row := _NEIGHBOR_V.match(line):
            found.append(MeshNeighbor(row[1].lower(), row[4], _milliseconds(row[2], row[3])))
        elif row := _NEIGHBOR_IV.match(line):
            found.append(MeshNeighbor(row[2].lower(), row[1], _milliseconds(row[3], row[4])))
    return tuple(found)


def parse_originators_json(text: str, names: Mapping[int, str]) -> tuple[Originator, ...] | None:
    """`originators_json`: `tq` for BATMAN_IV, `throughput` in kbit/s for BATMAN_V; `best` is absent when false.

    Each node of a fleet knows several paths to every other one, so this is most of what status parses: a table in which
    every row has the usual keys and types is taken as it is.
    """
    data = parse_json(text)
    if not isinstance(data, list):
        return None
    # a tenth of the time of islower()
    usual = _usual_originators(data) if text == text.lower() else None
    return usual if usual is not None else tuple(_originators(data, names))


# The types of each column of a usual table: MAC, next hop, interface, last seen, best, quality, throughput.
_COLUMNS: tuple[set[type], ...] = ({str}, {str}, {str}, {int}, {bool}, {int, NoneType}, {int, NoneType})


def _usual_originators(data: list[Any]) -> tuple[Originator, ...] | None:
    """None if a row lacks a key, or a value has an unusual type or is empty; read and checked column by column."""
    try:
        columns: tuple[list[Any], ...] = (
            [item["orig_address"] for item in data],
            [item["neigh_address"] for item in data],
            [item["hard_ifname"] for item in data],
            [item["last_seen_msecs"] for item in data],
            [item.get("best", False) for item in data],
            [item.get("tq") for item in data],
            [item.get("throughput") for item in data],
        )
    except (KeyError, TypeError, AttributeError):
        return None
    if not all(set(map(type, column)) <= types for column, types in zip(columns, _COLUMNS, strict=True)):
        return None
    if any("" in column for column in columns[:3]):
        return None
    return tuple(map(_ORIGINATOR_OF, zip(*columns, strict=True)))


_ORIGINATOR_OF = partial(tuple.__new__, Originator)


def _originators(data: Iterable[object], names: Mapping[int, str]) -> Iterator[Originator]:
    for item in maps(data):
        if mac := string(item.get("orig_address")):
            yield Originator(
                mac.lower(),
                string(item.get("neigh_address")).lower(),
                _interface(item, names),
                integer(item.get("last_seen_msecs")) or 0,
                item.get("best") is True,
                integer(item.get("tq")),
                integer(item.get("throughput")),
            )


def parse_originators_text(text: str) -> tuple[Originator, ...] | None:
    """`batctl o`. None when there is not even a header."""
    if "Originator" not in text:
        return () if not text.strip() else None
    found = []
    for line in text.splitlines():
        if not (row := _ORIGINATOR.match(line)):
            continue
        mbit_s = row[6] is not None
        found.append(
            Originator(
                mac=row[2].lower(),
                next_hop=row[7].lower(),
                ifname=row[8],
                last_seen_ms=_milliseconds(row[3], row[4]),
                best=row[1] == "*",
                tq=None if mbit_s else int(row[5]),
                throughput_kbit_s=int(row[5]) * 1000 + int(row[6]) * 100 if mbit_s else None,
            )
        )
    return tuple(found)


def parse_mesh_header(text: str) -> MeshInfo | None:
    """Version and algorithm from the first line of `batctl o`."""
    found = _HEADER.search(text)
    return MeshInfo(version=found[1].strip(), algorithm=found[2]) if found else None


def _milliseconds(seconds: str, thousandths: str) -> int:
    return int(seconds) * 1000 + int(thousandths)
