"""Output: files that options such as `--out` name, and a reader that is gone."""

from __future__ import annotations

import io
import os
import resource
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from meshctl.cli.main import _guarded
from meshctl.cli.output import echo, echo_error, write_file
from meshctl.errors import InputError
from meshctl.inventory.starter import write_starter


@pytest.fixture
def _full_disk() -> Iterator[None]:
    """A limit on files' sizes fails a write in its middle, as a full disk does."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.usefixtures("_full_disk")
@pytest.mark.parametrize(
    "key", ["", "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIFCutyt+xTdKa5I6TRfbIza4ho4hbhlYM4e+/swgNX9L me"]
)
def test_a_full_disk_leaves_no_part_of_a_starter_inventory(tmp_path: Path, key: str) -> None:
    """The part was an inventory with errors, and the next `init` refused to overwrite it."""
    with pytest.raises(InputError, match="cannot be written: File too large"):
        write_starter(tmp_path / "fleet", key)
    assert not list((tmp_path / "fleet").iterdir())


@pytest.mark.usefixtures("_full_disk")
def test_a_full_disk_leaves_the_earlier_file(tmp_path: Path) -> None:
    file = tmp_path / "baseline.json"
    file.write_text("accepted findings", encoding="utf-8")
    for target in (file, tmp_path / "new.json"):
        with pytest.raises(InputError, match=f"cannot write {target}: File too large"):
            write_file(target, "x" * 8192)
    assert [path.name for path in tmp_path.iterdir()] == ["baseline.json"]
    assert file.read_text(encoding="utf-8") == "accepted findings"


def test_a_file_keeps_its_mode_and_its_link(tmp_path: Path) -> None:
    file, link = tmp_path / "plan.json", tmp_path / "link"
    link.symlink_to(file)
    file.write_text("old", encoding="utf-8")
    file.chmod(0o640)
    write_file(link, "new")
    assert (file.read_text(encoding="utf-8"), file.stat().st_mode & 0o777) == ("new", 0o640)
    assert link.is_symlink()


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    heard: list[str] = []
    reader = threading.Thread(target=lambda: heard.append(pipe.read_text(encoding="utf-8")))
    reader.start()
    write_file(pipe, "for another program")
    reader.join()
    assert heard == ["for another program"]
    assert pipe.is_fifo()


@pytest.mark.parametrize("written", ["echo('line')", "echo_json('{}')", "echo_bytes(b'x')", "console().print('line')"])
@pytest.mark.parametrize("yes", [True, False])
def test_only_a_command_that_changes_something_outlives_its_reader(written: str, yes: bool) -> None:
    """`provision --yes | head` made no run and said nothing: rich ended the process with 1."""
    program = f"""
import sys
from contextlib import nullcontext
from meshctl.cli.output import console, echo, echo_bytes, echo_json, outlive_reader
with outlive_reader() if {yes} else nullcontext():
    {written}
    sys.stdout.flush()
    {written}
    sys.stderr.write("the run")
"""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", program], stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert ("the run" in done.stderr) == yes
    assert ("BrokenPipeError" in done.stderr) == (not yes)


def test_an_option_yes_makes_a_command_outlive_its_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[object] = []

    def command(*, yes: bool) -> None:
        echo("plan")
        calls.append(yes)

    def broken(*_args: object, **_options: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr("typer.echo", broken)
    monkeypatch.setattr("meshctl.cli.output.discard_output", lambda: None)
    guarded = _guarded(command)
    guarded(yes=True)
    assert calls == [True]
    with pytest.raises(typer.Exit):
        guarded(yes=False)
    assert calls == [True]


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_message_is_wrapped_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "error: crane02 still answers at 10.60.0.12: two nodes must not have the same address\nhint: turn it off"
    monkeypatch.setenv("COLUMNS", "40")
    shown = []
    for stream in (_Terminal(), io.StringIO()):
        monkeypatch.setattr(sys, "stderr", stream)
        echo_error(text)
        shown.append(stream.getvalue())
    assert max(map(len, shown[0].splitlines())) <= 40
    assert " ".join(shown[0].split()) == " ".join(text.split())
    assert shown[1] == f"{text}\n"
