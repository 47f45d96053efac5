"""One node in work: what is known of it, who is to hear of its steps, and where they are written down."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from meshctl.apply.health_checks import Expectation
from meshctl.device.observation import Observation
from meshctl.device.upload import Progress
from meshctl.fleet import Event, EventKind, Interrupt, Observer
from meshctl.fleet.journal import Run
from meshctl.model import Fleet, Node
from meshctl.nodes.connections import ConnectionPool
from meshctl.plan import DesiredState, NodePlan
from meshctl.topology import mesh_macs

if TYPE_CHECKING:
    from meshctl.apply.station_flush import StationFlush


@dataclass(frozen=True, slots=True)
class RunContext:
    """What all nodes of a run share. `owner` names this process to the locks on the nodes; `remember` keeps what a
    node told, for later; `around` is what the nodes of their meshes told before anything was changed, `names` tells
    whose the MACs of mesh radios are, `bases` which are the base's; `later` collects what is to be asked in the end.

    `macs` are those by which the mesh has known each node's radios during the run: OpenWrt 24.10 and 25.12 give a radio
    interface that is created again another one.
    """

    fleet: Fleet
    connections: ConnectionPool
    journal_run: Run
    observer: Observer
    interrupt: Interrupt
    owner: str
    remember: Callable[[str, Observation], None] = lambda name, seen: None
    rate_bytes_per_s: float | None = None
    observations: Mapping[str, Observation] = field(default_factory=dict)
    mac_owners: Mapping[str, str] = field(default_factory=dict)
    base_macs: Sequence[str] = ()
    unfinished_flushes: list[StationFlush] = field(default_factory=list)
    macs: dict[str, frozenset[str]] = field(default_factory=dict)

    def record(self, name: str, seen: Observation) -> None:
        """Keep what a node reported, for the rest of the run and for later ones."""
        self.macs[name] = self.macs.get(name, frozenset()) | frozenset(mesh_macs(seen))
        self.remember(name, seen)

    def current_mac_owners(self) -> dict[str, str]:
        """MAC -> node, with those that were learned during the run."""
        return {**self.mac_owners, **{mac: name for name, macs in self.macs.items() for mac in macs}}

    def current_base_macs(self) -> frozenset[str]:
        """The MACs of the base's mesh radios: those of before the run, and those seen since."""
        base = self.fleet.base_node
        seen = frozenset[str]() if base is None else self.macs.get(base.name, frozenset())
        return frozenset(mac.lower() for mac in self.base_macs) | seen

    def note(self, text: str, node: str = "") -> None:
        self.observer(Event(EventKind.NOTE, node, time.time(), text))


@dataclass(frozen=True, slots=True)
class NodeContext:
    """One node: its plan, what it shall be, what it was before, what has to be there again afterwards."""

    run: RunContext
    node: Node
    plan: NodePlan
    desired: DesiredState
    before: Observation
    expected: Expectation

    @property
    def name(self) -> str:
        return self.node.name

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Tell and journal a step."""
        self.run.observer(Event(EventKind.STEP, self.name, time.time(), name))
        with self.run.journal_run.step(self.name, name):
            yield

    def progress(self, uploaded: Progress) -> None:
        """For uploads: how much is on the node."""
        fraction = uploaded.verified / uploaded.total if uploaded.total else 1.0
        self.run.observer(Event(EventKind.PROGRESS, self.name, time.time(), fraction=fraction))
