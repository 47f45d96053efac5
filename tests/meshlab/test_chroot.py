"""A fleet in a chroot works where the chroot's directory is a mount point; elsewhere, the error says to make it one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

_MOUNT_POINT = 'mount --rbind / "$root"'
_DIRECTORY = """
for path in /*; do
    if [ -L "$path" ]; then cp -P "$path" "$root/"
    elif [ -d "$path" ]; then mkdir "$root$path" && mount --rbind "$path" "$root$path"; fi
done
"""
_COMMANDS = """
set -e
root=$1 lab=$2 python=$3
mount --make-rprivate /
{enter}
meshctl() {{ chroot "$root" "$python" -m meshctl "$@"; }}
trap 'meshctl lab down --dir "$lab"' EXIT
meshctl lab up --nodes 1 --dir "$lab"
meshctl lab break base full-flash --dir "$lab"
meshctl lab shell base --dir "$lab" 'df /lab/node/flash; cat /etc/openwrt_release'
"""


def in_a_chroot(tmp_path: Path, enter: str) -> subprocess.CompletedProcess[str]:
    root = tmp_path / "root"
    root.mkdir()
    become_root = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    script = _COMMANDS.format(enter=enter)
    arguments = [str(root), str(tmp_path / "lab"), sys.executable]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = ["unshare", "--mount", *become_root, "sh", "-c", script, "sh", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)


def test_a_fleet_runs_in_a_chroot_that_is_a_mount_point(tmp_path: Path) -> None:
    done = in_a_chroot(tmp_path, _MOUNT_POINT)
    assert done.returncode == 0, done.stderr
    assert "DISTRIB_RELEASE" in done.stdout
    assert "lab is down" in done.stdout


def test_a_chroot_that_is_no_mount_point_is_named(tmp_path: Path) -> None:
    done = in_a_chroot(tmp_path, _DIRECTORY)
    assert done.returncode == 2
    assert "is not a mount point (a chroot?): run `mount --bind DIR DIR` before `chroot DIR`" in done.stderr
