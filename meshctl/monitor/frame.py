"""One frame: all that is known of the fleet at one time, as one JSON document.

`frame_of` makes it of the document of `meshctl status --json`, the go/no-go checks, positions and the cost of
monitoring. docs/monitor.md lists the fields. An unknown value is null or absent, never 0. Names and texts come from
devices: escape them wherever they are shown."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from meshctl.status.preflight import Check, verdict

SCHEMA = 1
# No counter of a kernel is larger. What has so many digits may be larger.
_MAX_INTEGER = 1 << 64
_HUGE = re.compile(r"\d{20}")
# The monitor sends no test messages between robots, so the frame's verdict leaves the check of their delivery out.
_NOT_ASSESSED = "delivery"


@dataclass(frozen=True, slots=True)
class FramePosition:
    """Where a node or robot is, in meters; `age_s` None for a place that does not change. `source` is `daemon`,
    `inventory` or `lab`."""

    x_m: float
    y_m: float
    z_m: float | None = None
    age_s: float | None = None
    source: str = "inventory"


@dataclass(frozen=True, slots=True)
class Airtime:
    """Cost of monitoring: bytes per second through the radios, and the share of the channel's time they take (None if
    no rate is known); `limit_share` bounds it. `interval_s` is the time between two frames that results."""

    bytes_per_s: float
    share: float | None
    limit_share: float
    interval_s: float | None = None


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """The indexed values, so that a timeline needs no document. `go` is None if it was not assessed."""

    go: bool | None
    errors: int
    warnings: int
    notes: int


class Frame:
    """A frame and its JSON text. The text is parsed at the first use of `document`; treat that as read-only.

    `time_s` (Unix time, whole milliseconds) is its key.
    """

    __slots__ = ("_document", "json_text", "time_s")

    def __init__(self, time_s: float, json_text: str) -> None:
        self.time_s = time_s
        self.json_text = json_text
        self._document: dict[str, Any] | None = None

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Frame:
        """The frame of a document with `time_s`; numbers that JSON lacks become null. Raises KeyError without it."""
        time_s = round(float(document["time_s"]), 3)
        whole = {**document, "time_s": time_s}
        try:
            text = _dumped(whole)
            is_exact = _HUGE.search(text) is None
        except ValueError:
            is_exact = False
        if not is_exact:
            whole = _finite(whole)
            text = _dumped(whole)
        # half of a surrogate pair is no character, and no encoding has it
        encodable = text.encode("utf-8", "replace").decode()
        frame = cls(time_s, encodable)
        if encodable == text:
            frame._document = whole
        return frame

    @property
    def document(self) -> dict[str, Any]:
        if self._document is None:
            parsed = json.loads(self.json_text)
            self._document = parsed if isinstance(parsed, dict) else {}
        return self._document

    @property
    def summary(self) -> FrameSummary:
        verdict_of = self.document.get("verdict")
        go = verdict_of.get("go") if isinstance(verdict_of, dict) else None
        totals = self.status.get("totals")
        alarms = totals.get("alarms") if isinstance(totals, dict) else None
        count = alarms if isinstance(alarms, dict) else {}
        return FrameSummary(
            go if isinstance(go, bool) else None,
            *(int(count.get(level, 0)) for level in ("error", "warning", "note")),
        )

    @property
    def status(self) -> dict[str, Any]:
        """The document of `meshctl status --json` in it."""
        status = self.document.get("status")
        return status if isinstance(status, dict) else {}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Frame) and self.json_text == other.json_text

    def __hash__(self) -> int:
        return hash(self.json_text)

    def __repr__(self) -> str:
        return f"Frame(time_s={self.time_s}, {len(self.json_text)} characters)"


def frame_of(
    status: Mapping[str, Any],
    *,
    time_s: float,
    checks: Iterable[Check] | None = None,
    positions: Mapping[str, FramePosition] | None = None,
    airtime: Airtime | None = None,
    topic_classes: Mapping[str, str] | None = None,
    meters: Mapping[str, Mapping[str, Any]] | None = None,
) -> Frame:
    """The frame of a status document at `time_s`. `checks` None: go or no-go was not assessed. `topic_classes` are the
    inventory's, by topic name: without the inventory, a replay could not tell telemetry from artifacts."""
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "time_s": time_s,
        "took_s": status.get("took_s"),
        "fleet": status.get("fleet"),
        "verdict": _verdict(checks),
        "status": status,
        "links": links_of(status),
        "radios": {node["name"]: node["radios"] for node in status.get("nodes", ()) if node.get("radios")},
        "positions": {name: _position(place) for name, place in (positions or {}).items()},
        "airtime": None if airtime is None else _airtime(airtime),
    }
    if meters:
        document["meters"] = dict(meters)
    if topic_classes:
        document["topic_classes"] = dict(topic_classes)
    return Frame.of(document)


def links_of(status: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Directed links: `to` hears `from`, as `to` reports it. A link that has one direction only is one-way."""
    found = []
    for node in status.get("nodes", ()):
        age_s = node.get("age_s")
        for heard in node.get("neighbours") or ():
            found.append(
                {
                    "from": heard.get("name"),
                    "to": node.get("name"),
                    "mesh": heard.get("mesh"),
                    "quality": heard.get("quality"),
                    "signal_dbm": heard.get("signal_dbm"),
                    "noise_dbm": heard.get("noise_dbm"),
                    "snr_db": heard.get("snr_db"),
                    "mcs": heard.get("rx_mcs"),
                    "bitrate_kbit_s": heard.get("rx_bitrate_kbit_s"),
                    "age_s": _sum(age_s, heard.get("age_s")),
                }
            )
    return found


def _sum(*ages_s: float | None) -> float | None:
    """None if one is unknown."""
    known = [age_s for age_s in ages_s if age_s is not None]
    return round(sum(known), 3) if len(known) == len(ages_s) else None


def _verdict(checks: Iterable[Check] | None) -> dict[str, Any] | None:
    if checks is None:
        return None
    assessed = [check for check in checks if check.name != _NOT_ASSESSED]
    bad = [f"{check.name}: {check.reason}" for check in assessed if not check.is_go]
    return {"go": not bad, "text": verdict(assessed), "reasons": bad}


def _position(place: FramePosition) -> dict[str, Any]:
    return {"x_m": place.x_m, "y_m": place.y_m, "z_m": place.z_m, "age_s": place.age_s, "source": place.source}


def _airtime(airtime: Airtime) -> dict[str, Any]:
    return {
        "bytes_per_s": round(airtime.bytes_per_s, 1),
        "share": None if airtime.share is None else round(airtime.share, 6),
        "limit_share": airtime.limit_share,
        "interval_s": airtime.interval_s,
    }


def _dumped(document: Mapping[str, Any]) -> str:
    """Raises ValueError for an infinite or undefined number."""
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    """The value with infinite, undefined and huge numbers as null: JSON has none, or readers overflow."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, int):
        return value if abs(value) < _MAX_INTEGER else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
