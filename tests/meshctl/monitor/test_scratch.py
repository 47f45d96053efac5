"""Temporary directories: an ended process removes its own, the next one that of a killed process; nothing else is
removed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from meshctl.monitor.scratch import MARK, PREFIX, remove_leftovers, scratch_directory

# short sleeps: a signal that comes right before a long one would be handled after it
HOLD = """
import signal, sys, time
# as in a terminal, also if the tests themselves run under nohup
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from pathlib import Path
from meshctl.monitor.scratch import scratch_directory
with scratch_directory(Path(sys.argv[1])) as directory:
    (directory / "page").write_text("unfinished")
    print(directory, flush=True)
    while True:
        time.sleep(0.1)
"""


@contextmanager
def holder(parent: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A process that has a scratch directory."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(parent)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process, Path(process.stdout.readline().strip())
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_process_that_a_signal_ends_leaves_nothing(tmp_path: Path, number: signal.Signals) -> None:
    with holder(tmp_path) as (process, directory):
        assert (directory / "page").exists()
        process.send_signal(number)
        # as a program without a handler would end
        assert process.wait(60) == -number
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_removed_by_the_next(tmp_path: Path) -> None:
    with holder(tmp_path) as (process, left):
        process.kill()
        process.wait(60)
    assert (left / "page").exists()
    with scratch_directory(tmp_path) as directory:
        assert list(tmp_path.iterdir()) == [directory]
    assert list(tmp_path.iterdir()) == []


def test_the_directory_of_a_running_process_stays(tmp_path: Path) -> None:
    with holder(tmp_path) as (_, used):
        with scratch_directory(tmp_path) as directory:
            assert sorted(tmp_path.iterdir()) == sorted((used, directory))
        assert (used / "page").exists()


def test_what_is_not_of_meshctl_stays(tmp_path: Path) -> None:
    foreign = tmp_path / f"{PREFIX}notes"
    foreign.mkdir()
    (foreign / "page").write_text("mine")
    file = tmp_path / f"{PREFIX}file"
    file.write_text("mine")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / MARK).touch()
    link = tmp_path / f"{PREFIX}link"
    link.symlink_to(elsewhere)
    # killed before it wrote its mark
    (tmp_path / f"{PREFIX}begun").mkdir()
    remove_leftovers(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted((foreign, file, elsewhere, link))
    assert (elsewhere / MARK).exists()
    assert (foreign / "page").exists()


def test_a_directory_of_another_user_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = tmp_path / f"{PREFIX}other"
    other.mkdir()
    (other / MARK).touch()
    myself = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: myself + 1)
    remove_leftovers(tmp_path)
    assert other.exists()


def test_the_handlers_of_signals_are_as_before(tmp_path: Path) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    with pytest.raises(KeyboardInterrupt), scratch_directory(tmp_path):
        raise KeyboardInterrupt
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == set()
    assert list(tmp_path.iterdir()) == []


def test_a_directory_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"), scratch_directory(tmp_path / "none"):
        pass
