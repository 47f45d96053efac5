"""The mesh topics that a bridge publishes locally, and how much of them. Pure.

Peers send only what programs read: a bridge that reads `*` gets everything. In options and parameters an entry is a
topic or a pattern, with bounds: `video rate_hz=1 max_age_s=2`.
"""

from __future__ import annotations

from typing import Iterable, List, NamedTuple, Optional


class Receive(NamedTuple):
    """One topic or pattern; the bounds are those of `MeshClient.subscribe`."""

    pattern: str
    rate_hz: Optional[float] = None
    max_age_s: Optional[float] = None


EVERYTHING = (Receive("*"),)


def parse_receive(text: str) -> Receive:
    """Raises ValueError."""
    words = text.split()
    expected = "{!r}: expected TOPIC [rate_hz=HZ] [max_age_s=SECONDS]".format(text)
    if not words:
        raise ValueError(expected)
    found = Receive(words[0])
    for word in words[1:]:
        key, _, value = word.partition("=")
        if key not in ("rate_hz", "max_age_s"):
            raise ValueError("{}, found {!r}".format(expected, word))
        try:
            number = float(value)
        except ValueError as error:
            raise ValueError("{}, found {!r}".format(expected, word)) from error
        if not 0.001 <= number <= 1e6:
            raise ValueError("{} with numbers from 0.001 to 1e6, found {!r}".format(expected, word))
        found = found._replace(rate_hz=number) if key == "rate_hz" else found._replace(max_age_s=number)
    return found


def with_needed(received: Iterable[Receive], needed: Iterable[str]) -> List[Receive]:
    """The entries and the topics that the bridge itself needs; everything if there are no entries."""
    entries = list(received)
    if not entries:
        return list(EVERYTHING)
    return entries + [Receive(pattern) for pattern in needed]
