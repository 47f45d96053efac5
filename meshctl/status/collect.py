"""One look at radios and robots, all at once: fleet -> connections -> what everybody told -> `Look`, and the journal.

`Watcher` is all that a look needs, and keeps connections between looks; `Watcher.look` takes one. Nothing is changed on
any device. Everybody is asked side by side in daemon threads: a look holds nothing that would have to be put back, so
whoever leaves it (Ctrl-C) need not wait for the silent.
"""

from __future__ import annotations

import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

from meshctl.apply.prepare import other_paths
from meshctl.device.observation import Observation
from meshctl.device.observe import observe
from meshctl.errors import MeshctlError, NodeError
from meshctl.fleet.journal import Journal
from meshctl.model import Fleet, Node
from meshctl.nodes.collect import FleetObservation, facts_of, known_macs
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.desired import Renderer
from meshctl.plan import DesiredState, NodePlan, node_plan
from meshctl.plan.masking import Fingerprints
from meshctl.robots.connection import Reach
from meshctl.robots.facts import Expectation, RobotFacts, expectation, gather
from meshctl.robots.host import Host
from meshctl.status.assess import Look
from meshctl.status.last_known import ROBOT_PREFIX, remembered
from meshctl.status.pings import Pings, ping, pings_of
from meshctl.status.unreachable import silence_of
from meshctl.status.values import Silence

T = TypeVar("T")

# So many are asked at once while answers come in: more would only make each other's handshakes late.
SIDE_BY_SIDE = 32
# When none came for so long, those asked are silent, and so many more are asked beside them: all the silent of a fleet
# cost one deadline together.
NOBODY_ANSWERS_S = 0.3
# A busy radio with a 560 MHz processor takes about ten seconds for all its answers (device/observe.py).
OBSERVE_S = 30.0
_SALT_BYTES = 16
Progress = Callable[[int, int], None]


def _quiet(done: int, count: int) -> None:
    """Tells nobody how far a look is."""


