"""Query all radios and robots in parallel: fleet -> connections -> answers -> `Snapshot`, and facts to the journal.

`Collector.collect` takes a snapshot; the collector keeps connections between snapshots. Queries change nothing on a
device, so they run in daemon threads: Ctrl-C need not wait for devices that do not answer.
"""

from __future__ import annotations

import queue
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from meshctl.apply.prepare import other_paths
from meshctl.device.observation import Observation
from meshctl.device.observe import RawObservation, observe_again
from meshctl.errors import MeshctlError, NodeError, Unreachable
from meshctl.fleet.journal import ROBOT_PREFIX, Journal
from meshctl.model import Fleet, Node
from meshctl.nodes.collect import facts_of, fleet_graph, known_macs, reports_of
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.desired import Renderer
from meshctl.nodes.site_gateways import PIN_PREFIX
from meshctl.plan import DesiredState, NodePlan, node_plan
from meshctl.plan.masking import Fingerprints
from meshctl.robots.connection import RobotConnector
from meshctl.robots.expected_release import ExpectedRelease, expected_release
from meshctl.robots.facts import RobotFacts, collect_facts
from meshctl.robots.host import Host
from meshctl.status.assess import Snapshot
from meshctl.status.emergency_stop import StopPlan, StopResult, send
from meshctl.status.last_known import merge_by_device
from meshctl.status.pings import Pings, ping, pings_of
from meshctl.status.unfinished_changes import waiting_hints
from meshctl.status.unreachable import NOT_ASKED, no_answer_of
from meshctl.status.values import NoAnswer

if TYPE_CHECKING:
    from meshctl.status.site_observer import SiteObserver

T = TypeVar("T")

# Parallel queries while answers come in; more would only delay each other's handshakes.
MAX_PARALLEL = 32
# Without an answer for this long, the running queries are taken for timeouts and as many more are started: all
# unreachable devices together cost one timeout.
STALL_TIMEOUT_S = 0.3
# A busy radio with a 560 MHz processor takes about ten seconds for all its answers (device/observe.py).
OBSERVE_S = 30.0
_SALT_BYTES = 16
Progress = Callable[[int, int], None]


def _no_progress(done: int, count: int) -> None:
    """Ignore progress."""


