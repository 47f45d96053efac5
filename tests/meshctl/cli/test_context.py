"""What opens a session says, and the exit code of a run."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from meshctl.cli import context
from meshctl.cli.context import exit_for, lab_at, session
from meshctl.diagnostics import InvalidInput
from meshctl.errors import ExitCode
from meshctl.fleet import Interrupt, Outcome, Result
from meshctl.fleet.lab_directory import INVENTORY, MARK
from meshctl.inventory.starter import write_starter


@pytest.mark.parametrize(
    ("results", "code"),
    [
        ((), ExitCode.OK),
        ((Result.DONE, Result.UNCHANGED), ExitCode.OK),
        ((Result.DONE, Result.UNREACHABLE), ExitCode.UNREACHABLE),
        ((Result.REFUSED,), ExitCode.FINDINGS),
        ((Result.FAILED, Result.UNREACHABLE), ExitCode.FINDINGS),
    ],
)
def test_any_failure_other_than_unreachable_nodes_exits_with_findings(
    results: tuple[Result, ...], code: ExitCode
) -> None:
    assert exit_for([Outcome("b03", result) for result in results], Interrupt()) is code


def test_an_interrupted_run_has_its_own_exit_code_whatever_its_outcomes() -> None:
    interrupt = Interrupt()
    interrupt.request()
    assert exit_for([Outcome("b03", Result.FAILED)], interrupt) is ExitCode.INTERRUPTED


@pytest.fixture
def of_lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The inventory of a lab."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    write_starter(tmp_path / "lab" / INVENTORY)
    (tmp_path / "lab" / MARK).touch()
    return tmp_path / "lab" / INVENTORY


def test_a_lab_s_inventory_without_its_lab_is_noted(of_lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with session(of_lab):
        pass
    lab = of_lab.parent
    assert capsys.readouterr() == (
        "",
        f"note: the inventory is that of the lab in {lab}, but its addresses are used as those of real devices: "
        f"set MESHCTL_LAB={lab} to reach the lab\n",
    )


def test_another_inventory_than_that_of_the_lab_is_noted(
    of_lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its names would stand for other nodes of the lab, which have the same addresses."""
    lab = of_lab.parent
    monkeypatch.setattr(context, "attach_lab", lambda directory: SimpleNamespace(directory=directory))
    assert lab_at(lab, of_lab)[1] == lab_at(lab, of_lab / "fleet.yaml")[1] == str(lab)
    assert capsys.readouterr() == ("", "")
    write_starter(lab.parent / "fleet")
    lab_at(lab, lab.parent / "fleet")
    assert capsys.readouterr().err == (
        f"note: {lab.parent}/fleet is not the inventory of the lab in {lab}, whose nodes may have other names at the "
        f"same addresses: use -i {of_lab}, or run `meshctl lab up` for this inventory\n"
    )


def test_an_inventory_of_real_devices_is_opened_silently(of_lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    real = of_lab.parent.parent / "fleet"
    of_lab.rename(real)
    with session(real):
        pass
    assert capsys.readouterr() == ("", "")


def test_a_missing_inventory_names_the_searched_directory(tmp_path: Path) -> None:
    expected = f"expected in {tmp_path}: name another with `--inventory`, or write"
    with pytest.raises(InvalidInput, match=expected), session(tmp_path):
        pass
