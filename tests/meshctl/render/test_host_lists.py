"""Other tools read what is exported for them."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from meshctl.model import SshSettings
from meshctl.render.host_lists import HostEntry, ansible_inventory

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "inventory" / "subt-final"


def inventory(command: str, *options: str) -> str:
    """The output of `meshctl inventory` for the example."""
    done = subprocess.run(
        [sys.executable, "-m", "meshctl", "inventory", command, "-i", str(EXAMPLE), *options],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def parsed(name: str, file: Path) -> dict[str, str]:
    """What OpenSSH makes of it."""
    done = subprocess.run(["ssh", "-F", str(file), "-G", name], capture_output=True, text=True, check=True)
    return dict(line.split(" ", 1) for line in done.stdout.splitlines() if " " in line)


def test_openssh_reads_the_configuration(tmp_path: Path) -> None:
    file = tmp_path / "ssh_config"
    inventory("export", "--out", str(file))
    names = [line.split()[1] for line in file.read_text().splitlines() if line.startswith("Host ")]
    for node in json.loads(inventory("list", "--json"))["nodes"]:
        if node["state"] not in ("lost", "retired"):
            seen = parsed(node["name"], file)
            assert (seen["hostname"], seen["user"]) == (node["address"].partition("/")[0], "root")
            assert seen["hostkeyalias"] == node["name"]
            assert seen["userknownhostsfile"] == str(EXAMPLE / "known_hosts")
    robots = [name for name in names if name.startswith("robot.")]
    assert robots
    assert parsed(robots[0], file)["hostkeyalias"] == robots[0]


def test_the_ansible_inventory_lists_every_host_with_its_address_once() -> None:
    children = json.loads(inventory("export", "--format", "ansible"))["all"]["children"]
    assert {"openwrt", "computers", "role_base", "role_beacon", "role_robot"} <= set(children)
    for name, host in children["openwrt"]["hosts"].items():
        assert host["ansible_host"]
        assert f"HostKeyAlias={name}" in host["ansible_ssh_common_args"]
        assert host["ansible_ssh_use_tty"] is False
    assert all(host == {} for host in children["role_beacon"]["hosts"].values())


def test_ansible_logs_in_like_openssh() -> None:
    """With every private key, and on 19.07 with its only signature algorithm."""
    ssh = SshSettings(key_files=("ed25519", "rsa"))
    entry = HostEntry("u01", "u01", "10.60.0.1", ssh, (), is_openwrt=True, has_sha1_rsa_only=True)
    text = ansible_inventory([entry], Path("known_hosts"), Path)
    host = json.loads(text)["all"]["children"]["openwrt"]["hosts"]["u01"]
    assert host["ansible_ssh_private_key_file"] == "ed25519"
    options = ("IdentityFile=rsa", "HostKeyAlgorithms=+ssh-rsa", "PubkeyAcceptedAlgorithms=+ssh-rsa")
    assert {f"-o {option}" for option in options} <= set(
        host["ansible_ssh_common_args"].replace(" -o", "\n-o").split("\n")
    )


def test_ansible_reaches_a_jump_host_by_its_address_and_not_by_its_name() -> None:
    gate = HostEntry("gate", "gate", "fe80::1%eth0", SshSettings(user="root", port=2222), (), is_openwrt=True)
    far = HostEntry("far", "far", "fd42:10::1", SshSettings(user="root", jump="gate"), (), is_openwrt=True)
    behind = HostEntry("behind", "behind", "fd42:20::1", SshSettings(user="root", jump="far"), (), is_openwrt=True)
    text = ansible_inventory([gate, far, behind], Path("/fleet/known_hosts"), Path)
    options = json.loads(text)["all"]["children"]["openwrt"]["hosts"]["behind"]["ansible_ssh_common_args"]
    seen = subprocess.run(["ssh", "-G", *shlex.split(options), "b"], capture_output=True, text=True, check=True).stdout
    (command,) = (line.partition(" ")[2] for line in seen.splitlines() if line.startswith("proxycommand "))
    words = shlex.split(command)
    assert words[-3:] == ["-W", "[%h]:%p", "root@fd42:10::1"]
    # ssh expands the outer command once before it runs it
    (inner,) = (word.removeprefix("ProxyCommand=") for word in words if word.startswith("ProxyCommand="))
    assert shlex.split(inner.replace("%%", "%"))[-3:] == ["-W", "[%h]:%p", "root@fe80::1%%eth0"]


def test_ansible_gives_ssh_a_path_with_a_blank_as_one() -> None:
    """Before, ssh read two names of files that are not there, and knew no host."""
    entry = HostEntry("u", "u", "10.60.0.1", SshSettings(key_files=("ed25519", "rsa")), (), is_openwrt=True)
    text = ansible_inventory([entry], Path("/my fleet/known_hosts"), lambda name: Path("/my fleet") / name)
    # Ansible splits the arguments with this function
    words = shlex.split(json.loads(text)["all"]["children"]["openwrt"]["hosts"]["u"]["ansible_ssh_common_args"])
    assert 'UserKnownHostsFile="/my fleet/known_hosts"' in words
    done = subprocess.run(["ssh", "-F", "none", *words, "-G", "u"], capture_output=True, text=True, check=True)
    assert "identityfile /my fleet/rsa" in done.stdout.splitlines()


@pytest.mark.parametrize("kind", ["ssh-config", "ansible"])
def test_a_file_that_cannot_be_written_is_an_error(kind: str, tmp_path: Path) -> None:
    absent = tmp_path / "absent" / "file"
    with pytest.raises(subprocess.CalledProcessError) as caught:
        inventory("export", "--format", kind, "--out", str(absent))
    assert caught.value.returncode == 2
    assert f"cannot write {absent}: No such file or directory" in caught.value.stderr
