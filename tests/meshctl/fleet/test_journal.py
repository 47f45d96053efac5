"""The journal survives a killed process, has one outcome per node, and supports two concurrent processes."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from meshctl.errors import MeshctlError, NodeError
from meshctl.fleet import Outcome, Result
from meshctl.fleet.journal import Journal, default_path
from meshctl.fleet.journal_schema import SCHEMA
from meshctl.fleet.process import is_process_alive, this_process
from meshctl.fleet.sqlite_file import SqliteFile


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "meshctl" / "journal.sqlite"


def database_of(journal: Journal) -> sqlite3.Connection:
    assert isinstance(journal._store, SqliteFile)
    return journal._store._database


def test_every_node_of_a_run_is_pending_until_it_has_an_outcome(path: Path) -> None:
    with Journal(path) as journal:
        run = journal.begin("provision", fleet="f", inventory="inv", nodes=("a", "b", "c"))
        run.finish_node(Outcome("b", Result.DONE, facts={"revision": "r1"}))
        run.finish_node(Outcome("c", Result.ROLLED_BACK, "no neighbor"))
        assert [outcome.result for outcome in journal.outcomes(run.id)] == [
            Result.PENDING,
            Result.DONE,
            Result.ROLLED_BACK,
        ]
        assert journal.outcomes(run.id)[1].facts == {"revision": "r1"}
        assert journal.unfinished(run.id) == ("a", "c")


def test_unfinished_nodes_remain_until_a_later_run_takes_them_up(path: Path) -> None:
    with Journal(path) as journal:
        first = journal.begin("provision", fleet="f", inventory="inv", nodes=("a", "b", "c"))
        first.finish_node(Outcome("a", Result.UNREACHABLE))
        second = journal.begin("provision", fleet="f", inventory="inv", nodes=("b",))
        second.finish_node(Outcome("b", Result.DONE))
        journal.begin("robots deploy", fleet="f", inventory="inv", nodes=("a",))
        journal.begin("provision", fleet="other", inventory="inv", nodes=("c",))
        assert journal.unfinished_runs("f") == {3: ("a",), 1: ("a", "c")}
        third = journal.begin("resume", fleet="f", inventory="inv", nodes=("a", "c"))
        third.finish_node(Outcome("a", Result.DONE))
        third.finish_node(Outcome("c", Result.FAILED))
        assert journal.unfinished_runs("f") == {5: ("c",), 3: ("a",)}
        assert [run.id for run in journal.runs(fleet="f", node="b")] == [2, 1]


def test_a_change_is_unfinished_from_its_start_until_a_run_reaches_its_node_again(path: Path) -> None:
    with Journal(path) as journal:
        first = journal.begin("provision", fleet="f", inventory="inv", nodes=("a", "b", "c"))
        for name in ("a", "b", "c"):
            with first.step(name, "stage" if name == "c" else "apply"):
                pass
        first.finish_node(Outcome("b", Result.ROLLED_BACK))
        lost = journal.unfinished_changes("f")
        assert lost == {"a": next(step.began_s for step in journal.steps(first.id, "a"))}
        first.finish_node(Outcome("a", Result.UNCERTAIN))
        second = journal.begin("resume", fleet="f", inventory="inv", nodes=("a",))
        second.finish_node(Outcome("a", Result.UNREACHABLE))
        robots = journal.begin("robots deploy", fleet="f", inventory="inv", nodes=("a",))
        robots.finish_node(Outcome("a", Result.DONE))
        assert journal.unfinished_changes("f") == lost
        assert journal.unfinished_changes("other") == {}
        fourth = journal.begin("provision", fleet="f", inventory="inv", nodes=("a", "b"))
        for name, step in (("a", "apply"), ("b", "flash")):
            with fourth.step(name, step):
                pass
        assert journal.unfinished_changes("f")["a"] == lost["a"]
        # a flash is not rolled back
        assert journal.latest_unfinished("f", "apply") == {"a": journal.steps(fourth.id, "a")[0].began_s}
        assert journal.latest_unfinished("f", "flash") == {"b": journal.steps(fourth.id, "b")[0].began_s}
        fourth.finish_node(Outcome("b", Result.DONE))
        third = journal.begin("provision", fleet="f", inventory="inv", nodes=("a",))
        third.finish_node(Outcome("a", Result.UNCHANGED))
        assert journal.unfinished_changes("f") == {}


def test_steps_record_failures_and_interruptions(path: Path) -> None:
    with Journal(path) as journal:
        run = journal.begin("apply", fleet="f", inventory="inv", nodes=("a",))
        with run.step("a", "upload"):
            pass
        with pytest.raises(NodeError), run.step("a", "arm"):
            raise NodeError("locked by bob")
        cut = run.step("a", "apply")
        cut.__enter__()
        steps = journal.steps(run.id)
        assert [(step.step, step.result) for step in steps] == [
            ("upload", "done"),
            ("arm", "failed: locked by bob"),
            ("apply", ""),
        ]
        assert steps[0].duration_s is not None
        assert steps[2].duration_s is None
        cut.__exit__(None, None, None)


def test_a_run_whose_process_died_is_reported_as_interrupted(path: Path) -> None:
    script = (
        "import os, sys; from pathlib import Path; from meshctl.fleet.journal import Journal\n"
        "Journal(Path(sys.argv[1])).begin('provision', fleet='f', inventory='i', nodes=('a',)); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", script, str(path)], check=False)
    with Journal(path) as journal:
        (record,) = journal.runs()
        assert (record.is_over, record.state) == (True, "interrupted")
        own = journal.run(journal.begin("plan", fleet="g", inventory="i", nodes=()).id)
        assert own is not None
        assert (own.is_over, own.state) == (False, "under way")
        assert [run.fleet for run in journal.runs(fleet="f")] == ["f"]


def test_two_processes_write_at_once_and_nothing_is_lost(path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from meshctl.fleet import Outcome, Result\n"
        "from meshctl.fleet.journal import Journal\n"
        "with Journal(Path(sys.argv[1])) as journal:\n"
        "    run = journal.begin('p', fleet='f', inventory='i', nodes=tuple(f'n{i}' for i in range(50)))\n"
        "    for i in range(50): run.finish_node(Outcome(f'n{i}', Result.DONE))\n"
        "    run.end('ok')\n"
    )
    workers = [subprocess.Popen([sys.executable, "-c", script, str(path)]) for _ in range(3)]
    assert [worker.wait(timeout=120) for worker in workers] == [0, 0, 0]
    with Journal(path) as journal:
        runs = journal.runs()
        assert [run.result for run in runs] == ["ok"] * 3
        for run in runs:
            assert [outcome.result for outcome in journal.outcomes(run.id)] == [Result.DONE] * 50


def test_an_older_sighting_never_replaces_a_newer_one(path: Path) -> None:
    with Journal(path) as journal:
        journal.remember("f", "a", {"boot_id": "new"}, 200.0)
        journal.remember("f", "a", {"boot_id": "old"}, 100.0)
        assert journal.last_known("f")["a"].facts == {"boot_id": "new"}
        assert journal.last_known("other") == {}


def test_a_file_that_is_not_a_journal_is_rejected_with_its_path(path: Path) -> None:
    path.parent.mkdir(parents=True)
    path.write_bytes(b"this is no database, it is a letter" * 100)
    with pytest.raises(MeshctlError, match=str(path)):
        Journal(path)


def test_a_journal_of_a_later_version_is_refused(path: Path) -> None:
    with Journal(path) as journal:
        database_of(journal).execute("PRAGMA user_version = 7")
    with pytest.raises(MeshctlError, match="version 7, expected 1"):
        Journal(path)


def test_the_journal_is_located_in_the_xdg_state_directory() -> None:
    assert default_path({"XDG_STATE_HOME": "/s"}) == Path("/s/meshctl/journal.sqlite")
    assert default_path({"HOME": "/home/a", "XDG_STATE_HOME": "relative"}) == Path(
        "/home/a/.local/state/meshctl/journal.sqlite"
    )


def test_a_reused_pid_is_not_mistaken_for_the_original_process() -> None:
    own = this_process()
    assert is_process_alive(own)
    assert not is_process_alive(own + "1")
    assert is_process_alive("elsewhere:1:1")


def test_an_unwritable_journal_is_reported_without_stopping_the_run(path: Path) -> None:
    with Journal(path) as journal:
        run = journal.begin("provision", fleet="f", inventory="inv", nodes=("a",))
        database_of(journal).execute("PRAGMA query_only = ON")
        with run.step("a", "arm"):
            pass
        run.remember("f", "a", {"boot_id": "1"}, 5.0)
        run.finish_node(Outcome("a", Result.DONE))
        run.end("1 done")
        assert "cannot write the journal" in run.error
        # a resume looks at the node again
        assert journal.unfinished(run.id) == ("a",)


@contextmanager
def held_by_another(path: Path) -> Iterator[sqlite3.Connection]:
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield other


def test_writes_deferred_by_a_locked_journal_are_flushed_once_it_is_free(path: Path) -> None:
    with Journal(path) as journal:
        run = journal.begin("provision", fleet="f", inventory="inv", nodes=("a", "b"))
        with held_by_another(path):
            with run.step("a", "arm"):
                run.remember("f", "a", {"boot_id": "1"}, 5.0)
            run.finish_node(Outcome("a", Result.DONE))
            assert "locked" in run.error
            assert journal.steps(run.id) == ()
        run.finish_node(Outcome("b", Result.DONE))
        run.end("2 done")
        assert run.error == ""
        assert [(step.step, step.result) for step in journal.steps(run.id)] == [("arm", "done")]
        assert [outcome.result for outcome in journal.outcomes(run.id)] == [Result.DONE, Result.DONE]
        assert journal.last_known("f")["a"].facts == {"boot_id": "1"}


def test_writes_deferred_by_a_full_disk_are_kept_until_space_is_available(path: Path) -> None:
    with Journal(path) as journal:
        run = journal.begin("provision", fleet="f", inventory="inv", nodes=("a",))
        database = database_of(journal)
        (pages,) = database.execute("PRAGMA page_count").fetchone()
        database.execute(f"PRAGMA max_page_count = {pages}")
        run.finish_node(Outcome("a", Result.FAILED, "x" * 100_000))
        assert "full" in run.error
        database.execute("PRAGMA max_page_count = 100000")
        run.end("1 failed")
        assert (run.error, journal.outcomes(run.id)[0].result) == ("", Result.FAILED)


def test_a_locked_journal_can_be_read_and_hints_at_the_process(
    path: Path,
) -> None:
    Journal(path).close()
    with held_by_another(path), Journal(path) as journal:
        assert journal.runs() == ()
        with pytest.raises(MeshctlError, match="locked") as caught, journal._store.write(0.0):
            pass
        assert "fuser" in caught.value.hint


def test_a_journal_that_cannot_be_written_is_not_called_damaged(path: Path) -> None:
    path.parent.mkdir(parents=True)
    path.mkdir()
    with pytest.raises(MeshctlError, match=r"cannot open the journal: it is a directory$") as caught:
        Journal(path)
    assert "XDG_STATE_HOME" in caught.value.hint


def test_the_reason_why_a_journal_cannot_be_used_is_in_words(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite's words are `unable to open database file` and `attempt to write a readonly database`."""
    with pytest.raises(MeshctlError, match=f"there is no directory {path.parent}$"):
        SqliteFile(path, SCHEMA, read_only=True)
    with closing(SqliteFile(path, SCHEMA)) as file:
        failed = sqlite3.OperationalError("attempt to write a readonly database")
        failed.sqlite_errorcode = sqlite3.SQLITE_READONLY
        monkeypatch.setattr("meshctl.fleet.sqlite_file.os.access", lambda place, mode: place != path.parent)
        with pytest.raises(MeshctlError, match=f"{path.parent} cannot be written$"), file.write():
            raise failed
        monkeypatch.setattr("meshctl.fleet.sqlite_file.os.access", lambda place, mode: place != path)
        with pytest.raises(MeshctlError, match=r"you may not read and write it$"), file.write():
            raise failed


