"""Flush stale station entries: neighbors remove them over SSH while a node's radios restart.

    armed: nodes reached through the node, and the node itself, start to watch their entries
    unreachable, also before the start: the other holders are queried, with growing pauses; after `BOOT_S` those of its
        other radios as well, which restart if it has lost its power; its SSH server has to answer, too: at once if the
        node watches its own entries or the change cannot drop logins, otherwise once its timer has undone the change
    ended: all holders that do not watch, and the nodes it hears now, are queried, after a reboot from its side, too
    end of the run: those that did not answer are queried again, and the operator sees the rest (`retry_unanswered`)
    next run: the same for a change whose end was not observed, or a reboot (`flush_later`)

The first three are events of a change (`change_listener`). A query is harmless where no radio restarted: each neighbor
verifies that its entry is stale before it removes it. A neighbor that does not answer, or cannot remove its entry
(19.07), changes no outcome; a note names it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias

from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.reconnect import reach_behind
from meshctl.apply.stale_stations import (
    GONE,
    KEPT,
    MAX_QUERIED,
    UNKNOWN,
    LoginPlace,
    StationEntry,
    by_holder,
    current_neighbors,
    entries_of,
    flush_script,
    login_of,
    next_query_s,
    own_entries,
    possible_holders,
    radio_macs,
    routed_through,
    watch_script,
)
from meshctl.deadline import deadline
from meshctl.device.connection import Deadlines
from meshctl.device.observation import Observation
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError
from meshctl.plan.radios import EVERY_RADIO, NO_RADIOS, Radios, observed_restarts, started_within
from meshctl.wording import all_of

# A neighbor waits up to 3 s for an echo, and 3 s for a login, once for each of a node's two radios.
QUERY_TIMEOUT_S = 15.0
# A failed query does no damage, so these deadlines are shorter than elsewhere.
_DEADLINES = Deadlines(
    connect_s=5.0,
    handshake_s=10.0,
    auth_s=10.0,
    channel_s=QUERY_TIMEOUT_S,
    run_s=QUERY_TIMEOUT_S,
    silence_s=QUERY_TIMEOUT_S,
)
# A node that takes longer to connect counts as unreachable: an SSH login takes a board two seconds.
SLOW_CONNECT_S = 5.0
# A connection that waits for an answer is asked for a sign of life every 5 s; twice that is a node that is unreachable.
SILENT_S, SILENCE_PAUSE_S = 10.0, 1.0
# A node that is unreachable for longer than that may have lost its power, and then restarts all of its radios.
BOOT_S = 20.0
# The fact in an outcome: the neighbors that may still hold a stale station entry.
UNFLUSHED = "not_asked"
# The consequence, for the operator (docs/provisioning.md).
MAY_LOSE = ": unicast frames to them may be lost for minutes"


# Makes a script once its neighbor is connected: during a login of seconds a new entry would seem older than the change.
Script: TypeAlias = Callable[[], str]


@dataclass(slots=True)
class StationFlush:
    """The station flush of one node whose `radios` restart: which neighbors watch, were queried, or did not answer.

    A ChangeListener. It adds itself to `unfinished` if holders did not answer at the end.
    """

    ctx: NodeContext
    radios: Radios
    unfinished: list[StationFlush] = field(repr=False)
    _holders: dict[str, tuple[StationEntry, ...]] = field(init=False, repr=False)
    # nodes that watch their entries, and may be unreachable while this node is; whether it watches its own
    _watching: frozenset[str] = frozenset()
    _watches_itself: bool = False
    _queried_s: list[float] = field(default_factory=list)
    # where the node has to answer logins, since the queries in `_queried_s`
    _login: LoginPlace | None = None
    # nodes whose radios restart at the same moment and keep no entry from before
    _restarting: frozenset[str] = frozenset()
    # once each, although a node that is flashed is queried for many times
    _journaled_steps: set[str] = field(default_factory=set)
    _reported: set[str] = field(default_factory=set)
    # since when its radio may have restarted: by a power cut, by the change, and by its rollback
    _began_s: float = field(init=False)
    _started_s: float | None = None
    _observed_s: float | None = None
    # the holders that did not answer at the end; since when an entry is not stale
    _unanswered: dict[str, tuple[StationEntry, ...]] = field(default_factory=dict)
    _since_s: float = 0.0

    def __post_init__(self) -> None:
        self._began_s = time.monotonic()
        self._holders = by_holder(entries_of(self.ctx.name, self.ctx.run.observations, self.radios))

    @property
    def node(self) -> str:
        return self.ctx.name

    def restarting(self, names: Iterable[str]) -> None:
        """The radios of these nodes restart at the same moment: they keep no station entry from before."""
        self._restarting = frozenset(names) - {self.node}

    def armed(self, connection: SshConnection | None, *, for_s: float, is_alone: bool = True) -> None:
        """Start watches on the node itself and on the nodes reached through it. Raises Unreachable."""
        if not self.radios:
            return
        if connection is not None:
            self.watch_own_entries(connection, for_s=for_s, is_alone=is_alone)
        self._watch_neighbors(for_s=for_s)

    def _watch_neighbors(self, *, for_s: float) -> None:
        """Start watches on the nodes reached through this one."""
        run_context = self.ctx.run
        hidden = routed_through(self.node, run_context.observations, run_context.current_base_macs(self.ctx.node))
        names = [name for name in self._holders if name in hidden and name not in self._restarting]
        answers = self._query(
            "watch neighbor station entries",
            {name: partial(watch_script, self.node, self._holders[name], for_s=for_s) for name in names},
        )
        self._watching = frozenset(name for name, answer in answers.items() if answer)
        unwatched = [name for name in names if name not in self._watching]
        if unwatched:
            run_context.note(
                f"{all_of(unwatched)} did not answer and cannot watch their entries of its radio", self.node
            )

    def watch_own_entries(self, connection: SshConnection, *, for_s: float, is_alone: bool = False) -> None:
        """Start a watch on the node itself. If a neighbor removes its entry although the radio did not restart, the
        node removes its own, and both count from 0. Otherwise a node whose part of a simultaneous change is called off
        would keep its entries of those that restart."""
        if entries := own_entries(self.node, self.ctx.before, self.radios):
            watch = watch_script(self.node, entries, for_s=for_s, ends_when_confirmed=is_alone)
            self._watches_itself = connection.run(watch).exit_status == 0

    def started(self) -> None:
        """The change starts: from now on its radio may restart."""
        self._started_s = time.monotonic()
        self._login = None

    def started_ago(self, ago_s: float) -> None:
        """The change started `ago_s` ago: its radio may have restarted since."""
        self._started_s = time.monotonic() - ago_s

    def observed(self) -> None:
        """The node answered, and the change is still applied."""
        self._observed_s = time.monotonic()

    @contextmanager
    def connecting(self) -> Iterator[None]:
        """Query the neighbors in the background if the block takes so long that the node must be unreachable."""
        with deadline(SLOW_CONNECT_S, self.unreachable):
            yield

    @contextmanager
    def waiting(self, connection: SshConnection) -> Iterator[None]:
        """Query the neighbors in the background whenever the connection is silent for so long, within the block, that
        the node must be unreachable. Keepalives make a node that is reachable answer sooner."""
        ended = threading.Event()

        def watch() -> None:
            while not ended.wait(SILENCE_PAUSE_S):
                if connection.silent_s > SILENT_S:
                    self.unreachable()

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def unreachable(self, among: Container[str] | None = None, *, is_login_due: bool = False) -> None:
        """The node did not answer: query its neighbors if it is time to. `among`: the only ones that are reachable.
        `is_login_due`: its SSH server has to answer a login, if only by a refusal."""
        now_s = time.monotonic()
        is_login_due |= self._watches_itself  # there, an entry that is removed by mistake costs seconds
        # before the change starts only a power cut restarts a radio: packages take minutes to upload and to stage
        since_s, radios = (self._began_s, NO_RADIOS) if self._started_s is None else (self._started_s, self.radios)
        if is_login_due and self._login is None and (login := login_of(self.ctx.node, self.ctx.before, radios)):
            self._login = login
            self._queried_s.clear()
        if now_s < next_query_s(self._queried_s):
            return
        answered_s = max(since_s, self._observed_s or 0.0)
        holders = self._holders if now_s < answered_s + BOOT_S else self._possible_holders(None, EVERY_RADIO)
        names = [name for name in holders if name not in self._watching and (among is None or name in among)]
        if names:
            self._queried_s.append(now_s)
            self._flush({name: holders[name] for name in names}, since_s, login=self._login)

    def ended(self, now: Observation | None = None, *, went_back: bool = False, rebooted: bool = False) -> None:
        """The change has ended: query all holders that do not watch. `now` is the latest observation; a node that has
        `rebooted` has restarted all of its radios."""
        since_s = self._observed_s if went_back and self._observed_s is not None else self._started_s
        if went_back:
            # the others' radios restarted with the change, and may have an entry of this one from then
            self._restarting = frozenset()
        if rebooted:
            self.radios = EVERY_RADIO
        if since_s is None or not self.radios:
            return
        self._since_s = since_s
        holders = self._possible_holders(now, self.radios)
        holders = {name: entries for name, entries in holders.items() if name not in self._watching | self._restarting}
        answers = self._flush(holders, since_s)
        unverified = {name: holders[name] for name, answer in answers.items() if UNKNOWN in answer.split()}
        if unverified and now is not None:
            self._flush_seen(unverified, now, since_s)
        self._unanswered = {name: entries for name, entries in holders.items() if name not in answers}
        if self._unanswered and rebooted and now is not None:
            reached = reach_behind(self.ctx.run, self.node, now, self._unanswered)
            answers = self._flush({name: self._unanswered[name] for name in reached & self._unanswered.keys()}, since_s)
            self._unanswered = {name: held for name, held in self._unanswered.items() if name not in answers}
        if self._unanswered:
            self.unfinished.append(self)

    def _flush_seen(self, unverified: Mapping[str, tuple[StationEntry, ...]], now: Observation, since_s: float) -> None:
        """Holders that cannot verify their entries remove those of the radios that were observed to restart."""
        restarted = observed_restarts(self.ctx.before, now, time.monotonic() - since_s)
        if not restarted:
            return
        macs = frozenset(radio_macs(self.ctx.before, restarted)) | frozenset(radio_macs(now, restarted))
        entries = {name: tuple(e for e in held if e.mac.lower() in macs) for name, held in unverified.items()}
        self._flush({name: matching for name, matching in entries.items() if matching}, since_s, has_restarted=True)

    def _possible_holders(self, now: Observation | None, radios: Radios) -> dict[str, tuple[StationEntry, ...]]:
        """Nodes known to hold a station entry of these radios, then nodes that may hold one on any interface: those not
        observed (a plan for this node alone may have observed no neighbor), and new neighbors."""
        run_context, ctx = self.ctx.run, self.ctx
        holders = by_holder(entries_of(self.node, run_context.observations, radios))
        names = dict(run_context.current_mac_owners())
        for name, observation in run_context.observations.items():
            names |= dict.fromkeys(radio_macs(observation, EVERY_RADIO), name)
        mesh_nodes = [node.name for mesh in ctx.node.meshes for node in run_context.fleet.members(mesh)]
        others = (
            *possible_holders(self.node, run_context.observations, names, mesh_nodes),
            *(current_neighbors(now, names) if now else ()),
        )
        # the radio's MAC may have changed: use all that are known
        own = filter(None, (run_context.observations.get(self.node), now))
        macs = tuple(dict.fromkeys(mac for observation in own for mac in radio_macs(observation, radios)))
        for name in others:
            if name != self.node and name in run_context.fleet.nodes:
                holders.setdefault(name, tuple(StationEntry(name, "", mac) for mac in macs))
        return {name: holders[name] for name in list(holders)[:MAX_QUERIED] if holders[name]}

    def _flush(
        self,
        holders: Mapping[str, Sequence[StationEntry]],
        since_s: float,
        *,
        has_restarted: bool = False,
        login: LoginPlace | None = None,
    ) -> dict[str, str]:
        """Have these holders remove stale entries; returns the answers."""
        scripts = {
            name: partial(_flush_since, entries, since_s, has_restarted=has_restarted, login=login)
            for name, entries in holders.items()
        }
        answers = self._query("flush neighbor station entries", scripts)
        self.report(answers)
        return answers

    def report(self, answers: Mapping[str, str]) -> None:
        """Report which holders removed a stale entry and which could not, each once."""
        for word, text in (
            (GONE, "removed a stale entry of its radio"),
            (KEPT, "cannot remove its stale entry" + MAY_LOSE),
        ):
            nodes = [name for name, answer in answers.items() if word in answer.split() and name not in self._reported]
            if nodes:
                self._reported.update(nodes)
                self.ctx.run.note(f"{all_of(nodes)} {text}", self.node)

    def own_lines(self, answer: str) -> str:
        """The lines of an answer that concern this node's radios."""
        macs = {entry.mac for entries in self._unanswered.values() for entry in entries}
        return "\n".join(line for line in answer.splitlines() if line.partition(" ")[2] in macs)

    def retries(self) -> dict[str, Script]:
        """The holders to query again, and their scripts."""
        return {name: partial(_flush_since, entries, self._since_s) for name, entries in self._unanswered.items()}

    def _query(self, step: str, scripts: Mapping[str, Script]) -> dict[str, str]:
        """Run each node's script in parallel; returns the answers. The step is journaled once."""
        if not scripts or self.ctx.run.interrupt.leaving:
            return {}
        telling = nullcontext() if step in self._journaled_steps else self.ctx.step(step)
        self._journaled_steps.add(step)
        with telling:
            return _query_all(self.ctx.run, scripts)


