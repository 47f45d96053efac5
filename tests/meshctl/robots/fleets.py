"""An inventory of robots, their machines on a network of their own, and meshctl's own command line over them."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from meshctl.cli.main import build
from meshctl.device.trust import TrustStore
from tests.meshctl.robots.lan import Lan
from tests.meshctl.robots.machine import PYTHON, Machine, key_pair

OLD_KEY, NEW_KEY = "00112233445566778899aabbccddeeff" * 2, "ffeeddccbbaa99887766554433221100" * 2

_INVENTORY = """\
meshctl: 1
fleet: robots-test
country: US
operators: {{ssh_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g test"]}}
hardware:
  rocket:
    board: ubnt,rocket-m
    profile: ubnt_rocket-m
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    radios: {{radio0: {{path: "pci0000:00/0000:00:00.0", band: 2g, rated_power_dbm: 30, max_drive_dbm: 28}}}}
meshes:
  main: {{ssid: fleet, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/24}}
defaults: {{hardware: rocket, state: deployed}}
{sites}nodes:
  base: {{role: base, address: 10.42.0.1{site}}}
apply: {{parallel: {parallel}}}
robots:
{robots}
udp_mesh:
  keys: [{{file: keys.yaml, key: old}}]
  heartbeat_s: 0.2
  offline_after_s: 10
topics:
  estop: {{priority: 0, class: emergency_stop}}
  status: {{priority: 5}}
"""
_ROBOT = """\
  {name}:
    nodes: [{nodes}]
    computer:
      address: {address}/24
      arch: {arch}
      python: {python}
      ros: "{ros}"
      ssh: {{user: {user}, key_files: [operator]{jump}}}
"""


class RobotFleet:
    """`add` robots, then `write` the inventory, then run meshctl's commands on it."""

    def __init__(self, directory: Path, wheels: Path, base: Path, lan: Lan, seed: Path | None = None) -> None:
        """`seed` is what lies over Debian on robots that are not fresh."""
        self.directory = directory
        self.wheels = wheels
        self.key = key_pair(directory / "operator")
        self.file = directory / "fleet.yaml"
        self.machines: dict[str, Machine] = {}
        self.base = base
        self.seed = seed
        self.lan = lan
        (directory / "keys.yaml").write_text(f'old: "{OLD_KEY}"\nnew: "{NEW_KEY}"\n')

    def add(self, name: str, *, opt_kib: int | None = None, start: bool = True, fresh: bool = False) -> Machine:
        """A robot that had an earlier release, so that packages need not travel and be compiled; or a `fresh` one."""
        address = f"10.42.0.{10 + len(self.machines)}"
        seed = None if fresh or opt_kib else self.seed
        machine = Machine(self.base, self.directory / name, self.lan, address, self.key, opt_kib=opt_kib, seed=seed)
        self.machines[name] = machine
        if start:
            machine.start()
        return machine

    def write(
        self,
        *,
        arch: str = "",
        python: str = PYTHON,
        user: str = "root",
        ros: str = "",
        jump: str = "",
        gateway: str = "",
        parallel: int = 8,
    ) -> None:
        """The inventory of all machines, with their host keys pinned; `gateway` is the address of a site's gateway."""
        robots = "".join(
            _ROBOT.format(
                name=name,
                nodes="base" if number == 0 else "",
                address=machine.address,
                arch=arch or _arch(),
                python=python,
                user=user,
                ros=ros,
                jump=f", jump: {jump}" if jump else "",
            )
            for number, (name, machine) in enumerate(self.machines.items())
        )
        sites = (
            f"sites: {{field: {{ssh: {{host: {gateway}, user: root, key_files: [operator]}}}}}}\n" if gateway else ""
        )
        site = ", site: field" if gateway else ""
        self.file.write_text(_INVENTORY.format(robots=robots, parallel=parallel, sites=sites, site=site))
        trust = TrustStore(self.directory / "known_hosts")
        for name, machine in self.machines.items():
            trust.replace(f"robot.{name}", machine.host_key)

    def meshctl(self, *words: str, exit_code: int = 0, wheels: bool = False) -> str:
        """What `meshctl robots WORDS` prints; it must end with this exit code."""
        arguments = ["robots", *words, "-i", str(self.file), *(["--wheels", str(self.wheels)] if wheels else [])]
        done = CliRunner().invoke(build("robots"), arguments, catch_exceptions=False)
        assert done.exit_code == exit_code, done.output
        return done.output

    def root_command(self, *words: str, exit_code: int = 0) -> str:
        """What `meshctl WORDS` prints on this inventory."""
        option = [] if words[0] == "history" else ["-i", str(self.file)]
        done = CliRunner().invoke(build(words[0]), [*words, *option], catch_exceptions=False)
        assert done.exit_code == exit_code, done.output
        return done.output

    def add_topic(self, line: str) -> None:
        """In the inventory alone."""
        self.file.write_text(f"{self.file.read_text()}  {line}\n")

    def refused(self, *words: str) -> str:
        """What a command says that cannot be done as it was asked for."""
        return self.meshctl(*words, exit_code=2)

    def deploy(self, *words: str, exit_code: int = 0) -> str:
        return self.meshctl("deploy", *words, exit_code=exit_code, wheels=True)

    def status(self) -> dict[str, dict[str, Any]]:
        """The output of `meshctl robots status --json`, by robot, whatever its exit code."""
        done = CliRunner().invoke(
            build("robots"), ["robots", "status", "--json", "-i", str(self.file)], catch_exceptions=False
        )
        return {one["robot"]: one for one in json.loads(done.stdout)}

    def shell(self, robot: str, command: str) -> str:
        return self.machines[robot].shell(command, self.directory / "pins")

    def tool(self, robot: str, name: str, text: str) -> None:
        """A program of this name that everyone there finds before Debian's own."""
        path = f"/usr/local/bin/{name}"
        self.shell(robot, f"cat >{path} <<'END'\n{text}END\nchmod 755 {path}")

    def stop(self) -> None:
        for machine in self.machines.values():
            machine.stop()


USER_PASSWORD = "two words"


def give_user(machine: Machine, key: str, rule: str, *, home: str = "/tmp", shell: str = "/bin/sh") -> None:
    """A user `robot` with the operator's key, who may use sudo by this rule."""
    made = subprocess.run(["openssl", "passwd", "-6", USER_PASSWORD], capture_output=True, text=True, check=True)
    machine.append("/etc/passwd", f"robot:x:1500:1500::{home}:{shell}\n")
    machine.append("/etc/group", "robot:x:1500:\n")
    machine.append("/etc/shadow", f"robot:{made.stdout.strip()}:19000:0:99999:7:::\n")
    machine.write("/etc/robot-keys", key)
    machine.write("/etc/ssh/sshd_config.d/robot.conf", "Match User robot\nAuthorizedKeysFile /etc/robot-keys\n")
    if rule:
        machine.write("/etc/sudoers.d/robot", f"robot ALL=(ALL) {rule}\n", 0o440)


def _arch() -> str:
    return os.uname().machine
