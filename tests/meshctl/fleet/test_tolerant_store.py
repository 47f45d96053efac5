"""Commands that change nothing work without a writable journal, and say so once; others are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.errors import MeshctlError
from meshctl.fleet.journal import Journal
from meshctl.fleet.journal_store import open_journal
from meshctl.fleet.sqlite_file import SqliteFile


def unwritable(_self: SqliteFile) -> None:
    raise MeshctlError("cannot open the journal: attempt to write a readonly database", hint="set XDG_STATE_HOME")


def refuse_put(_self: SqliteFile, *_arguments: object) -> None:
    raise MeshctlError("cannot write the journal: database or disk is full")


@pytest.fixture
def environ(tmp_path: Path) -> dict[str, str]:
    return {"XDG_STATE_HOME": str(tmp_path)}


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "meshctl" / "journal.sqlite"
    with Journal(path) as journal:
        journal.begin("provision", fleet="f", inventory="inv", nodes=("a",)).end("1 done")
        journal.remember("f", "a", {"version": "24.10"}, 1.0)
    return path


@pytest.mark.usefixtures("recorded")
def test_a_look_reads_a_journal_that_cannot_be_written(
    environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SqliteFile, "_open", unwritable)
    said: list[str] = []
    with open_journal(environ, said.append, changes_nothing=True) as journal:
        assert [run.command for run in journal.runs()] == ["provision"]
        journal.remember("f", "a", {"version": "25.12"}, 2.0)
        assert journal.last_known("f")["a"].facts == {"version": "24.10"}
        with pytest.raises(MeshctlError):
            journal.begin("provision", fleet="f", inventory="inv", nodes=("a",))
    assert len(said) == 1
    assert "readonly database; continuing without recording" in said[0]
    assert "set XDG_STATE_HOME" in said[0]


def test_a_look_works_without_a_journal_where_none_can_be_created(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file in place of the directory", encoding="utf-8")
    said: list[str] = []
    environ = {"XDG_STATE_HOME": str(tmp_path / "state")}
    with open_journal(environ, said.append, changes_nothing=True) as journal:
        assert journal.runs() == ()
        assert journal.last_known("f") == {}
        assert journal.path == tmp_path / "state" / "meshctl" / "journal.sqlite"
        journal.remember("f", "a", {}, 1.0)
    assert len(said) == 1
    assert str(tmp_path / "state") in said[0]


@pytest.mark.usefixtures("recorded")
def test_a_disk_that_fills_up_during_a_look_is_a_warning(
    environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    with open_journal(environ, said.append, changes_nothing=True) as journal:
        monkeypatch.setattr(SqliteFile, "put", refuse_put)
        journal.remember("f", "a", {}, 2.0)
        journal.remember("f", "a", {}, 3.0)
    assert said == ["warning: cannot write the journal: database or disk is full; continuing without recording"]


@pytest.mark.usefixtures("recorded")
def test_a_command_that_changes_nodes_is_refused(environ: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SqliteFile, "_open", unwritable)
    with pytest.raises(MeshctlError, match="cannot open the journal"):
        open_journal(environ, lambda text: None)


def test_a_file_that_is_no_journal_is_refused_for_a_look_too(environ: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "meshctl").mkdir()
    (tmp_path / "meshctl" / "journal.sqlite").write_text("notes of somebody", encoding="utf-8")
    with pytest.raises(MeshctlError, match="not a journal"):
        open_journal(environ, lambda text: None, changes_nothing=True)
