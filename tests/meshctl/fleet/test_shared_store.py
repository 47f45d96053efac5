"""Operators share a journal in PostgreSQL: what one records the others see, and a lost database loses no run."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from meshctl.errors import InputError, MeshctlError
from meshctl.fleet import Outcome, Result, postgresql, shared_store
from meshctl.fleet.journal import Journal, default_path
from meshctl.fleet.journal_store import open_journal
from meshctl.fleet.postgresql import MIGRATIONS, UNUSABLE_HINT, Database, DatabaseLost
from meshctl.fleet.run_files import CHANGES, RunFiles
from meshctl.fleet.shared_store import SharedStore
from meshctl.monitor.alarm_log import Silence
from meshctl.monitor.frame import Frame, frame_of
from meshctl.monitor.shared_alarms import SharedAlarms
from meshctl.monitor.store import MIN_BYTES, FrameStore
from tests.meshctl.fleet.laptops import Laptop
from tests.meshctl.fleet.postgresql_server import Server, Uplink
from tests.waiting import until

pytestmark = pytest.mark.xdist_group("postgresql")


def test_what_one_operator_records_the_others_see(alice: Laptop, bob: Laptop) -> None:
    with alice.open() as hers, bob.open() as his:
        run = hers.begin("provision", fleet="f", inventory="inv", nodes=("b", "a"), plan="{}")
        with run.step("b", "apply"):
            pass
        run.finish_node(Outcome("b", Result.DONE, duration_s=1.5, facts={"revision": "r1"}))
        run.remember("f", "b", {"boot_id": "1"}, 10.0)
        (record,) = his.runs(fleet="f", node="a")
        assert (record.id, record.state, record.plan, record.is_connected) == (run.id, "under way", "{}", False)
        assert [str(each) for each in his.outcomes(run.id)] == ["b: done", "a: pending"], "in the run's order"
        assert his.outcomes(run.id)[0].facts == {"revision": "r1"}
        assert [step.step for step in his.steps(run.id)] == ["apply"]
        assert his.last_known("f")["b"].facts == {"boot_id": "1"}
        assert his.unfinished_runs("f") == {run.id: ("a",)}
        assert set(his.unfinished_changes("f")) == set()
        assert his.change_durations_s("f") == ()
        run.end("1 done")
        assert his.run(run.id) is not None
        assert [each.state for each in his.runs()] == ["1 done"]
    assert not default_path(alice.environ).exists(), "nothing is written to the file of this computer"


def test_an_older_sighting_of_another_operator_never_replaces_a_newer_one(alice: Laptop, bob: Laptop) -> None:
    with alice.open() as hers, bob.open() as his:
        hers.remember("f", "a", {"boot_id": "new"}, 200.0)
        his.remember("f", "a", {"boot_id": "old"}, 100.0)
        assert hers.last_known("f")["a"].facts == {"boot_id": "new"}


def test_a_node_that_another_operator_is_changing_is_not_claimed(alice: Laptop, bob: Laptop) -> None:
    with bob.open() as his:
        with alice.open() as hers:
            run = hers.begin("provision", fleet="f", inventory="i", nodes=("a", "b"))
            assert hers.claim(run.id, "f", ("a", "b")) == ()
            second = his.begin("provision", fleet="f", inventory="i", nodes=("b", "c"))
            (taken,) = his.claim(second.id, "f", ("b", "c"))
            assert (taken.node, taken.run) == ("b", run.id)
            assert taken.owner == hers.runs()[1].owner
            assert his.claim(second.id, "other fleet", ("b",)) == ()
            (record,) = [each for each in his.runs() if each.id == run.id]
            assert record.is_connected
            # c was not kept by the refused claim
            assert hers.claim(run.id, "f", ("c",)) == ()
        # the end of the process, here of its connection, frees them
        until(lambda: his.claim(second.id, "f", ("b", "c")) == (), "the claims of a closed journal to end", wait_s=30)


def test_a_run_whose_computer_is_gone_is_called_out_of_contact(alice: Laptop, bob: Laptop, url: str) -> None:
    with alice.open() as hers:
        run = hers.begin("provision", fleet="f", inventory="i", nodes=("a",))
        hers.claim(run.id, "f", ("a",))
    database = Database(url)
    with database.transaction() as transaction:
        transaction.execute("UPDATE runs SET process = ?", ("elsewhere:1:1",))
    database.close()
    with bob.open() as his:
        # the server ends what a closed connection held a moment later
        until(lambda: not his.runs()[0].is_connected, "her connection to end", wait_s=30)
        (record,) = his.runs()
        assert record.state == "under way, or interrupted: out of contact"


@pytest.mark.parametrize("moment", ["between", "in a step"])
def test_a_lost_database_does_not_stop_a_run_and_receives_everything_later(
    carol: Laptop, bob: Laptop, uplink: Uplink, moment: str
) -> None:
    with carol.open() as hers:
        hers.remember("f", "a", {"boot_id": "1"}, 1.0)
        assert hers.last_known("f")["a"].seen_s == 1.0
        run = hers.begin("provision", fleet="f", inventory="i", nodes=("a", "b"))
        if moment == "between":
            uplink.cut()
        with run.step("a", "apply"):
            uplink.cut()
        run.finish_node(Outcome("a", Result.DONE))
        run.remember("f", "a", {"boot_id": "2"}, 2.0)
        assert run.error == ""
        assert "journal entries are kept on this computer" in hers.notice
        assert hers.last_known("f")["a"].seen_s == 1.0, "what was read last"
        run.finish_node(Outcome("b", Result.FAILED, "why"))
        run.end("1 done, 1 failed")
    with bob.open() as his:
        assert his.unfinished(run.id) == ("a", "b")
    uplink.restore()
    carol.open().close()
    with bob.open() as his:
        assert [str(each) for each in his.outcomes(run.id)] == ["a: done", "b: failed: why"]
        assert [(step.step, step.result) for step in his.steps(run.id)] == [("apply", "done")]
        assert his.last_known("f")["a"].facts == {"boot_id": "2"}
        assert his.runs()[0].state == "1 done, 1 failed"


def test_a_process_that_continues_sends_its_entries_as_soon_as_the_database_is_back(
    carol: Laptop, bob: Laptop, uplink: Uplink
) -> None:
    with carol.open() as hers, bob.open() as his:
        run = hers.begin("provision", fleet="f", inventory="i", nodes=("a",))
        assert hers.claim(run.id, "f", ("a",)) == ()
        uplink.cut()
        run.finish_node(Outcome("a", Result.DONE))
        uplink.restore()
        until(lambda: his.unfinished(run.id) == (), "the outcome to arrive", wait_s=30)
        until(lambda: hers.notice == "", "the notice to go", wait_s=30)
        run.end("1 done")
        assert his.runs()[0].state == "1 done"
        assert [claim.run for claim in his.claim(0, "f", ("a",))] in ([run.id], [0]), "claimed again"


def test_a_server_that_hangs_costs_a_run_one_bounded_wait(
    carol: Laptop, uplink: Uplink, monkeypatch: pytest.MonkeyPatch
) -> None:
    with carol.open() as hers:
        run = hers.begin("provision", fleet="f", inventory="i", nodes=("a",))
        # not earlier: on a busy computer the tables of a new database take as long
        monkeypatch.setattr(postgresql, "ANSWER_TIMEOUT_S", 0.5)
        with uplink.silent():
            run.finish_node(Outcome("a", Result.DONE))
            assert "the connection was lost" in hers.notice
            assert run.error == ""


_READ_ONLY = ("ALTER SYSTEM SET default_transaction_read_only = on", "SELECT pg_reload_conf()")
_WRITABLE = ("ALTER SYSTEM RESET default_transaction_read_only", "SELECT pg_reload_conf()")
_FULL = (
    "CREATE FUNCTION meshctl.refuse() RETURNS trigger LANGUAGE plpgsql AS"
    " $$ BEGIN RAISE 'No space left on device' USING ERRCODE = 'disk_full'; END $$",
    "CREATE TRIGGER full_disk BEFORE INSERT OR UPDATE ON meshctl.outcomes EXECUTE FUNCTION meshctl.refuse()",
    "CREATE TRIGGER full_disk BEFORE INSERT OR UPDATE ON meshctl.runs EXECUTE FUNCTION meshctl.refuse()",
)
_ROOM = ("DROP FUNCTION meshctl.refuse CASCADE",)


@pytest.mark.parametrize(
    ("refuse", "accept", "reason"),
    [(_READ_ONLY, _WRITABLE, "read-only transaction"), (_FULL, _ROOM, "No space left on device")],
)
def test_a_database_that_takes_nothing_stops_no_run(
    alice: Laptop, bob: Laptop, url: str, refuse: tuple[str, ...], accept: tuple[str, ...], reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    import psycopg

    monkeypatch.setattr(shared_store, "RETRY_S", 0.05)
    with alice.open() as hers, psycopg.connect(url, autocommit=True) as administrator:
        administrator.execute("SET default_transaction_read_only = off")
        run = hers.begin("provision", fleet="f", inventory="i", nodes=("a",))
        try:
            for statement in refuse:
                administrator.execute(statement)
            until(lambda: is_refused(bob, reason), "the database to refuse a new run", wait_s=60)
            run.finish_node(Outcome("a", Result.DONE))
            assert run.error == ""
            assert reason in hers.notice
            assert "journal entries are kept on this computer" in hers.notice
        finally:
            for statement in accept:
                administrator.execute(statement)
        with bob.open() as his:
            until(lambda: his.unfinished(run.id) == (), "the outcome to arrive", wait_s=60)


def is_refused(laptop: Laptop, reason: str) -> bool:
    """Whether a new run is refused for this reason, with the way around it."""
    try:
        with laptop.open() as journal:
            journal.begin("provision", fleet="f", inventory="i", nodes=("b",)).end("ok")
    except DatabaseLost as error:
        assert reason in str(error)
        assert error.hint == UNUSABLE_HINT
        return True
    return False


def test_runs_without_the_database_are_merged_once_it_is_back(carol: Laptop, bob: Laptop, uplink: Uplink) -> None:
    with bob.open() as his:
        his.begin("provision", fleet="f", inventory="i", nodes=("z",)).end("ok")
    uplink.cut()
    with carol.open() as hers:
        (notice,) = carol.notices
        assert "cannot connect" in notice
        assert "merged later" in notice
        first = hers.begin("provision", fleet="f", inventory="i", nodes=("b", "a"))
        with first.step("b", "apply"):
            pass
        first.finish_node(Outcome("b", Result.DONE))
        first.end("1 done")
        RunFiles(hers.path).save(first.id, CHANGES, {"b": []})
        hers.remember("f", "b", {"boot_id": "3"}, 3.0)
        running = hers.begin("status", fleet="f", inventory="i", nodes=("c",))
    carol.notices.clear()
    uplink.restore()
    with carol.open() as hers:
        assert carol.notices == ["runs of this computer are merged into the shared journal as 2"]
        assert [(run.id, run.state) for run in hers.runs()] == [(2, "1 done"), (1, "ok")], "one still runs"
        assert [str(each) for each in hers.outcomes(2)] == ["b: done", "a: pending"]
        assert [step.step for step in hers.steps(2)] == ["apply"]
        assert hers.last_known("f")["b"].facts == {"boot_id": "3"}
        assert RunFiles(hers.path).load(2, CHANGES) == {"b": []}
    with Journal(default_path(carol.environ)) as local:
        record = local.run(running.id)
        assert record is not None
        local._store.put([("UPDATE runs SET ended_s = 1, result = 'ok' WHERE id = ?", (running.id,))], 1.0)
    carol.notices.clear()
    for _ in range(2):
        carol.open().close()
    assert carol.notices == ["runs of this computer are merged into the shared journal as 3"]


def test_a_merge_that_dies_halfway_is_repeated_without_effect(
    carol: Laptop, uplink: Uplink, monkeypatch: pytest.MonkeyPatch
) -> None:
    uplink.cut()
    with carol.open() as hers:
        run = hers.begin("provision", fleet="f", inventory="i", nodes=("a",))
        with run.step("a", "apply"):
            pass
        run.end("ok")
    uplink.restore()

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(SharedStore, "_copy_files", die)
        with pytest.raises(KeyboardInterrupt):
            carol.open()
    with carol.open() as hers:
        (record,) = hers.runs()
        assert len(hers.steps(record.id)) == 1


def test_entries_of_a_killed_process_are_sent_by_the_next_one(carol: Laptop, bob: Laptop, uplink: Uplink) -> None:
    script = (
        "import os, sys, time\n"
        "from meshctl.fleet import Outcome, Result\n"
        "from meshctl.fleet.journal_store import open_journal\n"
        "run = (journal := open_journal(os.environ, print)).begin('p', fleet='f', inventory='i', nodes=('a',))\n"
        "print(run.id, flush=True); sys.stdin.readline()\n"
        "run.finish_node(Outcome('a', Result.DONE)); os._exit(9)"
    )
    environ = {**os.environ, **carol.environ}
    child = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environ
    )
    assert child.stdin is not None
    assert child.stdout is not None
    run_id = int(child.stdout.readline())
    uplink.cut()
    child.communicate("\n", timeout=60)
    uplink.restore()
    with bob.open() as his:
        assert his.unfinished(run_id) == ("a",)
        carol.open().close()
        assert his.unfinished(run_id) == ()
        assert [each.state for each in his.runs()] == ["interrupted"]


def test_the_journal_of_a_lab_stays_on_this_computer(alice: Laptop) -> None:
    with open_journal(alice.environ, alice.notices.append, lab="/lab") as lab:
        lab.begin("provision", fleet="f", inventory="i", nodes=("a",))
    with alice.open() as hers:
        assert hers.runs() == ()


def test_operators_who_start_at_once_make_the_tables_once(url: str) -> None:
    problems: list[Exception] = []

    def open_and_close() -> None:
        try:
            Database(url).close()
        except MeshctlError as error:
            problems.append(error)

    threads = [threading.Thread(target=open_and_close) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert problems == []


def test_tables_of_an_earlier_version_are_migrated_and_keep_their_rows(
    alice: Laptop, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("meshctl.fleet.postgresql.MIGRATIONS", MIGRATIONS[:1])
        with alice.open() as hers:
            hers.begin("provision", fleet="f", inventory="i", nodes=("a",)).end("ok")
    with alice.open() as hers:
        assert [run.result for run in hers.runs()] == ["ok"]
        assert hers._store.read("SELECT count(*) FROM alarm_actions") == [(0,)]


def test_tables_of_a_later_version_are_refused_and_left_alone(alice: Laptop, url: str) -> None:
    database = Database(url)
    with database.transaction() as transaction:
        transaction.execute("UPDATE version SET version = 99")
    database.close()
    with pytest.raises(MeshctlError, match="version 99, expected") as caught:
        alice.open()
    assert "upgrade" in caught.value.hint


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("mysql://root:hunter2@db/x", "expected postgresql://USER@HOST/DATABASE, found 'mysql://db/x'"),
        ("postgresql://alice:hunter2@db:port/x", "the URL of the database is malformed"),
    ],
)
def test_a_bad_url_is_refused_without_its_password(tmp_path: Path, url: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        Laptop(tmp_path, url).open()
    assert message in str(caught.value)
    assert "hunter2" not in f"{caught.value} {caught.value.hint}"


def test_a_wrong_password_is_reported_without_it(server: Server) -> None:
    with pytest.raises(DatabaseLost) as caught:
        Database(f"postgresql://eve:hunter2@127.0.0.1:{server.port}/postgres")
    assert "eve" in str(caught.value)
    assert "hunter2" not in str(caught.value)


def test_what_an_operator_does_about_an_alarm_reaches_the_monitors_of_the_others(
    alice: Laptop, bob: Laptop, tmp_path: Path
) -> None:
    now_s = time.time()

    def history(name: str) -> FrameStore:
        store = FrameStore.open(tmp_path / f"{name}.sqlite", 86400.0, MIN_BYTES)
        store.append(frame_with_alarm(now_s))
        return store

    with alice.open() as hers, bob.open() as his, history("alice") as her_history, history("bob") as his_history:
        exchange, other = hers.alarm_exchange("f"), his.alarm_exchange("f")
        assert exchange is not None
        assert other is not None
        her_history.on_action = exchange.send
        changes = threading.Semaphore(0)
        following = SharedAlarms(other, his_history, on_change=changes.release)
        following.start()
        try:
            her_history.acknowledge("b01", "weak", "alice", now_s + 1)
            assert changes.acquire(timeout=30)
            until(lambda: acknowledged_by(his_history, now_s) == ["alice"], "the acknowledgment", wait_s=30)
            her_history.silence("*", "weak", Silence(now_s + 3600, "on the bench", "alice"), now_s + 2)
            until(lambda: [each.reason for each in his_history.silences(now_s).values()], "the silence", wait_s=30)
            her_history.end_silence("*", "weak", "alice", now_s + 3)
            until(lambda: not his_history.silences(now_s), "the end of the silence", wait_s=30)
        finally:
            following.stop()
        # a monitor that starts later learns of silences, but an old acknowledgment is not repeated
        with history("late") as late:
            late.append(frame_with_alarm(now_s + 10))
            third = his.alarm_exchange("f")
            assert third is not None
            SharedAlarms(third, late).take()
            assert acknowledged_by(late, now_s) == [None]
        assert hers.alarm_exchange("g") is not None
    with Journal(tmp_path / "own.sqlite") as own:
        assert own.alarm_exchange("f") is None


def frame_with_alarm(time_s: float) -> Frame:
    alarm = {"code": "weak", "level": "warning", "text": "weak", "hint": ""}
    status = {"nodes": [{"name": "b01", "alarms": [alarm]}], "robots": [], "alarms": []}
    return frame_of(status, time_s=time_s)


def acknowledged_by(history: FrameStore, now_s: float) -> list[str | None]:
    return [None if each.acknowledged is None else each.acknowledged.by for each in history.alarms(now_s=now_s)]


def test_many_operators_write_at_once_and_nothing_is_lost(tmp_path: Path, url: str) -> None:
    def work(number: int) -> None:
        with Laptop(tmp_path / str(number), url).open() as journal:
            run = journal.begin("p", fleet="f", inventory="i", nodes=tuple(f"n{each}" for each in range(20)))
            for each in range(20):
                run.finish_node(Outcome(f"n{each}", Result.DONE))
                run.remember("f", f"n{each}", {"by": str(number)}, time.time())
            run.end("ok")

    threads = [threading.Thread(target=work, args=(number,)) for number in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with Laptop(tmp_path / "reader", url).open() as journal:
        assert [run.result for run in journal.runs()] == ["ok"] * 5
        for run in journal.runs():
            assert {outcome.result for outcome in journal.outcomes(run.id)} == {Result.DONE}
