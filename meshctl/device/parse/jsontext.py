"""JSON from a node, read without trust in its shape: every accessor gives the type it says, or the default."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping


def parse_json(text: str) -> object:
    """The value, or None for what is not JSON (or nested so deep that it cannot be ours)."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, dict) else {}


def maps(value: object) -> Iterator[Mapping[str, object]]:
    """The objects of a list; nothing for what is no list."""
    if isinstance(value, list):
        yield from (item for item in value if isinstance(item, dict))


def string(value: object) -> str:
    """A string as it is, a number or boolean value as JSON writes it, else empty."""
    if isinstance(value, str):
        return value
    return json.dumps(value) if isinstance(value, bool | int | float) else ""


def strings(value: object) -> tuple[str, ...]:
    """A list's strings; one string is split at blanks, as UCI does."""
    if isinstance(value, str):
        return tuple(value.split())
    return tuple(item for item in value if isinstance(item, str)) if isinstance(value, list) else ()


def integer(value: object) -> int | None:
    """A whole number; true and false are none."""
    if isinstance(value, bool):
        return None
    if isinstance(value, float):
        return int(value) if value == value and abs(value) < 1e18 else None
    return value if isinstance(value, int) else None


def boolean(value: object) -> bool:
    return value is True
