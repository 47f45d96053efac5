"""`meshctl --install-completion` adds a line to the shell's start file, or leaves it as it is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

RC = b"# mine\n" * 1000


def install(home: Path, limit: str = "unlimited") -> subprocess.CompletedProcess[str]:
    """`limit` is the maximum size of a file, in KiB: like a full disk, a write fails in the middle."""
    environment = {"PATH": os.environ["PATH"], "HOME": str(home), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    command = [sys.executable, "-m", "meshctl", "--install-completion", "bash"]
    return subprocess.run(
        ["bash", "-c", f'ulimit -f {limit} && exec "$@"', "bash", *command],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_completion_is_installed(tmp_path: Path) -> None:
    (tmp_path / ".bashrc").write_bytes(RC)
    assert install(tmp_path).returncode == 0
    assert (tmp_path / ".bashrc").read_bytes().startswith(RC)
    assert "meshctl" in (tmp_path / ".bash_completions/meshctl.sh").read_text()


@pytest.mark.parametrize(
    ("content", "limit", "reason"),
    [(RC, "4", "File too large"), (b"# M\xfchle\n", "unlimited", "is not in the encoding of your locale")],
)
def test_a_start_file_that_cannot_be_changed_stays_as_it_is(
    content: bytes, limit: str, reason: str, tmp_path: Path
) -> None:
    (tmp_path / ".bashrc").write_bytes(content)
    done = install(tmp_path, limit)
    assert done.returncode == 2
    assert done.stderr.startswith("error: cannot install the completion: ")
    assert reason in done.stderr
    assert "hint: print the completion with `meshctl --show-completion`" in done.stderr
    assert (tmp_path / ".bashrc").read_bytes() == content
