"""A collector's report of the robot's radio: signal, margin and bottleneck of the radio path to each peer. Pure.

The report is the payload of `set-radio` (docs/local-api.md). Its ages become times on the daemon's clock, so that the
conditions show how old each value is; values older than `MAX_AGE_S` are left out.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeVar

Json = dict[str, object]

MAX_AGE_S = 10.0
"""Older values say nothing of a robot that moves."""
MAX_PATHS = 1024
"""As many peers as a node may have."""
MAX_NEIGHBORS = 256
MAX_REPORT_BYTES = 1 << 20
MAX_NAME_CHARACTERS = 63
MAX_PROBLEM_CHARACTERS = 500

Kept = TypeVar("Kept", bound="RadioPath | RadioNeighbor")


class BadReport(ValueError):
    """Not a report; the text says what was expected and found."""


class RadioTrend(Enum):
    IMPROVING = "improving"
    STEADY = "steady"
    WORSENING = "worsening"


@dataclass(frozen=True, slots=True)
class RadioPath:
    """The radio path to one peer at `measured_at`; None is unknown."""

    peer: str
    measured_at: float
    radio: str
    """The robot's radio that has this path."""
    next_hop: str
    """The node that it sends to: a name, or a MAC address without a known name."""
    signal_dbm: float | None
    noise_dbm: float | None
    margin_db: float | None
    """Of the next hop: what its signal is above the noise, the modulation that the load needs, and fading."""
    bottleneck_bits_per_s: float | None
    """The least rate known of the path: of the next hop, and of the whole path if the routing protocol measures it."""
    quality: float | None
    """Share of the routing protocol's packets that arrive over the whole path, 0 to 1 (BATMAN_IV)."""
    trend: RadioTrend | None
    change_db_per_s: float | None


@dataclass(frozen=True, slots=True)
class RadioNeighbor:
    """A node that a radio of the robot hears."""

    name: str
    measured_at: float
    radio: str
    signal_dbm: float
    margin_db: float | None


@dataclass(frozen=True, slots=True)
class RadioReport:
    """`source` is who measured, `problem` why a radio gives no new values (empty: they do)."""

    reported_at: float
    source: str
    problem: str
    paths: Mapping[str, RadioPath]
    neighbors: tuple[RadioNeighbor, ...]

    def recent_path(self, peer: str, now: float) -> RadioPath | None:
        """None if nothing recent is known of its path."""
        path = self.paths.get(peer)
        return None if path is None or now - path.measured_at > MAX_AGE_S else path

    def recent_neighbors(self, now: float) -> Iterator[RadioNeighbor]:
        return (neighbor for neighbor in self.neighbors if now - neighbor.measured_at <= MAX_AGE_S)

    def path_json(self, peer: str, now: float) -> Json | None:
        """For the peer's conditions; None if nothing recent is known of its path."""
        path = self.recent_path(peer, now)
        if path is None:
            return None
        trend = None
        if path.trend is not None:
            trend = {"direction": path.trend.value, "change_db_per_s": path.change_db_per_s}
        return {
            "source": self.source,
            "radio": path.radio,
            "next_hop": path.next_hop,
            "signal_dbm": path.signal_dbm,
            "noise_dbm": path.noise_dbm,
            "margin_db": path.margin_db,
            "bottleneck_bits_per_s": path.bottleneck_bits_per_s,
            "quality": path.quality,
            "trend": trend,
            "age_s": _age_s(path, now),
        }

    def json(self, now: float) -> Json | None:
        """For the node's conditions; None if the collector has been silent for too long."""
        if now - self.reported_at > MAX_AGE_S:
            return None
        return {
            "source": self.source,
            "problem": self.problem or None,
            "age_s": round(now - self.reported_at, 3),
            "neighbors": [
                {
                    "name": neighbor.name,
                    "radio": neighbor.radio,
                    "signal_dbm": neighbor.signal_dbm,
                    "margin_db": neighbor.margin_db,
                    "age_s": _age_s(neighbor, now),
                }
                for neighbor in self.recent_neighbors(now)
            ],
        }


def _age_s(entry: RadioPath | RadioNeighbor, now: float) -> float:
    return round(max(0.0, now - entry.measured_at), 3)


def with_radio(conditions: Json, report: RadioReport | None, now: float) -> Json:
    """The conditions as JSON, with `radio` of the node and of each peer; null: nothing is known."""
    peers = conditions["peers"]
    assert isinstance(peers, list)
    return {
        **conditions,
        "peers": [{**peer, "radio": None if report is None else report.path_json(peer["name"], now)} for peer in peers],
        "radio": None if report is None else report.json(now),
    }


