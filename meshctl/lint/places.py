"""Where a finding about two values points: at the one that is written."""

from __future__ import annotations

from meshctl.model import Fleet


def is_written(fleet: Fleet, path: tuple[str, ...]) -> bool:
    """Whether the inventory writes this very value, in whatever layer, instead of leaving it to a default."""
    return path in fleet.provenance


def first_written(fleet: Fleet, *paths: tuple[str, ...]) -> tuple[str, ...]:
    """The first of `paths` that the inventory writes; the first of all when it writes none."""
    return next((path for path in paths if is_written(fleet, path)), paths[0])
