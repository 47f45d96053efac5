"""The error of a sweep that cannot run."""

from __future__ import annotations


class SweepError(ValueError):
    """A problem and its remedy, one line each. Raised by a case, it stops the whole sweep."""
