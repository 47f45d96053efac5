"""A run number that names nothing to resume or to roll back is answered with what it names."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.cli.main import main
from meshctl.cli.run_record import run_number, run_of
from meshctl.errors import InputError
from meshctl.fleet import Outcome, Result
from meshctl.fleet.journal import Journal
from tests.meshctl.inventory.inventories import HEAD


def _inventory_with_journal(directory: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An inventory whose fleet is called trial; the journal is in this directory, too."""
    monkeypatch.setenv("XDG_STATE_HOME", str(directory))
    inventory = directory / "fleet.yaml"
    inventory.write_text(HEAD, encoding="utf-8")
    return inventory


@pytest.mark.parametrize(
    ("of", "asked_by", "error", "hint"),
    [
        (
            ("f", ""),
            ("f", "/lab"),
            "belongs to the real fleet, but $MESHCTL_LAB or --lab selects the lab in /lab",
            "unset",
        ),
        (("f", "/lab"), ("f", ""), "belongs to the lab in /lab", "add `--lab /lab`"),
        (("f", "/lab"), ("f", "/other"), "belongs to the lab in /lab", "add `--lab /lab`"),
        (("g", ""), ("f", ""), "belongs to fleet g, not to f", "history --fleet f"),
    ],
)
def test_a_run_of_another_fleet_is_refused_by_its_fleet(
    of: tuple[str, str], asked_by: tuple[str, str], error: str, hint: str, tmp_path: Path
) -> None:
    path = tmp_path / "journal.sqlite"
    with Journal(path, lab=of[1]) as journal:
        run = journal.begin("provision", fleet=of[0], inventory="inv", nodes=("a",))
        run.end("done")
    with Journal(path, lab=asked_by[1]) as journal:
        with pytest.raises(InputError) as raised:
            run_of(journal, asked_by[0], run.id)
        assert error in str(raised.value)
        assert hint in raised.value.hint
        with pytest.raises(InputError, match=f"run {run.id + 1} does not exist"):
            run_of(journal, asked_by[0], run.id + 1)
    with Journal(path, lab=of[1]) as journal:
        assert run_of(journal, of[0], run.id).id == run.id


def test_the_last_run_is_the_latest_of_the_fleet_and_the_lab(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    with Journal(path) as field, Journal(path, lab="/lab") as lab:
        runs = [
            journal.begin("provision", fleet=fleet, inventory="inv", nodes=("a",))
            for journal, fleet in ((field, "f"), (lab, "f"), (field, "g"))
        ]
        assert run_number("last", field.runs(fleet="f", limit=1)) == runs[0].id
        assert run_number("last", lab.runs(fleet="f", limit=1)) == runs[1].id
        assert run_number("17", field.runs(fleet="f", limit=1)) == 17
        with pytest.raises(InputError, match="there is no run yet"):
            run_number("last", field.runs(fleet="h", limit=1))
        for text in ("b03", "-1", "1.5", "", "\u0661", "9" * 30):
            with pytest.raises(InputError, match="expected the number of a run, or `last`"):
                run_number(text, ())


def test_an_interrupted_rollback_is_repeated_not_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    inventory = _inventory_with_journal(tmp_path, monkeypatch)
    with Journal(tmp_path / "meshctl/journal.sqlite") as journal:
        for command in ("provision", "rollback", "rollback"):
            run = journal.begin(command, fleet="trial", inventory="inv", nodes=("a",))
            run.finish_node(Outcome("a", Result.PENDING))
            run.end("1 pending")
    with pytest.raises(SystemExit) as ended:
        main(["rollback", "last", "--yes", "-i", str(inventory)])
    assert ended.value.code == 2
    assert "run 1 changed none of these nodes" in capsys.readouterr().err


def test_a_run_in_progress_is_not_resumed(tmp_path: Path) -> None:
    with Journal(tmp_path / "journal.sqlite") as journal:
        run = journal.begin("provision", fleet="f", inventory="inv", nodes=("a",))
        with pytest.raises(InputError, match="is still in progress"):
            run_of(journal, "f", run.id)


@pytest.mark.parametrize("command", ["restore", "rollback"])
def test_a_finished_run_of_any_kind_has_nothing_to_resume(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    inventory = _inventory_with_journal(tmp_path, monkeypatch)
    with Journal(tmp_path / "meshctl/journal.sqlite") as journal:
        run = journal.begin(command, fleet="trial", inventory="inv", nodes=("a",))
        run.finish_node(Outcome("a", Result.DONE))
        run.end("1 done")
    with pytest.raises(SystemExit) as ended:
        main(["resume", "-i", str(inventory)])
    assert (ended.value.code, capsys.readouterr().out) == (0, "run 1 is finished: nothing to resume\n")


def test_the_last_run_to_resume_is_the_latest_unfinished_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    inventory = _inventory_with_journal(tmp_path, monkeypatch)
    with Journal(tmp_path / "meshctl/journal.sqlite") as journal:
        for node, result in (("a", Result.PENDING), ("b", Result.DONE)):
            run = journal.begin("provision", fleet="trial", inventory="inv", nodes=(node,))
            run.finish_node(Outcome(node, result))
            run.end("ended")
    for words in (["last"], []):
        with pytest.raises(SystemExit) as ended:
            main(["resume", *words, "-i", str(inventory)])
        said = capsys.readouterr()
        # the inventory has no node `a`
        assert (ended.value.code, said.out) == (0, "run 1 is finished: nothing to resume\n")
        assert "no longer manages: a" in said.err
    with pytest.raises(SystemExit) as ended:
        main(["resume", "b03", "-i", str(inventory)])
    assert ended.value.code == 2
    assert "expected the number of a run, or `last`, found b03" in capsys.readouterr().err
