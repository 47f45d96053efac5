"""The error of a sweep that cannot run."""

from __future__ import annotations

CONTINUE = "the results so far are kept, and the same command continues"


class SweepError(ValueError):
    """A problem and its remedy, one line each. Raised by a case, it stops the whole sweep."""
