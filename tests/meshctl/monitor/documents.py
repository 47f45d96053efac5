"""Status documents and frames for tests of the monitor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from meshctl.monitor.frame import Frame, frame_of
from meshctl.status.preflight import Check

# (device, code) -> level; robots' computers as `robot:NAME`, the fleet as ``
Alarms = Mapping[tuple[str, str], str]


def status(alarms: Alarms | None = None, *, silent: tuple[str, ...] = (), padding: str = "") -> dict[str, Any]:
    """The parts of a status document that frames and the alarm log read."""
    raised = alarms or {}

    def of(device: str) -> list[dict[str, str]]:
        return [
            {"level": level, "code": code, "text": f"{code} of {device}", "hint": "look"}
            for (name, code), level in raised.items()
            if name == device
        ]

    nodes = ("base", "b01", "b02")
    return {
        "version": 1,
        "fleet": "lab",
        "took_s": 0.5,
        "totals": {"alarms": {lv: sum(one == lv for one in raised.values()) for lv in ("error", "warning", "note")}},
        "alarms": of(""),
        "nodes": [{"name": n, "answers": n not in silent, "age_s": 0.25, "alarms": of(n)} for n in nodes],
        "robots": [{"name": "rover", "answers": True, "alarms": of("robot:rover")}],
        "padding": padding,
    }


def frame(time_s: float, alarms: Alarms | None = None, *, go: bool | None = True, **other: Any) -> Frame:
    checks = None if go is None else [Check("base", go, "base answers" if go else "base is silent")]
    return frame_of(status(alarms, **other), time_s=time_s, checks=checks)
