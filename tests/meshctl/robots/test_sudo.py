"""Deploying as a user who is not root, through the real sudo, fetched as a Debian package and laid over /usr."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.meshctl.device.servers import PATIENCE_S
from tests.meshctl.robots.fleets import RobotFleet
from tests.meshctl.robots.machine import Machine

_PASSWORD = "two words"


def _sudo(directory: Path) -> Path:
    """A directory with Debian's sudo in it, as it belongs into /usr."""
    directory.mkdir()
    subprocess.run(["apt-get", "download", "sudo"], cwd=directory, check=True, capture_output=True, timeout=PATIENCE_S)
    (package,) = directory.glob("sudo_*.deb")
    subprocess.run(["dpkg", "-x", package, directory / "root"], check=True, timeout=PATIENCE_S)
    (directory / "root/usr/bin/sudo").chmod(0o4755)
    return directory / "root/usr"


def _give_user(machine: Machine, usr: Path, rule: str) -> None:
    """A user `robot` with the operator's key, who may use sudo by this rule."""
    machine.overlay = usr
    etc = machine.root / "etc"
    for name in ("pam.d", "security"):
        shutil.copytree(Path("/etc", name), etc / name, symlinks=True)
    made = subprocess.run(["openssl", "passwd", "-6", _PASSWORD], capture_output=True, text=True, check=True)
    for name, line in (
        ("passwd", "robot:x:1500:1500::/tmp:/bin/sh"),
        ("group", "robot:x:1500:"),
        ("shadow", f"robot:{made.stdout.strip()}:19000:0:99999:7:::"),
    ):
        with (etc / name).open("a") as file:
            file.write(f"{line}\n")
    path = f"{machine.root}/bin:/usr/sbin:/usr/bin:/sbin:/bin"
    (etc / "sudoers").write_text(f'Defaults secure_path="{path}"\nrobot ALL=(ALL) {rule} ALL\n')
    (etc / "sudoers").chmod(0o440)


@pytest.mark.proof
def test_sudo_serves_with_and_without_a_password_and_a_wrong_one_changes_nothing(
    fleet: RobotFleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usr = _sudo(tmp_path / "sudo")
    for name, rule in (("husky1", "NOPASSWD:"), ("husky2", "")):
        machine = fleet.add(name, start=False)
        _give_user(machine, usr, rule)
        machine.start()
    fleet.write(user="robot")
    monkeypatch.delenv("MESHCTL_SUDO_PASSWORD", raising=False)
    told = fleet.deploy(exit_code=1)
    assert "husky1: done: runs " in told
    assert "sudo wants a password for robot" in told
    monkeypatch.setenv("MESHCTL_SUDO_PASSWORD", "wrong")
    assert "sudo does not let robot become root" in fleet.deploy(exit_code=1)
    assert not any((fleet.machines["husky2"].root / "opt").glob("udp-mesh"))
    monkeypatch.setenv("MESHCTL_SUDO_PASSWORD", _PASSWORD)
    assert "husky2: done: runs " in fleet.deploy()
    assert "2 unchanged" in fleet.deploy()
