"""Choose the path of a finding about several values: one that the inventory sets explicitly."""

from __future__ import annotations

from meshctl.model import Fleet


def is_written(fleet: Fleet, path: tuple[str, ...]) -> bool:
    """Whether the inventory sets this value in any layer, rather than using a default."""
    return path in fleet.provenance


def first_written(fleet: Fleet, *paths: tuple[str, ...]) -> tuple[str, ...]:
    """The first of `paths` that the inventory sets; the first path if it sets none."""
    return next((path for path in paths if is_written(fleet, path)), paths[0])
