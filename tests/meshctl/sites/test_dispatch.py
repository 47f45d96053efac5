"""The outcome of a run at a site that was never reached."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn, cast

import pytest

from meshctl.errors import Unreachable
from meshctl.fleet import Interrupt, Result
from meshctl.fleet.events import Event
from meshctl.fleet.journal import Journal
from meshctl.model import Fleet
from meshctl.model.site import Site
from meshctl.nodes.connections import ConnectionPool
from meshctl.sites import dispatch
from meshctl.sites.dispatch import SiteExecution, SiteRun


def test_a_run_that_never_started_ends_with_the_last_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt, attempts = Interrupt(), []

    def full(*_words: Any, **_options: Any) -> NoReturn:
        attempts.append(1)
        if len(attempts) == 3:
            interrupt.request()
            interrupt.request()
        raise Unreachable("the hub has no room for the order")

    monkeypatch.setattr(dispatch, "open_uplink", full)
    monkeypatch.setattr(dispatch, "_FIRST_WAIT_S", 0.01)
    events: list[Event] = []
    with Journal(tmp_path / "journal.sqlite") as journal:
        entry = journal.begin("provision", fleet="f", inventory=str(tmp_path), nodes=("s1",))
        nothing = cast("Fleet", None), cast("ConnectionPool", None)
        execution = SiteExecution(*nothing, entry, events.append, interrupt, lambda run, text: None)
        outcomes = execution.execute([SiteRun(Site("south"), "r1", ("s1",))])
        entry.end("1 pending")
    assert outcomes["s1"].result is Result.PENDING
    assert outcomes["s1"].reason.endswith("; the last attempt failed: the hub has no room for the order")
    assert sum("no room" in event.text for event in events if not event.node) == 1
