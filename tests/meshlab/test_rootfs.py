"""The shell of process 1 where the host's busybox hangs in a `read` after a signal, as 1.38.0 does."""

import subprocess
from pathlib import Path

import pytest

from meshlab import rootfs

HANGING = """#!/bin/sh
# `ash -c "ulimit -t 1; ..."`: keeps the limit, then uses the processor for ever
eval "${3%%;*}"
while :; do :; done
"""


@pytest.fixture(scope="module")
def hanging(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("hanging") / "busybox"
    path.write_text(HANGING)
    path.chmod(0o755)
    return path


def test_a_busybox_that_hangs_is_recognized(hanging: Path) -> None:
    assert rootfs.hangs_in_read(hanging)


def test_dash_runs_process_1_in_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rootfs, "hangs_in_read", lambda _: True)
    rootfs.build(tmp_path / "rom")
    shell = tmp_path / "rom" / Path(rootfs.INIT_SHELL).relative_to("/rom")
    # as in lab/init: the signal ends one `read`, and the next one waits for a message
    script = "trap 'echo caught' USR1; kill -USR1 $$; read -r message; echo \"got $message\""
    done = subprocess.run(
        [shell, "-c", script], input="hello\n", capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stdout == "caught\ngot hello\n"


def test_where_it_does_not_hang_its_own_shell_does(tmp_path: Path) -> None:
    busybox = rootfs.find_program("busybox", "busybox-static")
    rootfs.build(tmp_path / "rom")
    assert (tmp_path / "rom" / "lab" / "init-shell").exists() == rootfs.hangs_in_read(busybox)
