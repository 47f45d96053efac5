"""What came of one node's work, in one word and one sentence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType


class Result(Enum):
    """How a node's work ended. Every node of a run has exactly one."""

    DONE = "done"
    # nothing to do: the node already is as the inventory says
    UNCHANGED = "unchanged"
    # the change was applied and did not prove itself: the node runs its previous state again
    ROLLED_BACK = "rolled back"
    # it failed before anything on the node was changed
    FAILED = "failed"
    # it did not answer, so nothing was changed
    UNREACHABLE = "unreachable"
    # not taken up in this run (off, behind a stop or an interruption); a resume takes it up
    PENDING = "pending"
    # meshctl would not: wrong board, foreign changes, another operator's lock, moved on since the plan
    REFUSED = "refused"
    # armed and out of sight: the node goes back by itself, or has already; the next contact tells
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
        """Whether it counts towards `stop_after_failures`: something went wrong with a node that was in work."""
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
        """Whether nothing but unreachable nodes kept the run from being good."""
        return not self.all_good and all(
            result.is_good or result in (Result.UNREACHABLE, Result.PENDING) for result in self.counts
        )

    def __str__(self) -> str:
        return ", ".join(f"{count} {result.value}" for result, count in self.counts.items()) or "no node"


def totals(outcomes: Iterable[Outcome]) -> Totals:
    """Count the results of a run."""
    counted = Counter(outcome.result for outcome in outcomes)
    return Totals(MappingProxyType({result: counted[result] for result in Result if counted[result]}))
