"""`meshctl history --follow`: new events in the journal, one line for each start, outcome and end of a run.

The runs in progress -> wait until the journal changes -> the differences. Where operators share a journal, the lines
are of all of them; a lost database is waited for.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

from meshctl.cli.output import echo, echo_error, echo_json
from meshctl.fleet.journal import Journal, RunRecord
from meshctl.fleet.outcome import Outcome, Result
from meshctl.fleet.postgresql import DatabaseLost

# The journal is read at least this often: a process that was killed writes no end.
POLL_S = 5.0
# Runs that are read each time; more do not begin between two reads.
_RUNS = 50


@dataclass(frozen=True, slots=True)
class RunEvent:
    """An event of a run: `kind` is `began`, `node` or `ended`."""

    kind: str
    run: RunRecord
    outcome: Outcome | None = None

    def __str__(self) -> str:
        run = self.run
        about = f"run {run.id}: {run.command} of {run.fleet}{' (lab)' if run.lab else ''} by {run.owner}"
        if self.outcome is not None:
            took = f" ({self.outcome.duration_s:.1f} s)" if self.outcome.duration_s else ""
            return f"run {run.id}: {self.outcome}{took}"
        return f"{about}: {run.state if self.kind == 'ended' else 'began'}"

    def as_json(self) -> dict[str, object]:
        run = self.run
        found: dict[str, object] = {"event": self.kind, "run": run.id, "fleet": run.fleet, "lab": run.lab}
        found |= {"command": run.command, "owner": run.owner}
        if self.outcome is not None:
            found |= {"node": self.outcome.node, "result": self.outcome.result.value, "reason": self.outcome.reason}
        elif self.kind == "ended":
            found["state"] = run.state
        return found


def follow(journal: Journal, matches: Callable[[RunRecord], bool], node: str | None, *, as_json: bool) -> None:
    """Print events until interrupted."""
    for event in run_events(journal, matches, node):
        if as_json:
            echo_json(json.dumps(event.as_json()))
        else:
            echo(event)


def run_events(
    journal: Journal,
    matches: Callable[[RunRecord], bool],
    node: str | None,
    *,
    notify: Callable[[str], None] = echo_error,
) -> Generator[RunEvent, None, None]:
    """First the runs in progress, as `began`; then every new event. Raises DatabaseLost at the start; later, `notify`
    is called, and the events of the meantime follow once the database is back."""
    journal.wait_for_change(0.0)
    latest = journal.runs(limit=_RUNS)
    last = max((run.id for run in latest), default=0)
    known: dict[int, Mapping[str, Result]] = {}
    for run in reversed(latest):
        if matches(run) and not run.is_over:
            known[run.id] = _results(_outcomes(journal, run, node))
            yield RunEvent("began", run)
    is_lost = False
    while True:
        try:
            journal.wait_for_change(POLL_S)
            runs = [run for run in journal.runs(limit=_RUNS) if matches(run) and (run.id > last or run.id in known)]
            changed = [(run, _outcomes(journal, run, node)) for run in reversed(runs)]
        except DatabaseLost as error:
            if not is_lost:
                notify(f"warning: {error}; waiting until it is back")
            is_lost = True
            time.sleep(POLL_S)
            continue
        is_lost = False
        for run, outcomes in changed:
            if run.id not in known:
                known[run.id] = {}
                yield RunEvent("began", run)
            for outcome in outcomes:
                if outcome.result not in (Result.PENDING, known[run.id].get(outcome.node)):
                    yield RunEvent("node", run, outcome)
            known[run.id] = _results(outcomes)
            if run.is_over:
                del known[run.id]
                last = max(last, run.id)
                yield RunEvent("ended", run)


def _outcomes(journal: Journal, run: RunRecord, node: str | None) -> list[Outcome]:
    return [each for each in journal.outcomes(run.id) if concerns(node, each.node)]


def is_pattern(node: str | None) -> bool:
    return node is not None and bool(set(node) & set("*?["))


def concerns(node: str | None, name: str) -> bool:
    """Whether `name` is the node, or one of those, that `--node` names; None: all."""
    return node is None or fnmatchcase(name, node)


def _results(outcomes: Iterable[Outcome]) -> dict[str, Result]:
    return {each.node: each.result for each in outcomes}
