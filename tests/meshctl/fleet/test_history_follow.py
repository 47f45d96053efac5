"""`meshctl history --follow` where operators share a journal in PostgreSQL."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from meshctl.cli import history_follow
from meshctl.cli.history_follow import run_events
from meshctl.fleet import Outcome, Result
from tests.meshctl.fleet.laptops import Laptop
from tests.meshctl.fleet.postgresql_server import Uplink
from tests.waiting import until

pytestmark = pytest.mark.xdist_group("postgresql")


def test_following_shows_what_other_operators_do(alice: Laptop, bob: Laptop) -> None:
    with alice.open() as hers, bob.open() as his:
        old = hers.begin("provision", fleet="f", inventory="i", nodes=("x",))
        seen: list[str] = []
        following = run_events(his, lambda run: True, None)
        seen.append(str(next(following)))
        run = hers.begin("provision", fleet="f", inventory="i", nodes=("a", "b"))
        seen.append(str(next(following)))
        run.finish_node(Outcome("a", Result.DONE, duration_s=2.0))
        seen.append(str(next(following)))
        run.end("1 done, 1 pending")
        old.end("1 pending")
        seen += sorted([str(next(following)), str(next(following))])
        following.close()
        owner = hers.runs()[0].owner
        assert seen == [
            f"run {old.id}: provision of f by {owner}: began",
            f"run {run.id}: provision of f by {owner}: began",
            f"run {run.id}: a: done (2.0 s)",
            f"run {old.id}: provision of f by {owner}: 1 pending",
            f"run {run.id}: provision of f by {owner}: 1 done, 1 pending",
        ]


def test_following_waits_for_a_lost_database_and_then_shows_what_was_missed(
    alice: Laptop, carol: Laptop, uplink: Uplink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_follow, "POLL_S", 0.05)
    notices: list[str] = []
    with alice.open() as hers, carol.open() as cut_off:
        old = hers.begin("provision", fleet="f", inventory="i", nodes=("x",))
        following = run_events(cut_off, lambda run: True, None, notify=notices.append)
        assert next(following).run.id == old.id
        uplink.cut()
        run = hers.begin("provision", fleet="f", inventory="i", nodes=("a",))
        with ThreadPoolExecutor(1) as pool:
            missed = pool.submit(next, following)
            until(lambda: bool(notices), "the loss is reported")
            uplink.restore()
            shown = missed.result(60)
        assert (shown.kind, shown.run.id) == ("began", run.id)
        following.close()
        run.end("1 pending")
        old.end("1 pending")
    assert [notice.count("the connection was lost") for notice in notices] == [1]
