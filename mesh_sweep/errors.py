"""The error of a sweep that cannot run."""

from __future__ import annotations


class SweepError(ValueError):
    """What is wrong and what to do, one line per problem. Raised by a case, it stops the whole sweep."""
