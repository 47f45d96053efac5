"""Suggestions for unknown names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import SequenceMatcher, get_close_matches
from functools import lru_cache

# difflib's ratio: above it, `chanel` resembles `channel`; below it, `absent` does not resemble `base`
_MIN_SIMILARITY = 0.65
# if more names than this are equally near, none is likely to be meant
_MAX_NAMES = 3


def nearest(word: str, known: Iterable[str]) -> tuple[str, ...]:
    """The known names most similar to `word`, all that are equally near; none if they are more than three."""
    # Longer names are not typos, and the comparison is quadratic in their length.
    return () if len(word) > 64 else _nearest(word, tuple(known))


@lru_cache(maxsize=256)
def _nearest(word: str, names: tuple[str, ...]) -> tuple[str, ...]:
    lowered = {name.lower(): name for name in names}
    written = word.lower()
    exact = lowered.get(written.replace("-", "_"))
    if exact is not None:
        return (exact,)
    matches = get_close_matches(written, lowered, n=_MAX_NAMES + 1, cutoff=_MIN_SIMILARITY)
    similarity = {name: SequenceMatcher(None, name, written).ratio() for name in matches}
    best = max(similarity.values(), default=0.0)
    near = tuple(lowered[name] for name in lowered if similarity.get(name) == best)
    return near if len(near) <= _MAX_NAMES else ()


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`did you mean 'channel'?`, or an empty string."""
    return suggestion(nearest(word, known))


def suggestion(names: Sequence[str]) -> str:
    """`did you mean 'b01', 'b02' or 'b03'?`; empty without names."""
    quoted = [f"'{name}'" for name in names]
    return f"did you mean {' or '.join(filter(None, (', '.join(quoted[:-1]), quoted[-1])))}?" if quoted else ""
