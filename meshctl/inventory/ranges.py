"""Ranges of names: `b[01-12]`, `b[1,3,5-7]`, also several in one name.

A number keeps the width of the range's first one: `[01-12]` makes 01, 02, ... 12.
"""

from __future__ import annotations

import re
from itertools import product

# Far above any fleet; bounds the memory that one short line can ask for.
MAX_NAMES = 100_000

_PART = re.compile(r"\[([^\[\]]*)\]")
_ITEM = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?|([A-Za-z0-9._]+)")


class BadRange(ValueError):
    """A pattern that is no range, or one that makes too many names; the text says which."""


def is_range(pattern: str) -> bool:
    return "[" in pattern or "]" in pattern


def expand(pattern: str) -> tuple[str, ...]:
    """The names that `pattern` makes, in order; the pattern itself when it has no brackets. Raises BadRange."""
    if not is_range(pattern):
        return (pattern,)
    pieces = _PART.split(pattern)
    if any("[" in piece or "]" in piece for piece in pieces):
        raise BadRange("brackets do not match")
    choices: list[tuple[str, ...]] = []
    count = 1
    for number, piece in enumerate(pieces):
        choices.append(_choices(piece) if number % 2 else (piece,))
        count *= len(choices[-1])
        if count > MAX_NAMES:
            raise BadRange(f"makes more than {MAX_NAMES} names")
    names = tuple("".join(parts) for parts in product(*choices))
    if len(set(names)) != len(names):
        raise BadRange("makes the same name twice")
    return names


def _choices(body: str) -> tuple[str, ...]:
    """What stands between one pair of brackets: a comma-separated list of numbers, spans and words."""
    made: list[str] = []
    for item in body.split(","):
        match = _ITEM.fullmatch(item.strip())
        if match is None:
            raise BadRange(f"cannot read '{item.strip()}'")
        first, last, word = match.groups()
        if word is not None:
            made.append(word)
            continue
        low, high = int(first), int(last if last is not None else first)
        if high < low:
            raise BadRange(f"runs backwards: {first}-{last}")
        if high - low >= MAX_NAMES:
            raise BadRange(f"makes {high - low + 1} names, at most {MAX_NAMES} are allowed")
        made.extend(str(number).zfill(len(first)) for number in range(low, high + 1))
    return tuple(made)