def parse_report(payload: bytes, now: float) -> RadioReport:
    """The payload of `set-radio`. Unknown keys are ignored. Raises BadReport."""
    if len(payload) > MAX_REPORT_BYTES:
        raise BadReport(f"payload: expected at most {MAX_REPORT_BYTES} bytes, found {len(payload)}")
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise BadReport(f"payload: expected a JSON object, found something else: {str(error)[:80]}") from error
    if not isinstance(document, dict):
        raise BadReport(f"payload: expected a JSON object, found {_shown(document)}")
    source = _name(document, "source", "source")
    problem = document.get("problem") or ""
    if not isinstance(problem, str):
        raise BadReport(f"problem: expected text, found {_shown(problem)}")
    paths = [_path(entry, place, now) for place, entry in _entries(document, "paths", MAX_PATHS)]
    neighbors = [_neighbor(entry, place, now) for place, entry in _entries(document, "neighbors", MAX_NEIGHBORS)]
    return RadioReport(
        now, source, problem[:MAX_PROBLEM_CHARACTERS], {path.peer: path for path in paths}, tuple(neighbors)
    )


def _entries(document: Mapping[str, Any], key: str, limit: int) -> Iterator[tuple[str, Mapping[str, Any]]]:
    entries = document.get(key, [])
    if not isinstance(entries, list) or len(entries) > limit:
        raise BadReport(f"{key}: expected a list of at most {limit} objects, found {_shown(entries)}")
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise BadReport(f"{key}[{index}]: expected an object, found {_shown(entry)}")
        yield f"{key}[{index}]", entry


def _path(entry: Mapping[str, Any], place: str, now: float) -> RadioPath:
    trend, change_db_per_s = entry.get("trend"), _number(entry, place, "change_db_per_s", -1000, 1000)
    words = [known.value for known in RadioTrend]
    if trend is not None and trend not in words:
        raise BadReport(f"{place}.trend: expected one of {', '.join(words)}, found {_shown(trend)}")
    return RadioPath(
        _name(entry, "peer", f"{place}.peer"),
        now - _age(entry, place),
        _name(entry, "radio", f"{place}.radio"),
        _name(entry, "next_hop", f"{place}.next_hop"),
        _number(entry, place, "signal_dbm", -200, 100),
        _number(entry, place, "noise_dbm", -200, 100),
        _number(entry, place, "margin_db", -200, 200),
        _number(entry, place, "bottleneck_bits_per_s", 0, 1e12),
        _number(entry, place, "quality", 0, 1),
        None if trend is None else RadioTrend(trend),
        change_db_per_s,
    )


def _neighbor(entry: Mapping[str, Any], place: str, now: float) -> RadioNeighbor:
    return RadioNeighbor(
        _name(entry, "name", f"{place}.name"),
        now - _age(entry, place),
        _name(entry, "radio", f"{place}.radio"),
        _required(entry, place, "signal_dbm", -200, 100),
        _number(entry, place, "margin_db", -200, 200),
    )


def _age(entry: Mapping[str, Any], place: str) -> float:
    return _required(entry, place, "age_s", 0, 1e9)


def _name(entry: Mapping[str, Any], key: str, place: str) -> str:
    value = entry.get(key)
    if not isinstance(value, str) or not 0 < len(value) <= MAX_NAME_CHARACTERS or not value.isprintable():
        expected = f"printable text of 1 to {MAX_NAME_CHARACTERS} characters"
        raise BadReport(f"{place}: expected {expected}, found {_shown(value)}")
    return value


def _required(entry: Mapping[str, Any], place: str, key: str, least: float, most: float) -> float:
    value = _number(entry, place, key, least, most)
    if value is None:
        raise BadReport(f"{place}.{key}: expected a number from {least:g} to {most:g}, found none")
    return value


def _number(entry: Mapping[str, Any], place: str, key: str, least: float, most: float) -> float | None:
    value = entry.get(key)
    if value is None:
        return None
    # JSON's integers have no limit; a comparison needs no conversion
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not least <= value <= most or math.isnan(value):
        raise BadReport(f"{place}.{key}: expected a number from {least:g} to {most:g}, found {_shown(value)}")
    return float(value)


def _shown(value: object) -> str:
    return repr(value)[:80]