@dataclass(frozen=True, slots=True)
class StationFlushes:
    """The station flushes of a run."""

    _unfinished: list[StationFlush] = field(default_factory=list)

    def listener(self, ctx: NodeContext, radios: Radios) -> StationFlush:
        """The listener of a change on a node that restarts `radios`."""
        return StationFlush(ctx, radios, self._unfinished)

    def flush_later(self, ctx: NodeContext, ago_s: float) -> None:
        """Flush the entries of radios that have restarted within `ago_s`, since a change whose end was not observed, or
        since a boot."""
        flush = self.listener(ctx, started_within(ctx.before, ago_s))
        if ctx.before.uptime_s is not None:
            ago_s = min(ago_s, ctx.before.uptime_s + time.time() - ctx.before.asked_at_s)
        flush.started_ago(ago_s)
        flush.ended(ctx.before)

    def retry_unanswered(self, run_context: RunContext) -> dict[str, tuple[str, ...]]:
        """Query the neighbors that did not answer again, each once for all nodes.

        Returns node -> neighbors that still did not answer, and reports them.
        """
        unfinished = [(flush, flush.retries()) for flush in self._unfinished]
        if not unfinished or run_context.interrupt.leaving:
            return {}
        names = dict.fromkeys(name for _, scripts in unfinished for name in scripts)
        of_each = {name: [scripts[name] for _, scripts in unfinished if name in scripts] for name in names}
        answers = _query_all(run_context, {name: partial(_joined, scripts) for name, scripts in of_each.items()})
        unflushed: dict[str, tuple[str, ...]] = {}
        for flush, scripts in unfinished:
            flush.report({name: flush.own_lines(answers[name]) for name in scripts if name in answers})
            unanswered = tuple(name for name in scripts if name not in answers)
            if unanswered:
                unflushed[flush.node] = unanswered
                run_context.note(
                    f"{all_of(unanswered)} did not answer and may hold a stale entry of its radio{MAY_LOSE}",
                    flush.node,
                )
        return unflushed


