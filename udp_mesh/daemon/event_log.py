"""Events of the core as lines of the log, bounded: a flapping link or a full disk must not fill the robot's disk."""

from __future__ import annotations

import logging
from collections.abc import Callable

from udp_mesh.daemon.status import Json

log = logging.getLogger(__name__)

PERIOD_S = 60.0
MAX_LINES = 100
"""Of one kind of event within a period: more than the robots of a large team that come online together."""


class _Kind:
    """The lines of one kind of event in its present period."""

    def __init__(self, began: float) -> None:
        self.began = began
        self.lines = 0
        self.unlogged = 0


class EventLog:
    """Writes a line for each event; beyond `MAX_LINES` of a kind in a period it counts them (`unlogged`)."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._kinds: dict[str, _Kind] = {}

    def write(self, fields: Json) -> None:
        """Write an event, given as `event_json` does."""
        name, now = str(fields["event"]), self._clock()
        kind = self._kinds.setdefault(name, _Kind(now))
        text = " ".join(f"{key}={value}" for key, value in fields.items() if key != "event")
        if now - kind.began >= PERIOD_S:
            if kind.unlogged:
                text += f" unlogged={kind.unlogged}"
            kind = self._kinds[name] = _Kind(now)
        if kind.lines >= MAX_LINES:
            kind.unlogged += 1
            return
        kind.lines += 1
        log.info("%s %s", name, text)
