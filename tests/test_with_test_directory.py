"""scripts/with-test-directory: where `make test` writes, and what it leaves there."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[1] / "scripts/with-test-directory"
MEMORY = Path("/dev/shm")


def _run(command: str, **environ: str) -> subprocess.CompletedProcess[str]:
    without = {name: text for name, text in os.environ.items() if name != "TMPDIR"}
    return subprocess.run(
        [SCRIPT, "sh", "-c", command], env={**without, **environ}, capture_output=True, text=True, check=False
    )


def test_a_directory_that_is_set_is_used_and_kept(tmp_path: Path) -> None:
    ended = _run('echo "$TMPDIR"; exit 3', TMPDIR=str(tmp_path))
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, f"{tmp_path}\n", "")
    assert tmp_path.exists()


def test_programs_run_in_the_directory_which_is_deleted_after_success() -> None:
    program = 'printf "#!/bin/sh\\necho ran" >"$D/p" && chmod +x "$D/p" && "$D/p"'
    ended = _run(f'echo "${{TMPDIR:-}}"; D=${{TMPDIR:-$(mktemp -d)}}; {program}; [ "${{TMPDIR:-}}" ] || rm -r "$D"')
    directory, said = ended.stdout.splitlines()
    assert (ended.returncode, said, ended.stderr) == (0, "ran", "")
    if directory:
        assert Path(directory).parent == MEMORY
        assert not Path(directory).exists()


def test_after_a_failure_the_files_stay_and_the_command_says_where() -> None:
    ended = _run('echo "${TMPDIR:-}"; exit 5')
    directory = ended.stdout.removesuffix("\n")
    assert ended.returncode == 5
    if directory:
        assert f"delete {directory} " in ended.stderr
        Path(directory).rmdir()
