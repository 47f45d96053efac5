"""Fixtures that the workers of a run share are made once, and again after a failure."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest

from tests.made_once import made_once


def test_one_of_two_makes_it_and_the_other_waits(tmp_path_factory: pytest.TempPathFactory) -> None:
    begun, go_on = Event(), Event()

    def make(directory: Path) -> None:
        assert not begun.is_set(), "it is made a second time"
        begun.set()
        assert go_on.wait(60)
        (directory / "file").write_text("whole")

    with ThreadPoolExecutor(2) as pool:
        one = pool.submit(made_once, tmp_path_factory, f"shared-{id(begun)}", make)
        assert begun.wait(60)
        other = pool.submit(made_once, tmp_path_factory, f"shared-{id(begun)}", make)
        go_on.set()
        assert one.result(60) == other.result(60)
    assert (one.result() / "file").read_text() == "whole"


def test_what_was_not_completed_is_made_again(tmp_path_factory: pytest.TempPathFactory) -> None:
    def fail(directory: Path) -> None:
        (directory / "torn").write_text("")
        raise OSError("no space")

    name = f"again-{id(fail)}"
    with pytest.raises(OSError, match="no space"):
        made_once(tmp_path_factory, name, fail)
    made = made_once(tmp_path_factory, name, lambda directory: (directory / "file").touch())
    assert [path.name for path in made.iterdir()] == ["file"]
