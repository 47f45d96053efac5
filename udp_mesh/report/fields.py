"""Fields of a recording's lines: read with what was expected and found, if they are something else."""

from __future__ import annotations

from typing import Any

MAX_BYTES = 1 << 50


class UnreadableError(ValueError):
    """A value that cannot be read: what was expected, and what was found."""

    def __init__(self, expected: str, found: object) -> None:
        text = found if isinstance(found, str) else repr(found)
        super().__init__(f"expected {expected}, found {text if len(text) <= 60 else text[:57] + '...'}")


def rows(entry: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """A list of objects."""
    found = entry.get(key)
    if not isinstance(found, list) or not all(isinstance(row, dict) for row in found):
        raise UnreadableError(f"a list of objects as {key}", found)
    return found


def text(entry: dict[str, Any], key: str) -> str:
    """A string that can be encoded as UTF-8."""
    value = entry.get(key)
    if not isinstance(value, str):
        raise UnreadableError(f"a string as {key}", value)
    # JSON can encode a lone surrogate, which cannot be encoded as UTF-8.
    return value.encode(errors="replace").decode()


def number(entry: dict[str, Any], key: str, minimum: float, maximum: float) -> float:
    """A number in this range."""
    value = entry.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not minimum <= value <= maximum:
        raise UnreadableError(f"a number from {minimum:g} to {maximum:g} as {key}", value)
    try:
        return float(value)
    except OverflowError as error:
        raise UnreadableError(f"a number from {minimum:g} to {maximum:g} as {key}", "a larger one") from error


def integer(entry: dict[str, Any], key: str) -> int:
    """A count."""
    return int(number(entry, key, 0, MAX_BYTES))
