"""The files of runs: private, limited in number, and refused when damaged."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from meshctl.errors import MeshctlError
from meshctl.fleet import run_files
from meshctl.fleet.run_files import BEFORE, CHANGES, RunFiles


@pytest.fixture
def files(tmp_path: Path) -> RunFiles:
    return RunFiles(tmp_path / "journal.sqlite")


def test_saved_files_round_trip_and_are_readable_only_by_the_owner(files: RunFiles) -> None:
    files.save(3, BEFORE, {"b01": {"files": []}})
    assert files.load(3, BEFORE) == {"b01": {"files": []}}
    (file,) = (files.root / "3").iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert files.load(3, CHANGES) is None


def test_only_the_latest_runs_keep_their_previous_state(files: RunFiles, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_files, "MAX_BEFORE", 2)
    for run in (1, 2, 3):
        files.save(run, CHANGES, {"b01": []})
        files.save(run, BEFORE, {"b01": {}})
        os.utime(files.root / str(run) / f"{BEFORE}.json.gz", (run, run))
    files.save(4, BEFORE, {"b01": {}})
    assert [files.load(run, BEFORE) is not None for run in (1, 2, 3, 4)] == [False, False, True, True]
    assert files.load(1, CHANGES) == {"b01": []}


def test_a_run_of_a_new_journal_does_not_inherit_files_of_its_number(files: RunFiles) -> None:
    files.save(1, BEFORE, {"b01": {}})
    files.discard(1)
    assert files.load(1, BEFORE) is None


def test_a_damaged_file_is_an_error_that_names_it(files: RunFiles) -> None:
    files.save(1, BEFORE, {"b01": {}})
    path = files.root / "1" / f"{BEFORE}.json.gz"
    path.write_bytes(path.read_bytes()[:-6])
    with pytest.raises(MeshctlError, match=r"cannot read .*before\.json\.gz"):
        files.load(1, BEFORE)


def test_a_directory_that_cannot_be_written_is_an_error(files: RunFiles) -> None:
    files.root.parent.mkdir(exist_ok=True)
    files.root.write_text("a file in its place")
    with pytest.raises(MeshctlError, match="cannot write"):
        files.save(1, BEFORE, {})
