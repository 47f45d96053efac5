"""What `sweep` says before hours of work are spent."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from mesh_sweep.cases import Settings
from mesh_sweep.command import Study, SweepOptions, sweep
from mesh_sweep.errors import SweepError
from mesh_sweep.results import Identity
from mesh_sweep.results_file import ResultsFile
from tests.mesh_sweep import sample


def accept(settings: Settings) -> None:
    """Every setting is valid."""


STUDY = Study(Identity("sample", "0" * 64, "1"), sample.double, accept, ("seed",))


@pytest.mark.parametrize(
    ("figures", "goals", "meant"), [(["double"], (), "'doubled'"), (["seed"], ["sed<=3"], "'seed'")]
)
def test_a_figure_that_no_run_has_is_named_after_the_first_run(
    figures: list[str],
    goals: list[str],
    meant: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "results.jsonl"
    options = SweepOptions(
        seeds="4", out=out, figures=figures, goals=goals, executor="tests.mesh_sweep.sample:InlineExecutor"
    )
    with pytest.raises(SweepError, match="expected a figure of these results"):
        sweep(STUDY, options, {})
    (warning,) = (line for line in capsys.readouterr().err.splitlines() if "warning" in line)
    assert warning.startswith("warning: --figure or --goal: expected a figure of these results, found ")
    assert warning.endswith(f"did you mean {meant}? (after the first result; Ctrl-C keeps the results)")
    # the results are there: the right name needs no run
    assert sweep(STUDY, SweepOptions(seeds="4", out=out, figures=["doubled"]), {}) == 0
    assert "warning" not in capsys.readouterr().err


def test_results_that_cannot_be_sorted_are_shown_and_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk has no room for a second copy, or the directory is read-only."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(out))

    out = tmp_path / "results.jsonl"
    monkeypatch.setattr(ResultsFile, "finish", full)
    options = SweepOptions(seeds="3", out=out, figures=["doubled"], executor="tests.mesh_sweep.sample:InlineExecutor")
    assert sweep(STUDY, options, {}) == 0
    printed = capsys.readouterr()
    assert "3 runs of scenario sample" in printed.out
    assert "No space left on device" in printed.err
    assert "all results are there" in printed.err
    assert out.read_bytes().count(b"\n") == 3
