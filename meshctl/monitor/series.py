"""Charts of one device: frames -> its numbers over time. Pure; an unknown value is None and leaves a gap."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from meshctl.monitor.frame import Frame

Number = float | int | None
# More neighbors than this cannot be distinguished in one chart; the strongest are shown.
MAX_LINES = 6


def charts_of(frames: Sequence[Frame], device: str) -> list[dict[str, Any]]:
    """`[{title, unit, times_s, series: [{label, values}]}]` for a radio, and the robot that carries it."""
    documents = [frame.document for frame in frames]
    times_s = [frame.time_s for frame in frames]
    robot = _robot_name(documents, device)
    rows: list[tuple[str, str, dict[str, list[Number]]]] = [
        ("Signal to noise", "dB", _by_neighbor(documents, device, "snr_db")),
        ("Link quality", "%", _by_neighbor(documents, device, "quality", 100)),
        ("Path to base", "%", _one(documents, device, "path", lambda node: _scaled(node.get("quality"), 100))),
        ("Channel busy", "%", _radio(documents, device, "busy_ratio", 100)),
    ]
    if robot:
        rows += [
            ("Queued messages", "", _queues(documents, robot, "messages")),
            ("Oldest in queue", "s", _queues(documents, robot, "oldest_s")),
            ("Round trip", "ms", _peers(documents, robot, "round_trip_s", 1000)),
            ("Loss", "%", _peers(documents, robot, "loss", 100)),
        ]
    return [
        {
            "title": title,
            "unit": unit,
            "times_s": times_s,
            "series": [{"label": label, "values": values} for label, values in series.items()],
        }
        for title, unit, series in rows
        if series
    ]


def devices_of(frames: Iterable[Frame]) -> list[str]:
    """The names of all radios, and of robots that have none, in order of appearance."""
    found: dict[str, None] = {}
    for frame in frames:
        for kind in ("nodes", "robots"):
            found.update((one["name"], None) for one in _list(frame.status, kind) if isinstance(one.get("name"), str))
    return list(found)


def _robot_name(documents: Iterable[Mapping[str, Any]], device: str) -> str:
    for document in documents:
        for robot in _list(document.get("status"), "robots"):
            if robot.get("name") == device or device in (robot.get("radios") or ()):
                return str(robot.get("name"))
    return ""


def _by_neighbor(
    documents: Sequence[Mapping[str, Any]], device: str, key: str, factor: float = 1
) -> dict[str, list[Number]]:
    """How the device hears each neighbor."""
    found: dict[str, list[Number]] = {}
    for index, document in enumerate(documents):
        for link in _list(document, "links"):
            value = link.get(key)
            if link.get("to") != device or not isinstance(value, int | float) or not isinstance(link.get("from"), str):
                continue
            found.setdefault(link["from"], [None] * len(documents))[index] = _scaled(value, factor)
    best = sorted(found, key=lambda name: -max(value for value in found[name] if value is not None))[:MAX_LINES]
    return {name: found[name] for name in sorted(best)}


def _one(
    documents: Sequence[Mapping[str, Any]], device: str, label: str, value_of: Callable[[Mapping[str, Any]], Number]
) -> dict[str, list[Number]]:
    values: list[Number] = []
    for document in documents:
        nodes = [node for node in _list(document.get("status"), "nodes") if node.get("name") == device]
        values.append(value_of(nodes[0]) if nodes else None)
    return {label: values} if any(value is not None for value in values) else {}


def _radio(documents: Sequence[Mapping[str, Any]], device: str, key: str, factor: float) -> dict[str, list[Number]]:
    found: dict[str, list[Number]] = {}
    for index, document in enumerate(documents):
        radios = document.get("radios")
        for radio in _list(radios, device):
            value = radio.get(key)
            if isinstance(value, int | float):
                label = str(radio.get("ifname", "radio"))
                found.setdefault(label, [None] * len(documents))[index] = _scaled(value, factor)
    return found


def _queues(documents: Sequence[Mapping[str, Any]], robot: str, key: str) -> dict[str, list[Number]]:
    """By priority; those that were always empty are left out."""
    found: dict[str, list[Number]] = {}
    for index, one in _robots(documents, robot):
        for queue in _list(one, "queues"):
            label = f"priority {queue.get('priority')}"
            found.setdefault(label, [None] * len(documents))[index] = _scaled(queue.get(key), 1)
    used = {label: values for label, values in found.items() if any(values)}
    return dict(sorted(used.items(), key=lambda item: int(item[0].rpartition(" ")[2])))


def _peers(documents: Sequence[Mapping[str, Any]], robot: str, key: str, factor: float) -> dict[str, list[Number]]:
    found: dict[str, list[Number]] = {}
    for index, one in _robots(documents, robot):
        for peer in _list(one, "peers"):
            # what an offline peer had last is not what it has now
            value = peer.get(key) if peer.get("online") else None
            found.setdefault(str(peer.get("name")), [None] * len(documents))[index] = _scaled(value, factor)
    return {label: values for label, values in sorted(found.items()) if any(value is not None for value in values)}


def _robots(documents: Sequence[Mapping[str, Any]], robot: str) -> Iterable[tuple[int, Mapping[str, Any]]]:
    for index, document in enumerate(documents):
        for one in _list(document.get("status"), "robots"):
            if one.get("name") == robot:
                yield index, one


def _scaled(value: object, factor: float) -> Number:
    return round(value * factor, 3) if isinstance(value, int | float) else None


def _list(document: object, key: str) -> Iterable[Mapping[str, Any]]:
    value = document.get(key) if isinstance(document, Mapping) else None
    return (item for item in value if isinstance(item, Mapping)) if isinstance(value, list) else ()
