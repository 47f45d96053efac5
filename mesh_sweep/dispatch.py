"""Choose the cases to run next, and find the one to blame when workers die. Pure: `run` submits and waits.

When a worker dies, every case that was running is a suspect: a pool does not say which one it was. Suspects run again
after all others, in rounds with a quarter of the cases at once, down to one. A case that kills its worker twice while
nothing else runs is given up.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable

from mesh_sweep.cases import Case

MAX_LONE_DEATHS = 2
"""Once may be the machine: out of memory, or an operator's kill."""
_SHRINK = 4


class Dispatch:
    """`take` gives the cases to submit; each of them ends with `done` or `died`."""

    def __init__(self, cases: Iterable[Case]) -> None:
        self._waiting = deque(cases)
        self._suspects: list[Case] = []
        self._running: set[Case] = set()
        self._round = 0
        self._at_once = 0
        self._lone_deaths: Counter[Case] = Counter()

    @property
    def is_finished(self) -> bool:
        return not (self._waiting or self._suspects or self._running)

    def take(self, width: int) -> list[Case]:
        """The cases to submit now; `width` is how many the workers should have at once."""
        if not self._waiting and not self._running and self._suspects:
            self._waiting.extend(self._suspects)
            self._suspects.clear()
            self._round += 1
        self._at_once = max(1, width // _SHRINK**self._round)
        taken: list[Case] = []
        while self._waiting and len(self._running) < self._at_once:
            taken.append(self._waiting.popleft())
            self._running.add(taken[-1])
        return taken

    def done(self, case: Case) -> None:
        """The case has a result, or failed by itself."""
        self._running.remove(case)

    def died(self, cases: Iterable[Case]) -> list[Case]:
        """These cases lost their worker. Returns those to give up."""
        lost = list(cases)
        alone = self._at_once == 1 and len(self._running) == 1
        given_up: list[Case] = []
        for case in lost:
            self._running.remove(case)
            self._lone_deaths[case] += alone
            (given_up if self._lone_deaths[case] >= MAX_LONE_DEATHS else self._suspects).append(case)
        return given_up
