"""A log that has each line once."""

from __future__ import annotations

import logging
from typing import Iterable, Set

MAX_LOGGED = 1000
"""Distinct lines: programs and other robots can invent names without bound."""


class OnceLog:
    """Warns of each line once, up to `MAX_LOGGED` lines."""

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._logged: Set[str] = set()

    def warn(self, lines: Iterable[str]) -> None:
        for line in lines:
            if line not in self._logged and len(self._logged) < MAX_LOGGED:
                self._logged.add(line)
                self._log.warning("%s", line)
