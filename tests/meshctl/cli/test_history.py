"""Past runs: column headings, and runs of different fleets kept apart."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from meshctl.cli.journaled_run import retry_hint
from meshctl.cli.main import main
from meshctl.errors import InputError
from meshctl.fleet import Outcome, Result
from meshctl.fleet.journal import Journal
from meshctl.fleet.run_files import CHANGES, RunFiles


@pytest.fixture
def journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    path = tmp_path / "meshctl" / "journal.sqlite"
    with Journal(path) as field, Journal(path, lab="/lab") as lab:
        for place, fleet in ((field, "mine"), (lab, "mine"), (field, "ruins"), (field, "mine")):
            run = place.begin("provision", fleet=fleet, inventory="/x", nodes=("b01",))
            run.finish_node(Outcome("b01", Result.DONE))
            run.end("1 done")


def said(capfd: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["history", *words])
    assert ended.value.code == 0
    return capfd.readouterr().out


@pytest.mark.usefixtures("journal")
def test_runs_are_listed_newest_first_below_a_header(capfd: pytest.CaptureFixture[str]) -> None:
    lines = said(capfd).splitlines()
    assert lines[0].split() == ["RUN", "STARTED", "COMMAND", "FLEET", "BY", "RESULT"]
    assert [line.split()[0] for line in lines[1:]] == ["4", "3", "2", "1"]
    assert "mine (lab)" in lines[3]


def test_a_run_is_wrapped_at_the_width_of_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with Journal(tmp_path / "meshctl" / "journal.sqlite") as journal:
        run = journal.begin("provision", fleet="mine", inventory="/x", nodes=("b01",))
        reason = "unreachable at its new address, so that it returned to its previous state by itself"
        with pytest.raises(InputError, match="reset"), run.step("b01", "apply"):
            raise InputError("b01 ([127.42.0.103]:20023): connection reset by peer during a command")
        run.finish_node(Outcome("b01", Result.ROLLED_BACK, reason))
        run.end("1 rolled back")
    monkeypatch.setenv("COLUMNS", "40")
    narrow = said(capfd, "1").splitlines()
    assert len(narrow) > 4
    assert max(map(len, narrow)) <= 40
    monkeypatch.delenv("COLUMNS")
    assert f"b01: rolled back: {reason}" in said(capfd, "1").splitlines()


def test_what_a_run_did_not_change_is_not_called_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    diff = "--- a\n+++ b\n@@ -1 +1 @@\n-config radio\n+config wifi-device\n"
    with Journal(tmp_path / "meshctl" / "journal.sqlite") as journal:
        run = journal.begin("provision", fleet="mine", inventory="/x", nodes=("b01", "b02", "b03"))
        change = ("etc/config/wireless", "changed", diff)
        RunFiles(journal.path).save(run.id, CHANGES, {name: [change] for name in ("b01", "b02", "b03")})
        for name, result in (("b01", Result.DONE), ("b02", Result.ROLLED_BACK), ("b03", Result.REFUSED)):
            run.finish_node(Outcome(name, result))
        run.end("1 done, 1 rolled back, 1 refused")
    lines = [line.partition("/etc/config/wireless")[0].strip() for line in said(capfd, "1").splitlines()]
    kept = ["b01: done", "changed", "b02: rolled back", "rolled back: changed"]
    assert lines[2:] == [*kept, "b03: refused", "planned: changed"]


@pytest.mark.usefixtures("journal")
def test_the_last_run_is_the_first_of_those_that_are_listed(capfd: pytest.CaptureFixture[str]) -> None:
    assert said(capfd, "last").startswith("run 4: provision of mine ")
    assert said(capfd, "last", "--fleet", "ruins").startswith("run 3: ")
    assert said(capfd, "last", "--virtual").startswith("run 2: provision of mine (lab) ")
    assert json.loads(said(capfd, "last", "--json"))["run"] == 4
    with pytest.raises(SystemExit):
        main(["history", "last", "--node", "b77"])
    assert "error: there is no run of b77" in capfd.readouterr().err


@pytest.mark.usefixtures("journal")
def test_the_runs_of_a_node_are_grouped_by_fleet(capfd: pytest.CaptureFixture[str]) -> None:
    text = said(capfd, "--node", "b01")
    blocks = [block.splitlines() for block in text.split("\n\n")]
    assert [block[0] for block in blocks] == ["b01 of mine", "b01 of ruins", "b01 of mine (lab)"]
    assert [line.split()[0] for line in blocks[0] if line.strip()[:1].isdigit()] == ["4", "1"]
    assert "b01: done" in blocks[2][-1]


@pytest.mark.usefixtures("journal")
@pytest.mark.parametrize(
    ("words", "runs"),
    [
        (("--fleet", "mine"), [4, 2, 1]),
        (("--fleet", "mine", "--real"), [4, 1]),
        (("--virtual",), [2]),
        (("--fleet", "ruins", "--node", "b01"), [3]),
        (("--real", "--limit", "2"), [4, 3]),
    ],
)
def test_runs_are_filtered_by_fleet_and_by_real_or_virtual(
    capfd: pytest.CaptureFixture[str], words: tuple[str, ...], runs: list[int]
) -> None:
    listed = json.loads(said(capfd, *words, "--json"))
    assert [run["run"] for run in listed] == runs
    assert {run["lab"] for run in listed} <= {"", "/lab"}


@pytest.mark.usefixtures("journal")
def test_a_pattern_selects_the_runs_of_its_nodes(capfd: pytest.CaptureFixture[str]) -> None:
    assert said(capfd, "--node", "b0*").count("b01: done") == 4
    assert said(capfd, "1", "--node", "b?1").count("b01: done") == 1
    others = "the journal has runs of mine, ruins\n"
    assert said(capfd, "--node", "rover*") == f"no runs of rover* yet\n{others}"
    assert said(capfd, "--fleet", "mien", "--real") == f"no runs of fleet mien on real nodes yet\n{others}"
    with pytest.raises(SystemExit) as ended:
        main(["history", "--node", "role:beacon"])
    assert ended.value.code == 2
    assert "expected a name or a pattern" in capfd.readouterr().err


def test_the_command_for_what_a_run_left_is_one_that_takes_the_run_up() -> None:
    assert retry_hint("provision") == "run `meshctl resume`"
    # `meshctl resume` refuses these
    assert retry_hint("rollback", undoes=4) == "run `meshctl rollback 4`"
    # it uses the inventory's addresses, which devices do not have before their first change is confirmed
    assert retry_hint("bootstrap") == "repeat the same `meshctl bootstrap`"
    assert retry_hint("restore") == "repeat the same `meshctl restore`"


@pytest.mark.usefixtures("journal")
def test_the_runs_of_a_lab_are_those_of_this_computer_where_operators_share_a_journal(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    # opening it would fail
    monkeypatch.setenv("MESHCTL_STORE", "not the URL of a database")
    assert [run["run"] for run in json.loads(said(capfd, "--virtual", "--json"))] == [2]
    monkeypatch.setenv("MESHCTL_LAB", "/lab")
    assert "b01: done" in said(capfd, "2")
    for words in (["--real"], ["--real", "1"]):
        with pytest.raises(SystemExit) as ended:
            main(["history", *words])
        assert ended.value.code == 2
        assert "MESHCTL_STORE: expected postgresql://" in capfd.readouterr().err


def test_a_journal_that_cannot_be_looked_up_is_not_called_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert said(capfd) == "no runs yet\n"
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "loop"))
    with pytest.raises(SystemExit) as ended:
        main(["history"])
    output = capfd.readouterr()
    assert (ended.value.code, output.out) == (2, "")
    assert "cannot open the journal" in output.err
