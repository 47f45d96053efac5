"""Work on many nodes: bounded concurrency, one outcome per node, cancellation, and a persistent journal."""

from meshctl.fleet.events import Event, EventKind, Observer, Tee, silent
from meshctl.fleet.interrupt import Interrupt
from meshctl.fleet.outcome import Outcome, Result, Totals, totals
from meshctl.fleet.run import FailureBudget, outcome_of_error, run

__all__ = [
    "Event",
    "EventKind",
    "FailureBudget",
    "Interrupt",
    "Observer",
    "Outcome",
    "Result",
    "Tee",
    "Totals",
    "outcome_of_error",
    "run",
    "silent",
    "totals",
]
