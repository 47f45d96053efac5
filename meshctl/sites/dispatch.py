"""The plans and runs of all sites of one command, one thread each: prepare -> (the operator confirms) -> execute.

A site continues without its uplink: meshctl connects again until the run is over there, and reads its events from
where it was. A run that the operator leaves is met again by its id, by the same code without an order.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from meshctl.errors import MeshctlError, Unreachable
from meshctl.fleet import Event, EventKind, Interrupt, Observer, Outcome, Result
from meshctl.fleet.journal import Run
from meshctl.model import Fleet, Node, Site
from meshctl.nodes.connections import ConnectionPool
from meshctl.plan.saved import SavedPlan, load
from meshctl.sites.bundle import SiteBundle
from meshctl.sites.connect import open_uplink
from meshctl.sites.events import events_of, final_outcomes
from meshctl.sites.uplink import Parcel, SiteOffline, Uplink

# Uplinks wait far more than they work.
MAX_SITES_AT_ONCE = 64
# How often an uplink may be lost while its site plans.
PLAN_ATTEMPTS = 8
_FIRST_WAIT_S = 1.0
_LONGEST_WAIT_S = 15.0
_WATCH_S = 0.25
# A site without contact for so long is left to itself; `meshctl resume` meets its run again.
GIVE_UP_S = 900.0
_LEAVING = f"meshctl gives up {GIVE_UP_S / 60:g} min after its last contact, or on Ctrl-C"


def new_run_id() -> str:
    return secrets.token_hex(8)


def by_site(fleet: Fleet, nodes: Iterable[Node]) -> tuple[tuple[Node, ...], dict[str, tuple[str, ...]]]:
    """The nodes that the operator provisions, and the names of the others by the site whose worker does."""
    direct: list[Node] = []
    sites: dict[str, list[str]] = {}
    for node in nodes:
        site = fleet.worker_site(node)
        if site is None:
            direct.append(node)
        else:
            sites.setdefault(site.name, []).append(node.name)
    return tuple(direct), {name: tuple(names) for name, names in sites.items()}


@dataclass(slots=True)
class SitePlan:
    """One site's plan: what `saved` says, or why there is none (`error`). The uplink stays open for its execution.

    `text` is what is ordered: the plan, or the saved one of which `saved` is what still applies. `replaced` has what
    it would replace on each node, as JSON.
    """

    site: Site
    nodes: tuple[str, ...]
    run: str
    saved: SavedPlan | None = None
    text: str = field(default="", repr=False)
    replaced: Mapping[str, Any] = field(default_factory=dict, repr=False)
    bundle: SiteBundle | None = field(default=None, repr=False)
    # the site is offline: the order waits for it, and what of the saved plan applies is found out there
    is_queued: bool = False
    error: MeshctlError | None = None
    uplink: Uplink | None = field(default=None, repr=False)

    def close(self) -> None:
        if self.uplink is not None:
            self.uplink.close()


def prepare_sites(
    fleet: Fleet,
    sites: Mapping[str, Sequence[str]],
    access: ConnectionPool,
    bundle_of: Callable[[str], SiteBundle],
    options: Sequence[str],
    agreed: Mapping[str, str] | None = None,
) -> list[SitePlan]:
    """Let the workers plan, all at the same time, or check the saved plans `agreed`. A site that cannot is one with an
    `error`."""

    plans = [SitePlan(fleet.sites[name], tuple(nodes), new_run_id()) for name, nodes in sites.items()]

    def prepare(plan: SitePlan) -> None:
        try:
            bundle = bundle_of(plan.site.name)
            saved = (agreed or {}).get(plan.site.name, "")
            plan.bundle = bundle
            # a saved plan can wait at the hub; what of it applies is then found out at the site
            can_wait = bool(saved) and plan.site.nats is not None and not bundle.images
            for attempt in range(PLAN_ATTEMPTS):
                try:
                    plan.uplink = open_uplink(fleet, plan.site, access)
                    plan.uplink.send_images(bundle.image_files)
                    text, plan.replaced = plan.uplink.plan(
                        plan.run, bundle.archive, bundle.images, plan.nodes, options, saved
                    )
                    break
                except Unreachable:
                    # an uplink that comes and goes is tried again; one that is not there is reported at once
                    is_last = plan.uplink is None or attempt + 1 == PLAN_ATTEMPTS
                    if is_last and not can_wait:
                        raise
                    plan.close()
                    plan.run = new_run_id()
                    if is_last:
                        plan.uplink, text = open_uplink(fleet, plan.site, access, must_answer=False), saved
                        plan.is_queued = True
                        break
                    time.sleep(min(_FIRST_WAIT_S * 2**attempt, _LONGEST_WAIT_S))
            plan.text = saved or text
            plan.saved = load(text, f"the plan of site {plan.site.name}")
        except MeshctlError as error:
            plan.error = error
            plan.close()

    pool = ThreadPoolExecutor(min(MAX_SITES_AT_ONCE, len(sites)), "site")
    try:
        list(pool.map(prepare, plans))
    except BaseException:
        # Ctrl-C: the workers forget their plans with their uplinks
        for plan in plans:
            plan.close()
        raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return plans


@dataclass(slots=True)
class SiteRun:
    """A run at a site, as the operator sees it. `outcomes` has one for each of its nodes once it is over or left."""

    site: Site
    run: str
    nodes: tuple[str, ...]
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    parcel: Parcel | None = field(default=None, repr=False)
    # for an order that waits for its site: until when, in words
    waits_until: str = ""
    uplink: Uplink | None = field(default=None, repr=False)
    offset: int = 0
    is_started: bool = False
    is_over: bool = False
    # it was left, or its site is offline: it may yet change nodes, or has done so unseen
    is_unknown: bool = False
    in_work: set[str] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class SiteExecution:
    """Shared by the runs of all sites. `entry` is the operator's journal, `observer` shows events."""

    fleet: Fleet
    access: ConnectionPool
    entry: Run
    observer: Observer
    interrupt: Interrupt
    # takes what a run replaces that was ordered while its site was offline, sealed
    keep_replaced: Callable[[SiteRun, str], None]

    def execute(self, runs: Sequence[SiteRun]) -> dict[str, Outcome]:
        """Start (or follow) all runs and stay with them until each is over, or the operator leaves."""
        done = threading.Event()
        watcher = threading.Thread(target=self._watch, args=(runs, done), name="interrupts", daemon=True)
        watcher.start()
        try:
            with ThreadPoolExecutor(max(1, len(runs)), "site") as pool:
                for _ in pool.map(self._execute_site, runs):
                    pass
        finally:
            done.set()
            watcher.join()
        return {name: outcome for run in runs for name, outcome in run.outcomes.items()}

    def _execute_site(self, run: SiteRun) -> None:
        wait_s, contact_s, noted, reason = _FIRST_WAIT_S, time.monotonic(), "", ""
        while not run.is_over and not self._leaves(run) and time.monotonic() - contact_s < GIVE_UP_S:
            try:
                offset = run.offset
                self._stay(run)
            except Unreachable as error:
                if run.uplink is not None and run.uplink.has_contact:
                    contact_s = time.monotonic()
                if run.offset != offset:
                    wait_s = _FIRST_WAIT_S
                reason = str(error)
                text = f"site {run.site.name}: {reason}; connecting again" + (
                    ", the site continues on its own" if run.is_started else ""
                )
                # a reason that repeats is noted once
                if text != noted:
                    self._note(f"{text}; {_LEAVING}" + (f"\nhint: {error.hint}" if error.hint else ""))
                    noted = text
                self.interrupt.wait(wait_s)
                wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
            except MeshctlError as error:
                # such as a gateway with another host key: the run itself may well continue there
                self._finish_all(run, Result.UNCERTAIN if run.is_started else Result.REFUSED, str(error), error.hint)
                run.is_over = True
            finally:
                self._close(run)
        if not run.is_over:
            text = f"site {run.site.name} continues on its own"
            if run.site.nats is not None:
                text += ", or its order still waits for it"
            if not run.is_started:
                text = "it has not started, or the uplink was lost just then"
                text += f"; the last attempt failed: {reason}" if reason else ""
            run.is_unknown = True
            self._finish_all(run, Result.PENDING, text, "run `meshctl resume` to see how it ended")

    def _leaves(self, run: SiteRun) -> bool:
        """Whether the operator wants to wait no longer for this run, or for its start."""
        return self.interrupt.leaving or (self.interrupt.stopping and not run.is_started)

    def _stay(self, run: SiteRun) -> None:
        """Connect if necessary, start the run if it has not been, and follow it to its end."""
        if run.uplink is None:
            run.uplink = open_uplink(self.fleet, run.site, self.access, must_answer=False)
        if not run.is_started:
            # an uplink that was lost at the start leaves open whether the order arrived
            try:
                state = run.uplink.state_of(run.run)
            except SiteOffline:
                if run.parcel is None:
                    text = f"site {run.site.name} is offline and has not reported how run {run.run} ended"
                    self._finish_all(run, Result.PENDING, text, "run `meshctl resume` later")
                    run.is_over = run.is_unknown = True
                    return
                state = ""
            if state == "waiting" and (run.parcel is None or run.waits_until):
                self._finish_waiting(run)
                return
            run.is_started = state not in ("", "prepared", "waiting")
            if not state and run.parcel is None:
                self._finish_unknown(run, run.uplink)
                return
        if not run.is_started:
            if self.interrupt.stopping:
                self._finish_all(run, Result.PENDING, "interrupted before it started", "")
                run.is_over = True
                return
            if run.parcel is None:
                self._finish_all(run, Result.PENDING, f"run {run.run} was not started at site {run.site.name}", "")
                run.is_over = True
                return
            run.uplink.start(run.parcel)
            if run.waits_until:
                self._finish_waiting(run)
                return
            run.is_started = True
        for reply in run.uplink.follow(run.run, run.offset):
            self._read(run, reply)

    def _finish_waiting(self, run: SiteRun) -> None:
        """The outcomes of a run whose order waits for its site."""
        until = f" until {run.waits_until}" if run.waits_until else ""
        text = f"site {run.site.name} is offline: the order waits for it{until}"
        self._finish_all(run, Result.PENDING, text, "run `meshctl resume` later to see how it ended")
        run.is_over = run.is_unknown = True

    def _finish_unknown(self, run: SiteRun, uplink: Uplink) -> None:
        """The outcomes of a run that its site does not know (anymore)."""
        site = run.site.name
        if uplink.has_forgotten(run.run):
            text = f"site {site} executed run {run.run} and has since deleted the record of how it ended"
            self._finish_all(run, Result.UNCERTAIN, text, "`meshctl plan` compares its nodes with the inventory")
        else:
            text = f"site {site} did not start run {run.run}, unless its gateway was installed from scratch since"
            self._finish_all(run, Result.PENDING, text, "")
        run.is_over = True

    def _read(self, run: SiteRun, reply: Mapping[str, object]) -> None:
        objects = reply.get("events", [])
        assert isinstance(objects, list)
        if "note" in reply:
            self._note(f"site {run.site.name}: {reply['note']}")
        for event in events_of(objects):
            if event.node and event.node not in run.nodes:
                continue
            if event.outcome is not None:
                self._finish(run, event.outcome, at_s=event.at_s)
            else:
                if event.node:
                    run.in_work.add(event.node)
                self.observer(event)
        for outcome in final_outcomes(objects).values():
            if outcome.node in run.nodes and run.outcomes.get(outcome.node) != outcome:
                run.outcomes[outcome.node] = outcome
                self.entry.finish_node(outcome)
        if "replaced" in reply:
            try:
                self.keep_replaced(run, str(reply["replaced"]))
            except MeshctlError as error:
                # a full disk must not hide how the run ended
                self._note(f"site {run.site.name}: {error}: `meshctl rollback` will not be possible there")
        run.offset = int(str(reply["offset"]))
        over = reply.get("over")
        if isinstance(over, Mapping):
            reason, hint = str(over.get("error", "")), str(over.get("hint", ""))
            if over.get("is_refused"):
                self._finish_all(run, Result.REFUSED, f"site {run.site.name}: {reason}", hint)
            self._end(run, reason, hint)
            run.is_over = True

    def _end(self, run: SiteRun, reason: str, hint: str) -> None:
        """Nodes without an outcome when the run is over: it died, or could not start."""
        for name in run.nodes:
            if name not in run.outcomes:
                result = Result.UNCERTAIN if name in run.in_work else Result.PENDING
                text = reason or "the run ended without an outcome for it"
                self._finish(run, Outcome(name, result, f"site {run.site.name}: {text}", hint))

    def _finish_all(self, run: SiteRun, result: Result, reason: str, hint: str) -> None:
        for name in run.nodes:
            if name not in run.outcomes:
                self._finish(run, Outcome(name, result, reason, hint))

    def _finish(self, run: SiteRun, outcome: Outcome, at_s: float = 0.0) -> None:
        run.outcomes[outcome.node] = outcome
        run.in_work.discard(outcome.node)
        self.entry.finish_node(outcome)
        self.observer(Event(EventKind.FINISHED, outcome.node, at_s or time.time(), outcome.reason, outcome=outcome))

    def _note(self, text: str) -> None:
        self.observer(Event(EventKind.NOTE, "", time.time(), text))

    def _close(self, run: SiteRun) -> None:
        uplink, run.uplink = run.uplink, None
        if uplink is not None:
            uplink.close()

    def _watch(self, runs: Sequence[SiteRun], done: threading.Event) -> None:
        """Pass Ctrl-C on to the sites: the first one stops their runs, the second one leaves them."""
        stopped: set[str] = set()
        while not done.wait(_WATCH_S):
            for run in runs:
                uplink = run.uplink
                if uplink is None or run.is_over:
                    continue
                if self.interrupt.leaving:
                    uplink.close()
                elif self.interrupt.stopping and run.is_started and run.run not in stopped:
                    # an uplink that is lost meanwhile is tried again with the next one
                    with suppress(MeshctlError):
                        if uplink.stop(run.run):
                            stopped.add(run.run)
