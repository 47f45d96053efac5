"""One node in work: what is known of it, who is to hear of its steps, and where they are written down."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from meshctl.apply.access import Access
from meshctl.apply.checks import Expectation
from meshctl.device.observation import Observation
from meshctl.device.upload import Progress
from meshctl.fleet import Event, EventKind, Interrupt, Observer
from meshctl.fleet.journal import Run
from meshctl.model import Fleet, Node
from meshctl.plan import NodePlan, Wanted

if TYPE_CHECKING:
    from meshctl.apply.forgetting import Forgetting


@dataclass(frozen=True, slots=True)
class Work:
    """What all nodes of a run share. `owner` names this process to the locks on the nodes; `remember` keeps what a
    node told, for later; `around` is what the nodes of their meshes told before anything was changed, `names` tells
    whose the MACs of mesh radios are, `bases` which are the base's; `later` collects what is to be asked in the end."""

    fleet: Fleet
    access: Access
    run: Run
    observer: Observer
    interrupt: Interrupt
    owner: str
    remember: Callable[[str, Observation], None] = lambda name, seen: None
    rate_bytes_per_s: float | None = None
    around: Mapping[str, Observation] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    bases: Sequence[str] = ()
    later: list[Forgetting] = field(default_factory=list)

    def note(self, text: str, node: str = "") -> None:
        self.observer(Event(EventKind.NOTE, node, time.time(), text))


@dataclass(frozen=True, slots=True)
class Job:
    """One node: its plan, what it shall be, what it was before, what has to be there again afterwards."""

    work: Work
    node: Node
    plan: NodePlan
    wanted: Wanted
    before: Observation
    expected: Expectation

    @property
    def name(self) -> str:
        return self.node.name

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Tell and journal a step."""
        self.work.observer(Event(EventKind.STEP, self.name, time.time(), name))
        with self.work.run.step(self.name, name):
            yield

    def progress(self, told: Progress) -> None:
        """For uploads: how much is on the node."""
        fraction = told.verified / told.total if told.total else 1.0
        self.work.observer(Event(EventKind.PROGRESS, self.name, time.time(), fraction=fraction))
