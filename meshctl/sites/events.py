"""A run's events as `meshctl apply --json` prints them: condensed for the uplink, and back as values."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from meshctl.fleet import Event, EventKind, Outcome, Result

# Passed by the next one of the same node: only the last of a batch is sent.
_PASSING = (EventKind.STARTED.value, EventKind.STEP.value, EventKind.PROGRESS.value)


def condensed(lines: bytes) -> list[dict[str, Any]]:
    """The events of these lines, without steps that a later event of the same node supersedes."""
    events = [event for line in lines.splitlines() if (event := _object(line))]
    last = {event.get("node"): index for index, event in enumerate(events) if event.get("node")}
    return [
        event
        for index, event in enumerate(events)
        if event.get("event") not in _PASSING or last.get(event.get("node")) == index
    ]


def _object(line: bytes) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def events_of(objects: Iterable[Mapping[str, Any]]) -> Iterator[Event]:
    """The events of a run's nodes; anything else, such as the end with its totals, is left out."""
    for found in objects:
        try:
            kind = EventKind(found.get("event"))
        except ValueError:
            continue
        outcome = found.get("outcome")
        fraction = found.get("fraction")
        yield Event(
            kind,
            str(found.get("node", "")),
            float(found.get("at_s", 0.0)),
            str(found.get("text", "")),
            None if fraction is None else float(fraction),
            outcome_of(outcome) if isinstance(outcome, Mapping) else None,
        )


def outcome_of(found: Mapping[str, Any]) -> Outcome:
    """The outcome that `report.progress.outcome_object` wrote."""
    facts = found.get("facts", {})
    return Outcome(
        str(found["node"]),
        Result(found["result"]),
        str(found.get("reason", "")),
        str(found.get("hint", "")),
        float(found.get("duration_s", 0.0)),
        {str(key): str(value) for key, value in facts.items()} if isinstance(facts, Mapping) else {},
    )


def final_outcomes(objects: Iterable[Mapping[str, Any]]) -> dict[str, Outcome]:
    """The outcomes in the event `ended`, which has all of them as they are in the site's journal."""
    for found in objects:
        if found.get("event") == "ended":
            return {outcome.node: outcome for outcome in map(outcome_of, found.get("outcomes", ()))}
    return {}
