"""How messages count, list and name things: `1 line`, `2 lines`; `a, b, c, d and 71 more`."""

from __future__ import annotations

import re
from collections.abc import Sequence

# names in one sentence
_MAX_NAMES = 4
# names that are not yet folded into a count
MAX_IN_FULL = 8


# as `fleet.process` names a process: user@host:pid:start
_LOCK = re.compile(r"(?P<who>[^\s:]+@[^\s:]+):(?P<pid>[0-9]+):[0-9]+")


def lock_owners(text: str) -> str:
    """The text with the owners of locks as a person reads them: `ada@base (process 17)` for `ada@base:17:4711`."""
    return _LOCK.sub(r"\g<who> (process \g<pid>)", text)


def counted(number: int, noun: str) -> str:
    """`1 error`, `2 errors`; an `s` is added to `noun`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def join_limited(names: Sequence[str], limit: int = _MAX_NAMES) -> str:
    """The first `limit` names, and how many others there are."""
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"


def node_list(names: Sequence[str]) -> str:
    """All names of a few nodes; `75 nodes (a, b, c, d and 71 more)` of many."""
    return ", ".join(names) if len(names) <= MAX_IN_FULL else f"{counted(len(names), 'node')} ({join_limited(names)})"


def all_of(names: Sequence[str]) -> str:
    """`b01, b02 and b03`."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def one_of(names: Sequence[str]) -> str:
    """The alternatives after `expected`; the name alone if there is no other."""
    return names[0] if len(names) == 1 else f"one of {join_limited(names)}"


def two_digits(value: float) -> str:
    """A positive number with two significant digits, or as a whole number: `0.75`, `7.5`, `120`, never `1.2e+02`."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