def _flush_since(
    entries: Sequence[StationEntry], since_s: float, *, has_restarted: bool = False, login: LoginPlace | None = None
) -> str:
    return flush_script(entries, older_than_s=time.monotonic() - since_s, has_restarted=has_restarted, login=login)


def _joined(scripts: Iterable[Script]) -> str:
    return "".join(script() for script in scripts)


def _query_all(run_context: RunContext, scripts: Mapping[str, Script]) -> dict[str, str]:
    """The output of each node that answered in time."""
    with ThreadPoolExecutor(max_workers=min(len(scripts), MAX_QUERIED), thread_name_prefix="flush") as pool:
        answers = pool.map(lambda name: _query_one(run_context, name, scripts[name]), scripts)
        return {name: answer for name, answer in zip(scripts, answers, strict=True) if answer is not None}


def _query_one(run_context: RunContext, name: str, script: Script) -> str | None:
    connections = run_context.connections
    try:
        connection = connections.acquire(name) or connections.open(run_context.fleet.nodes[name], deadlines=_DEADLINES)
    except NodeError:
        return None
    try:
        # a pooled connection has longer deadlines, and may lead through the unreachable node
        with deadline(QUERY_TIMEOUT_S, connection.close):
            done = connection.run(script(), timeout_s=QUERY_TIMEOUT_S)
    except NodeError:
        connection.close()
        return None
    finally:
        connections.release(name, connection)
    return done.stdout.strip()