@dataclass(slots=True)
class Watcher:
    """Everything a look needs. `reach` is None where no robot can be asked, and `robots_unasked` says why; `owner` is
    who we are to the nodes' locks. Not for several threads at once."""

    fleet: Fleet
    renderer: Renderer
    access: ConnectionPool
    journal: Journal
    owner: str
    reach: Reach | None = None
    robots_unasked: str = ""
    clock: Callable[[], float] = time.time
    _wanted: dict[str, DesiredState | str] = field(default_factory=dict, repr=False)
    _expected: dict[str, Expectation | str] = field(default_factory=dict, repr=False)
    _computers: dict[str, tuple[ExitStack, Host]] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def look(self, nodes: Iterable[Node], robots: Iterable[str] = (), progress: Progress = _quiet) -> Look:
        """Ask these radios and robots. Raises MeshctlError for what concerns all of them (a key file, the journal)."""
        began = self.clock()
        known = self.journal.last_known(self.fleet.name)
        asked = {node.name: node for node in nodes}
        crew = tuple(robots) if self.reach is not None else ()
        jobs: dict[tuple[str, str], Callable[[], object]] = {}
        for node in asked.values():
            jobs["node", node.name] = partial(self._observe, node)
        for robot in crew:
            jobs["robot", robot] = partial(self._ask, robot)
        answers = side_by_side(jobs, SIDE_BY_SIDE, progress)
        observations = {key[1]: seen for key, seen in answers.items() if isinstance(seen, Observation)}
        facts = {key[1]: told for key, told in answers.items() if isinstance(told, RobotFacts)}
        silent: dict[str, dict[str, Silence]] = {"node": {}, "robot": {}}
        for (kind, name), answer in answers.items():
            if isinstance(answer, NodeError):
                silent[kind][name] = silence_of(answer)
        seen = FleetObservation(observations, {})
        self.journal.remember_all(
            self.fleet.name, {name: facts_of(one) for name, one in observations.items()}, self.clock()
        )
        macs = known_macs(self.fleet, known)
        for report in seen.reports:
            macs.update(dict.fromkeys(report.macs, report.node))
        plans, unrendered = self._plans(asked.values(), observations)
        for robot in crew:
            if isinstance(expected := self._expect(robot), str):
                unrendered[f"{ROBOT_PREFIX}{robot}"] = expected
        base = self.fleet.base_node
        return Look(
            fleet=self.fleet,
            observations=observations,
            silent=silent["node"],
            plans=plans,
            graph=seen.graph(self.fleet, known),
            known=remembered(known),
            macs=macs,
            entry=base.name if base is not None else "",
            own_lock=self.owner,
            unrendered=unrendered,
            robots=facts,
            silent_robots=silent["robot"],
            robots_unasked=self.robots_unasked,
            took_s=self.clock() - began,
        )

    def ping(self, robots: Iterable[str]) -> Pings:
        """Have each of these robots' daemons send an urgent message to each other's and back."""
        names = tuple(robots)
        jobs: dict[str, Callable[[], object]] = {
            name: partial(self._ping, name, [peer for peer in names if peer != name]) for name in names
        }
        answers = side_by_side(jobs, SIDE_BY_SIDE)
        return pings_of({name: told for name, told in answers.items() if isinstance(told, dict)})

    def _ping(self, robot: str, peers: Iterable[str]) -> dict[str, float | str]:
        with self.computer(robot) as host:
            return ping(host, peers)

    def close(self) -> None:
        """Close the connections to computers, side by side. Those to radios are `access`'s to close."""
        with self._lock:
            jobs: dict[str, Callable[[], object]] = {name: stack.close for name, (stack, _) in self._computers.items()}
            self._computers.clear()
        side_by_side(jobs, SIDE_BY_SIDE)

    def __enter__(self) -> Watcher:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _observe(self, node: Node) -> Observation:
        wanted = self._want(node)
        paths = () if isinstance(wanted, str) else other_paths(wanted)
        with self.access.borrow(node) as connection:
            return observe(connection, extra_paths=paths, timeout_s=OBSERVE_S)

    def _want(self, node: Node) -> DesiredState | str:
        """What the inventory wants of a node, or why that cannot be told: a fleet shows its state without its secrets,
        too."""
        with self._lock:
            if node.name not in self._wanted:
                try:
                    self._wanted[node.name] = self.renderer.desired(node)
                except MeshctlError as error:
                    self._wanted[node.name] = first_line(error)
            return self._wanted[node.name]

    def _plans(
        self, nodes: Iterable[Node], observations: Mapping[str, Observation]
    ) -> tuple[dict[str, NodePlan], dict[str, str]]:
        """How each node that answered differs from the inventory, and why others could not be compared."""
        fingerprints = Fingerprints(secrets.token_bytes(_SALT_BYTES))
        plans: dict[str, NodePlan] = {}
        unrendered: dict[str, str] = {}
        for node in nodes:
            seen, wanted = observations.get(node.name), self._want(node)
            if isinstance(wanted, str):
                unrendered[node.name] = wanted
            elif seen is not None:
                exact = self.renderer.desired(node, seen)
                plans[node.name] = node_plan(exact, seen, fingerprints, owner=self.owner)
        return plans, unrendered

    def _ask(self, robot: str) -> RobotFacts:
        expected = self._expect(robot)
        with self.computer(robot) as host:
            if isinstance(expected, str):
                return replace(gather(host, robot, Expectation(), now_s=self.clock()), drift=())
            return gather(host, robot, expected, now_s=self.clock())

    def _expect(self, robot: str) -> Expectation | str:
        with self._lock:
            if robot not in self._expected:
                try:
                    self._expected[robot] = expectation(self.fleet, robot, self.renderer.secrets)
                except MeshctlError as error:
                    self._expected[robot] = first_line(error)
            return self._expected[robot]

    @contextmanager
    def computer(self, robot: str) -> Iterator[Host]:
        """The robot's computer, over the connection of the last look where it still stands. Raises NodeError."""
        assert self.reach is not None, "robots are asked only where there is a way to them"
        with self._lock:
            kept = self._computers.pop(robot, None)
        if kept is None:
            stack = ExitStack()
            kept = (stack, stack.enter_context(self.reach.host(robot)))
        try:
            yield kept[1]
        except BaseException:
            kept[0].close()
            raise
        with self._lock:
            self._computers[robot] = kept


def first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


K = TypeVar("K")


def side_by_side(
    jobs: Mapping[K, Callable[[], object]],
    parallel: int,
    progress: Progress = _quiet,
    *,
    patience_s: float = NOBODY_ANSWERS_S,
) -> dict[K, object]:
    """What each job returned, or the NodeError it raised, in the jobs' order.

    `parallel` run at once, and `parallel` more whenever none has ended for `patience_s`. Any other exception is raised
    here. The threads are daemons: nobody who leaves early waits for them.
    """
    waiting: queue.SimpleQueue[K] = queue.SimpleQueue()
    finished: queue.SimpleQueue[tuple[K, object, BaseException | None]] = queue.SimpleQueue()
    for key in jobs:
        waiting.put(key)

    def work() -> None:
        while True:
            try:
                key = waiting.get_nowait()
            except queue.Empty:
                return
            try:
                finished.put((key, jobs[key](), None))
            except NodeError as error:
                finished.put((key, error, None))
            except BaseException as error:  # noqa: BLE001 - handed over to the caller's thread, which raises it
                finished.put((key, None, error))

    def ask_more() -> None:
        for _ in range(min(parallel, waiting.qsize())):
            threading.Thread(target=work, name="look", daemon=True).start()

    ask_more()
    found: dict[K, object] = {}
    while len(found) < len(jobs):
        try:
            key, answer, bug = finished.get(timeout=patience_s)
        except queue.Empty:
            ask_more()
            continue
        if bug is not None:
            raise bug
        found[key] = answer
        progress(len(found), len(jobs))
    return {key: found[key] for key in jobs}
