"""The outcome of a node in a run: a result, a reason and facts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType


class Result(Enum):
    """How a node's work ended. Every node of a run has exactly one."""

    DONE = "done"
    # nothing to do: the node matches the inventory
    UNCHANGED = "unchanged"
    # the change was applied and did not prove itself: the node runs its previous state again
    ROLLED_BACK = "rolled back"
    # it failed before anything on the node was changed
    FAILED = "failed"
    # it did not answer, so nothing was changed
    UNREACHABLE = "unreachable"
    # not started in this run (off, or after a stop or an interruption); a resume starts it
    PENDING = "pending"
    # a precondition failed: wrong board, uncommitted changes, another operator's lock, a stale plan
    REFUSED = "refused"
    # armed and unreachable: the node rolls back by itself; the next observation shows it
    UNCERTAIN = "uncertain"

    @property
    def is_good(self) -> bool:
        return self in (Result.DONE, Result.UNCHANGED)

    @property
    def is_settled(self) -> bool:
        """Whether a resume has nothing left to do for this node."""
        return self.is_good

    @property
    def is_failure(self) -> bool:
        """Whether it counts toward `stop_after_failures`: a node that was started has failed."""
        return self in (Result.ROLLED_BACK, Result.FAILED, Result.UNCERTAIN, Result.UNREACHABLE)


@dataclass(frozen=True, slots=True)
class Outcome:
    """`reason` is one sentence for a person; `facts` are details for scripts (never secrets)."""

    node: str
    result: Result
    reason: str = ""
    hint: str = ""
    duration_s: float = 0.0
    facts: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def __str__(self) -> str:
        return f"{self.node}: {self.result.value}" + (f": {self.reason}" if self.reason else "")


@dataclass(frozen=True, slots=True)
class Totals:
    """How many nodes ended in each result, in the order of `Result`."""

    counts: Mapping[Result, int]

    @property
    def all_good(self) -> bool:
        return all(result.is_good for result in self.counts)

    @property
    def none_reached(self) -> bool:
        """Whether all nodes that are not good are unreachable or pending."""
        return not self.all_good and all(
            result.is_good or result in (Result.UNREACHABLE, Result.PENDING) for result in self.counts
        )

    def __str__(self) -> str:
        return ", ".join(f"{count} {result.value}" for result, count in self.counts.items()) or "no node"


def totals(outcomes: Iterable[Outcome]) -> Totals:
    """Count the results of a run."""
    counted = Counter(outcome.result for outcome in outcomes)
    return Totals(MappingProxyType({result: counted[result] for result in Result if counted[result]}))
