"""Events of a fleet run, as values: for live lines, plain lines, JSON lines and the journal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

from meshctl.fleet.outcome import Outcome


class EventKind(Enum):
    """`STEP` starts a step of a node, `PROGRESS` has its progress, `FINISHED` the node's outcome; `NOTE` is a line
    about the node or (empty node) the whole run."""

    STARTED = "started"
    STEP = "step"
    PROGRESS = "progress"
    NOTE = "note"
    FINISHED = "finished"


@dataclass(frozen=True, slots=True)
class Event:
    """`at_s` is Unix time; `fraction` 0..1 goes with PROGRESS; `outcome` with FINISHED."""

    kind: EventKind
    node: str
    at_s: float
    text: str = ""
    fraction: float | None = None
    outcome: Outcome | None = None


# Called from worker threads: an observer guards its own state.
Observer: TypeAlias = Callable[[Event], None]


def silent(event: Event) -> None:
    """The observer that shows nothing."""


@dataclass(frozen=True, slots=True)
class Tee:
    """Passes events to several observers, in order."""

    observers: tuple[Observer, ...]

    def __call__(self, event: Event) -> None:
        for observer in self.observers:
            observer(event)
