"""The context of a run (`RunContext`) and of one node in it (`NodeContext`): fleet, connections, journal, plan."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from meshctl.apply.change_listener import ChangeListener
from meshctl.apply.health_checks import Expectation
from meshctl.device.observation import Observation
from meshctl.device.upload import UploadProgress
from meshctl.fleet import Event, EventKind, Interrupt, Observer
from meshctl.fleet.journal import Journal, Run
from meshctl.model import Fleet, Node
from meshctl.nodes.collect import facts_of
from meshctl.nodes.connections import ConnectionPool
from meshctl.plan import DesiredState, NodePlan
from meshctl.plan.radios import Radios
from meshctl.topology import mesh_macs


@dataclass(frozen=True, slots=True)
class RunContext:
    """Shared by all nodes of a run, complete before the first node is changed.

    `owner` identifies this process in the nodes' locks. `new_listener` makes the listener of a change on one node that
    restarts the given radios. `observations` were made before any change, of the plan's nodes and their meshes.
    `mac_owners` maps MACs of mesh radios to nodes; `base_macs` are those of each base, by its name.

    `macs` are the MACs each node's radios have had during the run: OpenWrt 24.10 and 25.12 give a recreated radio
    interface a new one.
    """

    fleet: Fleet
    connections: ConnectionPool
    journal: Journal
    journal_run: Run
    observer: Observer
    interrupt: Interrupt
    owner: str
    new_listener: Callable[[NodeContext, Radios], ChangeListener]
    observations: Mapping[str, Observation]
    mac_owners: Mapping[str, str]
    base_macs: Mapping[str, Sequence[str]]
    rate_bytes_per_s: float | None = None
    macs: dict[str, frozenset[str]] = field(default_factory=dict)

    def record(self, name: str, observation: Observation) -> None:
        """Record an observation for the rest of this run and for later ones."""
        self.macs[name] = self.macs.get(name, frozenset()) | frozenset(mesh_macs(observation))
        self.journal_run.remember(self.fleet.name, name, facts_of(observation), observation.answered_at_s)

    def current_mac_owners(self) -> dict[str, str]:
        """MAC -> node, including MACs learned during the run."""
        return {**self.mac_owners, **{mac: name for name, macs in self.macs.items() for mac in macs}}

    def current_base_macs(self, node: Node) -> frozenset[str]:
        """The MACs of the mesh radios of the node's base, before the run and since."""
        base = self.fleet.base_of(node)
        if base is None:
            return frozenset()
        return self.macs.get(base.name, frozenset()) | {mac.lower() for mac in self.base_macs.get(base.name, ())}

    def note(self, text: str, node: str = "") -> None:
        self.observer(Event(EventKind.NOTE, node, time.time(), text))


@dataclass(frozen=True, slots=True)
class NodeContext:
    """One node of a run: its plan, its desired state, its state before the change, the health it must regain."""

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
        """Report and journal a step."""
        self.run.observer(Event(EventKind.STEP, self.name, time.time(), name))
        with self.run.journal_run.step(self.name, name):
            yield

    def progress(self, uploaded: UploadProgress) -> None:
        """Report an upload's progress."""
        fraction = uploaded.verified / uploaded.total if uploaded.total else 1.0
        self.run.observer(Event(EventKind.PROGRESS, self.name, time.time(), fraction=fraction))
