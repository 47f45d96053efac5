"""`udp-mesh hosts` on files: the whole file is replaced in one rename, with its mode; other programs' edits survive."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

from tests.udp_mesh.cli.conftest import Run
from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh.cli.hosts import MAX_FILE_BYTES, HostsBlock, _lock
from udp_mesh.cli.hosts_file import BEGIN, HostEntry, MergedHosts, merge
from udp_mesh.cli.main import main

ROOT = Path(__file__).parents[3]
SPOT = HostEntry("spot1", "10.42.0.12")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "hosts"
    path.write_bytes(b"127.0.0.1 localhost\n# \xff is not UTF-8\n")
    path.chmod(0o604)
    return path


def test_writing_the_block_keeps_the_file_mode_and_leaves_no_temporary_file(file: Path) -> None:
    before = file.read_bytes()
    HostsBlock(file).write((SPOT,))
    assert b"10.42.0.12 spot1\n" in file.read_bytes()
    assert file.read_bytes().startswith(before)
    assert file.stat().st_mode & 0o777 == 0o604
    assert list(file.parent.iterdir()) == [file]
    assert main(["hosts", "--remove", str(file)]) == 0
    assert file.read_bytes() == before


def test_an_unchanged_block_does_not_touch_the_file(file: Path) -> None:
    block = HostsBlock(file)
    block.write((SPOT,))
    before = file.stat()
    block.write((SPOT,))
    assert (file.stat().st_ino, file.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_a_symlinked_hosts_file_stays_a_symlink(file: Path) -> None:
    link = file.with_name("link")
    link.symlink_to(file)
    HostsBlock(link).write((SPOT,))
    assert link.is_symlink()
    assert b"spot1" in file.read_bytes()


def test_a_line_added_concurrently_by_another_program_is_kept(file: Path) -> None:
    def merge_while_another_program_writes(text: str, hosts: Iterable[HostEntry]) -> MergedHosts:
        if "printer" not in text:
            other = file.with_name("new")
            other.write_bytes(file.read_bytes() + b"10.9.9.9 printer\n")
            other.replace(file)
        return merge(text, hosts)

    HostsBlock(file, merge_while_another_program_writes).write((SPOT,))
    assert b"10.9.9.9 printer\n" in file.read_bytes()
    assert b"10.42.0.12 spot1\n" in file.read_bytes()


def test_a_bind_mounted_file_is_written_in_place(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(self: Path, target: Path) -> Path:
        raise OSError(16, os.strerror(16), str(target))

    monkeypatch.setattr(Path, "replace", busy)
    inode = file.stat().st_ino
    HostsBlock(file).write((SPOT,))
    assert b"10.42.0.12 spot1\n" in file.read_bytes()
    assert file.stat().st_ino == inode
    assert list(file.parent.iterdir()) == [file]


def test_a_conflict_is_reported_once(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    block = HostsBlock(file)
    local = HostEntry("localhost", "10.42.0.9")
    assert block.write((local, SPOT)) == (local,)
    block.write((local, SPOT))
    error = capsys.readouterr().err
    assert error.count("another line defines localhost; 10.42.0.9 is left out") == 1
    assert block.hosts == (SPOT,)


def test_a_second_writer_is_refused(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = file.read_bytes()
    first = _lock(file)
    try:
        assert main(["hosts", "--write", str(file)]) == 1
    finally:
        os.close(first)
    assert f"{file}: another `udp-mesh hosts --write` keeps its names there" in capsys.readouterr().err
    assert file.read_bytes() == before
    os.close(_lock(file))


def test_a_daemon_that_does_not_answer_is_reported_once(file: Path) -> None:
    words = ["hosts", "--socket", str(file.with_name("none.sock")), "--write", str(file)]
    process = subprocess.Popen(
        [sys.executable, "-m", "udp_mesh.cli.main", *words], stderr=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stderr is not None
    line = process.stderr.readline()
    process.terminate()
    assert process.communicate(timeout=WAIT_S)[1] == ""
    assert "cannot connect to the daemon at" in line
    assert f"{file} has no peers until the daemon answers" in line
    assert process.returncode == 0


def test_a_missing_or_oversized_file_is_refused_with_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = tmp_path / "none"
    assert main(["hosts", "--write", str(missing)]) == 1
    assert f"{missing}: No such file or directory" in capsys.readouterr().err
    large = tmp_path / "large"
    large.write_bytes(b"#" * (MAX_FILE_BYTES + 1))
    assert main(["hosts", "--remove", str(large)]) == 1
    assert f"{large}: expected at most" in capsys.readouterr().err
    assert BEGIN.encode() not in large.read_bytes()


def test_the_peers_of_a_running_daemon_are_printed(run: Run) -> None:
    code, output, _ = run("hosts", "--json")
    assert code == 0
    assert '"hosts": []' in output, "the test's daemons have loopback addresses, which no other computer can reach"
