"""Suggestions for unknown names."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from functools import lru_cache

# of difflib's ratio: above it, `chanel` resembles `channel`; below it, `absent` does not resemble `base`
_MIN_SIMILARITY = 0.65


def nearest(wrong: str, known: Iterable[str]) -> str:
    """The known name most similar to `wrong`, or an empty string."""
    # Longer names are not typos, and the comparison is quadratic in their length.
    return "" if len(wrong) > 64 else _nearest(wrong, tuple(known))


@lru_cache(maxsize=256)
def _nearest(wrong: str, names: tuple[str, ...]) -> str:
    lowered = {name.lower(): name for name in names}
    exact = lowered.get(wrong.lower().replace("-", "_"))
    if exact is not None:
        return exact
    matches = get_close_matches(wrong.lower(), lowered, n=1, cutoff=_MIN_SIMILARITY)
    return lowered[matches[0]] if matches else ""


def did_you_mean(wrong: str, known: Iterable[str]) -> str:
    """`did you mean 'channel'?`, or an empty string."""
    name = nearest(wrong, known)
    return f"did you mean '{name}'?" if name else ""