def test_the_reason_why_a_journal_cannot_be_made_is_in_words(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file in place of the directory", encoding="utf-8")
    with pytest.raises(MeshctlError, match=r"cannot open the journal: (Not a directory|File exists)$"):
        Journal(tmp_path / "state" / "journal.sqlite")


def test_a_lab_and_a_real_fleet_of_the_same_name_are_kept_separate(path: Path) -> None:
    with Journal(path) as field, Journal(path, lab="/lab") as lab:
        practice = lab.begin("provision", fleet="f", inventory="/lab/inventory", nodes=("a",))
        with practice.step("a", "apply"):
            pass
        practice.finish_node(Outcome("a", Result.UNCERTAIN))
        practice.remember("f", "a", {"macs": "02:4d:00:00:00:01"}, 1.0)
        lab.remember("f", "b", {"version": "virtual"}, 1.0)
        field.remember("f", "b", {"version": "real"}, 2.0)
        assert field.unfinished_runs("f") == {}
        assert field.unfinished_changes("f") == {}
        assert {node: dict(last.facts) for node, last in field.last_known("f").items()} == {"b": {"version": "real"}}
        assert lab.unfinished_runs("f") == {practice.id: ("a",)}
        assert set(lab.unfinished_changes("f")) == {"a"}
        assert lab.last_known("f")["b"].facts == {"version": "virtual"}
        assert [(run.fleet, run.lab) for run in field.runs()] == [("f", "/lab")], "a journal without a lab lists all"
        assert (field.runs(fleet="f"), len(lab.runs(fleet="f"))) == ((), 1)
        record = lab.run(practice.id)
        assert record is not None
        assert (record.fleet, record.lab) == ("f", "/lab")


def test_lab_runs_recorded_as_real_by_an_earlier_version_are_moved_to_their_lab(path: Path) -> None:
    def lab_of(inventory: str) -> str:
        return "/lab" if inventory == "/lab/inventory" else ""

    with Journal(path) as field, Journal(path, lab="/lab") as lab:
        virtual = field.begin("provision", fleet="f", inventory="/lab/inventory", nodes=("a",))
        only_virtual = field.begin("provision", fleet="practice", inventory="/lab/inventory", nodes=("a",))
        real = field.begin("provision", fleet="f", inventory="/fleets/f", nodes=("a",))
        field.remember("f", "a", {"version": "x"}, 1.0)
        field.remember("practice", "a", {"version": "x"}, 1.0)
        for fleet in ("f", "practice"):
            field.move_lab_runs(fleet, lab_of)
            field.move_lab_runs(fleet, lab_of)
        assert [run.id for run in field.runs(fleet="f")] == [real.id]
        assert [run.id for run in lab.runs(fleet="f")] == [virtual.id]
        assert [run.id for run in lab.runs(fleet="practice")] == [only_virtual.id]
        assert set(field.last_known("f")) == {"a"}, "their origin is unknown: they stay"
        assert (field.last_known("practice"), set(lab.last_known("practice"))) == ({}, {"a"})


def test_facts_of_a_device_that_was_replaced_are_left_out(path: Path) -> None:
    """On any laptop: the pinned host keys come with the inventory, whichever user ran `meshctl replace`."""
    pins = {"b01": ["SHA256:old"], "b02": ["SHA256:b02"]}

    def opened() -> Journal:
        return Journal(path, pinned=lambda node: pins.get(node, ()))

    with opened() as journal:
        for key in ("b01", "b02", "status.b01", "robot.b01"):
            journal.remember("f", key, {"macs": f"02:00:00:00:00:0{len(key) % 10}"}, 100.0)
    pins["b01"] = ["SHA256:new"]
    with opened() as journal:
        known = journal.last_known("f")
        assert sorted(known) == ["b02", "robot.b01"]
        assert known["b02"].facts == {"macs": "02:00:00:00:00:03"}
        run = journal.begin("provision", fleet="f", inventory="", nodes=("b01",))
        run.remember("f", "b01", {"macs": "02:00:00:00:00:11"}, 200.0)
        assert journal.last_known("f")["b01"].facts == {"macs": "02:00:00:00:00:11"}
    # one key of several was rotated, or known_hosts is not at hand: still the same device
    pins["b01"], pins["b02"] = ["SHA256:new", "SHA256:rsa"], []
    with opened() as journal:
        assert {"b01", "b02"} <= set(journal.last_known("f"))
