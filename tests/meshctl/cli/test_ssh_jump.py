"""`meshctl ssh` through a jump host, as OpenSSH reads it."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import cast

from meshctl.cli.context import Session
from meshctl.cli.ssh import ssh_arguments
from meshctl.device.trust import TrustStore
from meshctl.nodes.connections import ConnectionPool
from tests.meshctl.inventory.inventories import fleet_of


def test_an_ipv6_address_behind_a_jump_host_is_in_brackets(tmp_path: Path) -> None:
    fleet = fleet_of(
        tmp_path,
        """
        nodes:
          base: {hardware: rocket, role: base, address: 10.42.0.1}
          b1: {hardware: rocket, address: 10.42.0.2, ssh: {host: "fd42::2", jump: base}}
        """,
    )
    trust = TrustStore(tmp_path / "known_hosts")
    with ConnectionPool(fleet, trust) as access:
        opened = cast(Session, SimpleNamespace(fleet=fleet, access=access, trust=trust))
        arguments = ssh_arguments(opened, fleet.nodes["b1"])
    assert arguments[-1] == "root@fd42::2"
    seen = subprocess.run([arguments[0], "-G", *arguments[1:]], capture_output=True, text=True, check=True).stdout
    (command,) = (line.partition(" ")[2] for line in seen.splitlines() if line.startswith("proxycommand "))
    assert shlex.split(command)[-3:] == ["-W", "[%h]:%p", "root@10.42.0.1"]
