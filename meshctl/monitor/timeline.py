"""Many frames -> few: stretches of time with their worst state, and evenly thinned ones. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TimelineBucket:
    """A stretch of time: `go` False if any of its frames was a no-go, None if none was assessed; the most alarms that
    any of its frames had, by level. `frames` 0: nothing was recorded."""

    start_s: float
    end_s: float
    frames: int
    go: bool | None
    errors: int
    warnings: int
    notes: int


def buckets_of(rows: Iterable[tuple[int, ...]], start_ms: int, end_ms: int, buckets: int) -> tuple[TimelineBucket, ...]:
    """Equal stretches from rows of index, frames, go, errors, warnings and notes; those without a row have no frame."""
    by_bucket = {row[0]: row[1:] for row in rows}
    width_s = (end_ms - start_ms) / buckets / 1000
    return tuple(
        TimelineBucket(
            start_ms / 1000 + index * width_s,
            start_ms / 1000 + (index + 1) * width_s,
            count,
            None if go is None else bool(go),
            *(errors, warnings, notes),
        )
        for index in range(buckets)
        for count, go, errors, warnings, notes in (by_bucket.get(index, (0, None, 0, 0, 0)),)
    )


def thinned(items: list[int], limit: int) -> list[int]:
    """At most `limit` of the items at even distances, the first and the last among them."""
    if len(items) <= limit:
        return items
    if limit == 1:
        return items[-1:]
    return [items[round(index * (len(items) - 1) / (limit - 1))] for index in range(limit)]
