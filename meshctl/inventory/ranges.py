"""Ranges of names: `b[01-12]`, `b[1,3,5-7]`; a name may contain several.

Numbers keep the width of the first one: `[01-12]` expands to 01, 02, ... 12.
"""

from __future__ import annotations

import re
from itertools import product

# Far above any fleet; bounds the memory that one short line can require.
MAX_NAMES = 100_000

_PART = re.compile(r"\[([^\[\]]*)\]")
_ITEM = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?|([A-Za-z0-9._]+)")
# a span as other programs write it
_DOTTED = re.compile(r"(\d{1,9})\.{2,3}(\d{1,9})")


class BadRange(ValueError):
    """An invalid range, or one that expands to too many names; the message says which."""


def is_range(pattern: str) -> bool:
    return "[" in pattern or "]" in pattern


def expand(pattern: str) -> tuple[str, ...]:
    """The names of `pattern`, in order; the pattern itself if it has no brackets. Raises BadRange."""
    if not is_range(pattern):
        return (pattern,)
    pieces = _PART.split(pattern)
    if any("[" in piece or "]" in piece for piece in pieces):
        raise BadRange("unbalanced brackets")
    choices: list[tuple[str, ...]] = []
    count = 1
    for number, piece in enumerate(pieces):
        choices.append(_choices(piece) if number % 2 else (piece,))
        count *= len(choices[-1])
        if count > MAX_NAMES:
            raise BadRange(f"expands to more than {MAX_NAMES} names")
    names = tuple("".join(parts) for parts in product(*choices))
    if len(set(names)) != len(names):
        raise BadRange("expands to the same name twice")
    return names


def _choices(body: str) -> tuple[str, ...]:
    """Expand the content of brackets: a comma-separated list of numbers, spans and words."""
    made: list[str] = []
    for item in body.split(","):
        match = _ITEM.fullmatch(item.strip())
        if match is None:
            raise BadRange(f"invalid item '{item.strip()}'")
        first, last, word = match.groups()
        if word is not None and (dotted := _DOTTED.fullmatch(word)) is not None:
            raise BadRange(f"'{word}' is a word: write {dotted[1]}-{dotted[2]} for a span of numbers")
        if word is not None:
            made.append(word)
            continue
        low, high = int(first), int(last if last is not None else first)
        if high < low:
            raise BadRange(f"descending span {first}-{last}")
        if high - low >= MAX_NAMES:
            raise BadRange(f"expands to {high - low + 1} names (at most {MAX_NAMES})")
        made.extend(str(number).zfill(len(first)) for number in range(low, high + 1))
    return tuple(made)
