"""Frames of recorded robots alone, and frames of a history with what robots recorded that did not answer then. Pure."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from meshctl.monitor.frame import Frame, links_of
from meshctl.monitor.transport_recording import RecordedRobot, joined_by_name, number_of

# Frames of recordings alone are at least this far apart, and there are at most so many.
STEP_S = 1.0
MAX_FRAMES = 3600


def frames_of(robots: Sequence[RecordedRobot], fleet: str = "recording", limit: int = MAX_FRAMES) -> Iterator[Frame]:
    """Frames of recordings alone. Robots are drawn as devices, with the peers that they hear as links; a robot that
    others saw alone is one, too."""
    known = joined_by_name(robots)
    peers = {name for robot in robots for name in robot.peer_names}
    for name in sorted(peers - set(known)):
        known[name] = RecordedRobot(name, robots[0].samples)
    # things that have places but run no daemon
    beacons = frozenset(name for name, robot in known.items() if not robot.times_s and name not in peers)
    sampled_s = [time_s for robot in known.values() for time_s in robot.times_s]
    step_s = STEP_S
    if sampled_s:
        step_s = max(STEP_S, math.ceil((max(sampled_s) - min(sampled_s)) / limit))
    for time_s in sorted({round(time_s / step_s) * step_s for time_s in sampled_s}):
        documents = {
            name: found[1] for name, robot in known.items() if (found := robot.at(time_s + step_s / 2)) is not None
        }
        places = {
            name: place for name, robot in known.items() if (place := robot.place_at(time_s + step_s / 2)) is not None
        }
        yield _frame(time_s, fleet, list(known), beacons, documents, places)


def _frame(
    time_s: float,
    fleet: str,
    names: Sequence[str],
    beacons: Collection[str],
    documents: Mapping[str, Mapping[str, Any]],
    places: Mapping[str, Mapping[str, Any]],
) -> Frame:
    base = next((name for name, document in documents.items() if document["is_base"]), None)
    unrecorded = {name: _unrecorded(name, documents) for name in names if name not in documents}
    status = {
        "version": 1,
        "fleet": fleet,
        "taken_s": time_s,
        "entry": base,
        "alarms": [],
        "nodes": [
            _node(
                name, "base" if name == base else "beacon" if name in beacons else "robot", base, documents, unrecorded
            )
            for name in names
            if name not in beacons or name in places
        ],
        "robots": [
            {**documents[name], "health": "ok", "answers": True, "age_s": 0.0}
            if name in documents
            else {"name": name, "radios": [name], "alarms": [], **unrecorded[name]}
            for name in names
            if name not in beacons
        ],
    }
    return Frame.of(
        {
            "schema": 1,
            "time_s": time_s,
            "fleet": fleet,
            "verdict": None,
            "status": status,
            "links": links_of(status),
            "radios": {},
            "positions": places,
            "airtime": None,
        }
    )


def _unrecorded(name: str, documents: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The state of a robot without a recording at that time, as the others had it: it is not silent."""
    peers = [peer for document in documents.values() for peer in document["peers"] if peer["name"] == name]
    if not peers:
        return {"health": "unknown", "answers": None}
    ages_s = [age_s for peer in peers if (age_s := number_of(peer.get("heard_ago_s"))) is not None]
    age = {"age_s": min(ages_s)} if ages_s else {}
    if any(peer["online"] for peer in peers):
        return {"health": "ok", "answers": None, **age}
    return {"health": "unreachable", "answers": False, "silent_because": "offline for all that recorded", **age}


def _node(
    name: str,
    role: str,
    base: str | None,
    documents: Mapping[str, Mapping[str, Any]],
    unrecorded: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    peers = [] if name not in documents else [peer for peer in documents[name]["peers"] if peer["online"]]
    of_base = () if base is None else documents[base]["peers"]
    to_base = next((peer for peer in peers if peer["name"] == base), None)
    at_base = next((peer for peer in of_base if peer["name"] == name and peer["online"]), None)
    near = to_base or at_base
    stated = None if at_base is None else number_of(at_base.get("hops"))
    hops = 0 if name == base else None if near is None else 1 if stated is None else int(stated)
    return {
        "name": name,
        "role": role,
        "robot": None if role == "beacon" else name,
        "state": "deployed",
        "alarms": [],
        **unrecorded.get(name, {"health": "ok", "answers": True, "age_s": 0.0}),
        "hops": hops,
        "via": base if hops == 1 else None,
        "quality": _quality(near) if hops == 1 and near is not None else None,
        "neighbours": [
            {
                "name": peer["name"],
                "age_s": number_of(peer.get("heard_ago_s")),
                "quality": _quality(peer),
                "signal_dbm": None,
            }
            for peer in peers
        ],
    }


def _quality(peer: Mapping[str, Any]) -> float | None:
    loss = number_of(peer.get("loss"))
    return None if loss is None else round(1 - loss, 3)


def with_recorded(frame: Frame, robots: Mapping[str, RecordedRobot]) -> Frame:
    """The frame with what robots recorded that did not answer then, each marked `recorded`."""
    changed = False
    merged: list[Any] = []
    for listed in frame.status.get("robots") or ():
        recorded = (
            robots.get(str(listed.get("name"))) if isinstance(listed, dict) and listed.get("answers") is False else None
        )
        found = None if recorded is None else recorded.at(frame.time_s)
        if found is None:
            merged.append(listed)
            continue
        changed = True
        seen_s, document = found
        facts = {key: document[key] for key in ("peers", "queues", "topics", "recorded")}
        merged.append({**listed, **facts, "age_s": round(frame.time_s - seen_s, 3)})
    stated = frame.document.get("positions") or {}
    places = {
        name: place
        for name, robot in robots.items()
        if name not in stated and (place := robot.place_at(frame.time_s)) is not None
    }
    if not changed and not places:
        return frame
    status = {**frame.status, "robots": merged}
    return Frame.of({**frame.document, "status": status, "positions": {**stated, **places}})
