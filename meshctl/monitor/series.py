"""Charts of devices: frames, one after the other -> numbers over time. An unknown value is None and leaves a gap."""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

from meshctl.monitor.frame import Frame

Number = float | int | None
# More neighbors than this cannot be distinguished in one chart; the strongest are shown.
MAX_LINES = 6
_UNKNOWN = math.nan
_NEIGHBORS = (("Signal to noise", "dB", "snr_db", 1.0), ("Link quality", "%", "quality", 100.0))
_QUEUES = (("Queued messages", "", "messages"), ("Oldest in queue", "s", "oldest_s"))
_PEERS = (("Round trip", "ms", "round_trip_s", 1000.0), ("Loss", "%", "loss", 100.0))
# Lines of one chart, by label: a value per frame up to the last known one. Frames of a large fleet do not fit into
# memory; these do.
_Lines: TypeAlias = "dict[str, array[float]]"


class DeviceCharts:
    """Gathers the charts of one device, or of all; `add` each frame once."""

    def __init__(self, device: str | None = None) -> None:
        self._device = device
        self._times_s: list[float] = []
        # by device or robot, then by title
        self._lines: dict[str, dict[str, _Lines]] = defaultdict(lambda: defaultdict(dict))
        self._robot_of: dict[str, str] = {}
        self._names: dict[str, None] = {}

    @property
    def devices(self) -> list[str]:
        """The names of all radios, and of robots that have none, in order of appearance."""
        return list(self._names)

    def add(self, frame: Frame) -> None:
        document = frame.document
        status = document.get("status")
        self._links(document)
        for node in _list(status, "nodes"):
            if isinstance(name := node.get("name"), str):
                self._names[name] = None
                if self._is_wanted(name):
                    self._note(name, "Path to base", "path", node.get("quality"), 100)
        radios = document.get("radios")
        for name in radios if isinstance(radios, Mapping) else ():
            if self._is_wanted(name):
                for radio in _list(radios, name):
                    self._note(name, "Channel busy", str(radio.get("ifname", "radio")), radio.get("busy_ratio"), 100)
        for robot in _list(status, "robots"):
            if isinstance(robot.get("name"), str):
                self._names[robot["name"]] = None
                self._robot(robot["name"], robot)
        self._times_s.append(frame.time_s)

    def of(self, device: str) -> list[dict[str, Any]]:
        """`[{title, unit, times_s, series: [{label, values}]}]` for a radio, and the robot that carries it."""
        lines = self._lines.get(device, {})
        robot = self._lines.get(self._robot_of.get(device, ""), {})
        rows: list[tuple[str, str, Mapping[str, array[float]]]] = [
            *((title, unit, _strongest(lines.get(title, {}))) for title, unit, _, _ in _NEIGHBORS),
            ("Path to base", "%", lines.get("Path to base", {})),
            ("Channel busy", "%", lines.get("Channel busy", {})),
            *((title, unit, _used(robot.get(title, {}))) for title, unit, _ in _QUEUES),
            *((title, unit, dict(sorted(robot.get(title, {}).items()))) for title, unit, _, _ in _PEERS),
        ]
        return [
            {
                "title": title,
                "unit": unit,
                "times_s": self._times_s,
                "series": [{"label": label, "values": self._values(values)} for label, values in series.items()],
            }
            for title, unit, series in rows
            if series
        ]

    def _is_wanted(self, name: str) -> bool:
        return self._device is None or name == self._device

    def _links(self, document: Mapping[str, Any]) -> None:
        """How each device hears its neighbors."""
        for link in _list(document, "links"):
            to, heard = link.get("to"), link.get("from")
            if isinstance(to, str) and isinstance(heard, str) and self._is_wanted(to):
                for title, _, key, factor in _NEIGHBORS:
                    self._note(to, title, heard, link.get(key), factor)

    def _robot(self, name: str, robot: Mapping[str, Any]) -> None:
        carried = [radio for radio in robot.get("radios") or () if isinstance(radio, str)]
        for device in (name, *carried):
            self._robot_of.setdefault(device, name)
        if self._device is not None and self._device not in (name, *carried):
            return
        for queue in _list(robot, "queues"):
            for title, _, key in _QUEUES:
                self._note(name, title, f"priority {queue.get('priority')}", queue.get(key), 1)
        for peer in _list(robot, "peers"):
            # the last values of an offline peer are not its current ones
            if peer.get("online"):
                for title, _, key, factor in _PEERS:
                    self._note(name, title, str(peer.get("name")), peer.get(key), factor)

    def _note(self, device: str, title: str, label: str, value: object, factor: float) -> None:
        if not isinstance(value, int | float):
            return
        values = self._lines[device][title].setdefault(label, array("d"))
        index = len(self._times_s)
        if len(values) <= index:
            values.extend([_UNKNOWN] * (index + 1 - len(values)))
        values[index] = round(value * factor, 3)

    def _values(self, values: array[float]) -> list[Number]:
        known = [None if math.isnan(value) else int(value) if value.is_integer() else value for value in values]
        return [*known, *[None] * (len(self._times_s) - len(known))]


def charts_of(frames: Iterable[Frame], device: str) -> list[dict[str, Any]]:
    """The charts of one device."""
    charts = DeviceCharts(device)
    for frame in frames:
        charts.add(frame)
    return charts.of(device)


def _strongest(lines: _Lines) -> _Lines:
    best = sorted(lines, key=lambda name: -max(value for value in lines[name] if not math.isnan(value)))[:MAX_LINES]
    return {name: lines[name] for name in sorted(best)}


def _used(lines: _Lines) -> _Lines:
    """By priority; those that were always empty are left out."""
    used = {label: values for label, values in lines.items() if any(value > 0 for value in values)}
    return dict(sorted(used.items(), key=lambda item: int(item[0].rpartition(" ")[2])))


def _list(document: object, key: str) -> Iterable[Mapping[str, Any]]:
    value = document.get(key) if isinstance(document, Mapping) else None
    return (item for item in value if isinstance(item, Mapping)) if isinstance(value, list) else ()