@dataclass(slots=True)
class Collector:
    """Collects snapshots and keeps connections between them. Not thread-safe.

    `connector` is None when no robot can be queried, for the reason in `robots_skipped`; `owner` is this process's name
    in the nodes' locks. The nodes of sites with a worker are observed by it, unless `sites` is None.
    """

    fleet: Fleet
    renderer: Renderer
    access: ConnectionPool
    journal: Journal
    owner: str
    connector: RobotConnector | None = None
    robots_skipped: str = ""
    sites: SiteObserver | None = None
    clock: Callable[[], float] = time.time
    _desired_states: dict[str, DesiredState | str] = field(default_factory=dict, repr=False)
    _expected_releases: dict[str, ExpectedRelease | str] = field(default_factory=dict, repr=False)
    _computers: dict[str, tuple[ExitStack, Host]] = field(default_factory=dict, repr=False)
    _observed: dict[str, Observation] = field(default_factory=dict, repr=False)
    _previous: dict[str, Observation] = field(default_factory=dict, repr=False)
    # site -> why its nodes are queried from here
    _unusable_workers: dict[str, NoAnswer] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def collect(self, nodes: Iterable[Node], robots: Iterable[str] = (), progress: Progress = _no_progress) -> Snapshot:
        """Query these radios and robots. Raises MeshctlError for a common failure (key file, journal)."""
        began = self.clock()
        known = self.journal.last_known(self.fleet.name)
        asked = {node.name: node for node in nodes}
        targets = tuple(robots) if self.connector is not None else ()
        jobs: dict[tuple[str, str], Callable[[], object]] = {}
        at_sites: dict[str, list[str]] = {}
        for node in asked.values():
            site = self.sites.site_of(node) if self.sites is not None else ""
            if site:
                at_sites.setdefault(site, []).append(node.name)
            else:
                jobs["node", node.name] = partial(self._observe, node)
        for site, names in at_sites.items():
            jobs["site", site] = partial(self._ask_site, site, tuple(names))
        for robot in targets:
            jobs["robot", robot] = partial(self._collect_robot, robot)
        answers = run_parallel(jobs, MAX_PARALLEL, progress)
        for site in at_sites:
            of_site = answers.pop(("site", site))
            assert isinstance(of_site, Mapping)
            answers |= {("node", name): of_site[name] for name in at_sites[site]}
        observations = {
            key[1]: observation for key, observation in answers.items() if isinstance(observation, Observation)
        }
        facts = {key[1]: robot for key, robot in answers.items() if isinstance(robot, RobotFacts)}
        no_answer: dict[str, dict[str, NoAnswer]] = {"node": {}, "robot": {}}
        for (kind, name), answer in answers.items():
            if isinstance(answer, NodeError):
                no_answer[kind][name] = no_answer_of(answer)
            elif isinstance(answer, NoAnswer):
                no_answer[kind][name] = answer
        if no_answer["node"]:
            for name, hint in waiting_hints(self.fleet, self.journal, self.clock()).items():
                if name in no_answer["node"]:
                    no_answer["node"][name] = replace(no_answer["node"][name], wait_for=hint)
        # a report is made of all paths that a node knows: once
        reports = reports_of(observations)
        self.journal.remember_all(
            self.fleet.name, {name: facts_of(observation) for name, observation in observations.items()}, self.clock()
        )
        macs = known_macs(self.fleet, known)
        for report in reports.values():
            macs.update(dict.fromkeys(report.macs, report.node))
        plans, unrendered = self._plans(asked.values(), observations)
        for robot in targets:
            if isinstance(expected := self._expected_release(robot), str):
                unrendered[f"{ROBOT_PREFIX}{robot}"] = expected
        base = self.fleet.base_node
        self._note(observations)
        return Snapshot(
            fleet=self.fleet,
            observations=observations,
            no_answer=no_answer["node"],
            plans=plans,
            reports=reports,
            graph=fleet_graph(self.fleet, known, reports),
            known=merge_by_device(known),
            macs=macs,
            entry=base.name if base is not None else "",
            own_lock=self.owner,
            unrendered=unrendered,
            robots=facts,
            no_answer_robots=no_answer["robot"],
            robots_skipped=self.robots_skipped,
            unusable_workers=dict(self._unusable_workers),
            previous=dict(self._previous),
            took_s=self.clock() - began,
        )

    def traffic(self) -> dict[str, int]:
        """Bytes to and from each device so far, also those that workers exchanged with nodes; no gateway is one, since
        uplinks are not on the air of the mesh."""
        total = Counter(self.access.meter.totals())
        if self.sites is not None:
            total.update(self.sites.traffic())
        return {device: count for device, count in total.items() if not device.startswith(PIN_PREFIX)}

    def _note(self, observations: Mapping[str, Observation]) -> None:
        for name, observation in observations.items():
            last = self._observed.get(name)
            # a site worker's answer may be reused for a while
            if last is not observation:
                self._observed[name] = observation
                if last is not None:
                    self._previous[name] = last

    def ping(self, robots: Iterable[str]) -> Pings:
        """Have each of these robots' daemons send an urgent message to each other and back."""
        names = tuple(robots)
        jobs: dict[str, Callable[[], object]] = {
            name: partial(self._ping, name, [peer for peer in names if peer != name]) for name in names
        }
        answers = run_parallel(jobs, MAX_PARALLEL)
        return pings_of({name: answer for name, answer in answers.items() if isinstance(answer, dict)})

    def send_stop(self, plan: StopPlan, message: bytes) -> StopResult:
        """Send a real emergency stop from its source."""
        if self.connector is None:
            return StopResult(problem=self.robots_skipped or "no robot can be queried")
        try:
            with self.robot_host(plan.source) as host:
                return send(host, plan, message)
        except MeshctlError as error:
            return StopResult(problem=f"{plan.source} cannot send it: {error}")

    def _ping(self, robot: str, peers: Iterable[str]) -> dict[str, float | str]:
        with self.robot_host(robot) as host:
            return ping(host, peers)

    def close(self) -> None:
        """Close the connections to computers in parallel; `access` closes those to radios."""
        with self._lock:
            jobs: dict[str, Callable[[], object]] = {name: stack.close for name, (stack, _) in self._computers.items()}
            self._computers.clear()
        run_parallel(jobs, MAX_PARALLEL)
        if self.sites is not None:
            self.sites.close()

    def __enter__(self) -> Collector:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def answers(self, nodes: Iterable[Node]) -> dict[str, RawObservation | NoAnswer]:
        """The answers of these radios, for another meshctl to read (`site_observer`)."""
        found = run_parallel({node.name: partial(self._observe_raw, node) for node in nodes}, MAX_PARALLEL)
        answers: dict[str, RawObservation | NoAnswer] = {}
        for name, answer in found.items():
            if isinstance(answer, NodeError):
                answers[name] = no_answer_of(answer)
            elif isinstance(answer, RawObservation):
                answers[name] = answer
        return answers

    def _observe_raw(self, node: Node) -> RawObservation:
        desired = self._desired_state(node)
        paths = () if isinstance(desired, str) else other_paths(desired)
        with self.access.borrow(node) as connection:
            return observe_again(connection, extra_paths=paths, timeout_s=OBSERVE_S)

    def _observe(self, node: Node) -> Observation:
        return self._observe_raw(node).interpret()

    def _ask_site(self, site: str, names: tuple[str, ...]) -> Mapping[str, Observation | NoAnswer | NodeError]:
        assert self.sites is not None
        try:
            found = self.sites.observe(site, names)
        except NodeError as error:
            if isinstance(error, Unreachable) or not self.fleet.sites[site].has_gateway:
                return dict.fromkeys(names, error)
            # such as a worker that is older than this meshctl
            self._unusable_workers[site] = no_answer_of(error)
            jobs: dict[str, Callable[[], object]] = {
                name: partial(self._observe, self.fleet.nodes[name]) for name in names
            }
            return {
                name: answer
                for name, answer in run_parallel(jobs, MAX_PARALLEL).items()
                if isinstance(answer, Observation | NodeError)
            }
        self._unusable_workers.pop(site, None)
        return {name: found.get(name, NOT_ASKED) for name in names}

    def _desired_state(self, node: Node) -> DesiredState | str:
        """The desired state of a node, or why it cannot be rendered: status also works without the secrets."""
        with self._lock:
            if node.name not in self._desired_states:
                try:
                    self._desired_states[node.name] = self.renderer.desired(node)
                except MeshctlError as error:
                    self._desired_states[node.name] = first_line(error)
            return self._desired_states[node.name]

    def _plans(
        self, nodes: Iterable[Node], observations: Mapping[str, Observation]
    ) -> tuple[dict[str, NodePlan], dict[str, str]]:
        """The drift of each node that answered, and why others could not be compared."""
        fingerprints = Fingerprints(secrets.token_bytes(_SALT_BYTES))
        plans: dict[str, NodePlan] = {}
        unrendered: dict[str, str] = {}
        for node in nodes:
            observation, desired = observations.get(node.name), self._desired_state(node)
            if isinstance(desired, str):
                unrendered[node.name] = desired
            elif observation is not None:
                exact = self.renderer.desired(node, observation)
                change = observation.change
                # locks and changes of others have alarms of their own, and a run that makes them is no error
                owner = "" if change is None else change.lock_owner or change.owner
                plans[node.name] = node_plan(exact, observation, fingerprints, owner=owner or self.owner)
        return plans, unrendered

    def _collect_robot(self, robot: str) -> RobotFacts:
        expected = self._expected_release(robot)
        others = self.fleet.robots[robot].other_addresses
        with self.robot_host(robot) as host:
            if isinstance(expected, str):
                found = collect_facts(host, robot, ExpectedRelease(), now_s=self.clock(), others=others)
                return replace(found, drift=())
            return collect_facts(host, robot, expected, now_s=self.clock(), others=others)

    def _expected_release(self, robot: str) -> ExpectedRelease | str:
        with self._lock:
            if robot not in self._expected_releases:
                try:
                    self._expected_releases[robot] = expected_release(self.fleet, robot, self.renderer.secrets)
                except MeshctlError as error:
                    self._expected_releases[robot] = first_line(error)
            return self._expected_releases[robot]

    @contextmanager
    def robot_host(self, robot: str) -> Iterator[Host]:
        """The robot's computer, over the connection of the last snapshot if still open. Raises NodeError."""
        assert self.connector is not None, "robots are queried only with a connector"
        with self._lock:
            kept = self._computers.pop(robot, None)
        if kept is None:
            stack = ExitStack()
            kept = (stack, stack.enter_context(self.connector.host(robot)))
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


def run_parallel(
    jobs: Mapping[K, Callable[[], object]],
    parallel: int,
    progress: Progress = _no_progress,
    *,
    stall_timeout_s: float = STALL_TIMEOUT_S,
) -> dict[K, object]:
    """Each job's result, or the NodeError it raised, in the jobs' order. Raises any other exception.

    `parallel` jobs run at once, and `parallel` more whenever none has ended for `stall_timeout_s`. Threads are daemons,
    so an interrupt need not wait for them.
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
            except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
                finished.put((key, None, error))

    def start_more() -> None:
        for _ in range(min(parallel, waiting.qsize())):
            threading.Thread(target=work, name="collect", daemon=True).start()

    start_more()
    found: dict[K, object] = {}
    while len(found) < len(jobs):
        try:
            key, answer, bug = finished.get(timeout=stall_timeout_s)
        except queue.Empty:
            start_more()
            continue
        if bug is not None:
            raise bug
        found[key] = answer
        progress(len(found), len(jobs))
    return {key: found[key] for key in jobs}
