"""A provisioned virtual fleet of three nodes in a line, and meshctl over it."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.inventory import load_fleet
from meshctl.model import Secret, SecretRef
from meshctl.render import render_node
from meshlab.fleet import VirtualFleet
from meshlab.spec import FleetSpec, LinkSpec, Medium, NodeSpec
from tests.meshctl.inventories import compex_hardware
from tests.meshctl.status.terminal import PATIENCE_S
from tests.waiting import until

NAMES = ("base", "b01", "b02")
INVENTORY = (
    """\
meshctl: 1
fleet: looked-at
country: US
operators: {{ssh_keys: ["{key}"]}}
hardware:
"""
    + compex_hardware("23.05")
    + """\
meshes:
  main: {{ssid: looked-at, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/24{encryption}}}
defaults: {{hardware: box, state: deployed, ssh: {{key_files: [key]}}}}
nodes:
  base: {{role: base, address: 10.42.0.1}}
  b01: {{role: beacon, address: 10.42.0.2}}
  b02: {{role: beacon, address: 10.42.0.3}}
robots:
  rover: {{computer: {{address: 10.42.0.20/24}}}}
"""
)


@dataclass(frozen=True, slots=True)
class Bench:
    """A fleet whose nodes run what the inventory says, and meshctl over it."""

    fleet: VirtualFleet
    directory: Path

    def command(self, *words: str, inventory: str = "fleet.yaml") -> list[str]:
        return [sys.executable, "-m", "meshctl", *words, "-i", str(self.directory / inventory)]

    @property
    def environ(self) -> dict[str, str]:
        foreign = ("MESHCTL_", "SSH_AUTH_SOCK", "COLUMNS", "LINES")
        ours = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
        lab, state = str(self.fleet.directory), str(self.directory / "state")
        return {**ours, "MESHCTL_LAB": lab, "XDG_STATE_HOME": state, "TERM": "xterm"}

    def run(self, *words: str, inventory: str = "fleet.yaml") -> Result:
        """A command to its end. The deadline for a silent node is generous: this machine may be slow."""
        given = ["--timeout", "60"] if words[0] in ("status", "preflight", "topology") else []
        arguments = [*words, *given, "-i", str(self.directory / inventory)]
        environ: dict[str, str | None] = {
            **dict.fromkeys(("MESHCTL_INVENTORY", "SSH_AUTH_SOCK", "COLUMNS")),
            **self.environ,
        }
        return CliRunner().invoke(build(words[0]), arguments, env=environ, catch_exceptions=False)

    def run_bare(self, *words: str) -> Result:
        """A command to its end, without options for the fleet."""
        return CliRunner().invoke(build(words[0]), words, env=dict(self.environ), catch_exceptions=False)

    def status(self, *words: str, inventory: str = "fleet.yaml") -> dict[str, Any]:
        done = self.run("status", "--json", *words, inventory=inventory)
        output = json.loads(done.stdout)
        assert done.exit_code == output["exit_code"], done.stderr
        return {**output, "by_name": {node["name"]: node for node in output["nodes"]}}


def no_secret(ref: SecretRef) -> Secret:
    raise AssertionError(f"no secret is in this inventory: {ref}")


@contextmanager
def line_of_three(directory: Path) -> Iterator[Bench]:
    """base - b01 - b02, provisioned, with pinned host keys."""
    key = Ed25519PrivateKey.generate()
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.OpenSSH, serialization.NoEncryption()
    )
    (directory / "key").write_bytes(private)
    (directory / "key").chmod(0o600)
    public = key.public_key().public_bytes(serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH).decode()
    (directory / "fleet.yaml").write_text(INVENTORY.format(key=f"{public} test", encryption=""))
    secret = ", encryption: psk2+ccmp, key: {env: NOT_SET_HERE}"
    (directory / "secret.yaml").write_text(INVENTORY.format(key=f"{public} test", encryption=secret))
    nodes = tuple(NodeSpec(name, medium=Medium.BASE, host_key_types=("ed25519",)) for name in NAMES)
    links = (LinkSpec("base", "b01", tq=250, signal_dbm=-55), LinkSpec("b01", "b02", tq=200, signal_dbm=-70))
    with VirtualFleet(FleetSpec("looked-at", nodes, links), directory / "lab") as fleet:
        loaded = load_fleet(directory / "fleet.yaml")
        for name in NAMES:
            lines = []
            for file in render_node(loaded, name, no_secret).files:
                target = shlex.quote(f"/{file.path}")
                lines.append(f"mkdir -p $(dirname {target}); printf %s {shlex.quote(file.content.decode())} >{target}")
                lines.append(f"chmod {file.mode:o} {target}")
            fleet.node(name).exec("\n".join([*lines, "sync", "reload_config"])).check(f"set up {name}")
        bench = Bench(fleet, directory)
        until(lambda: bench.run("trust", "--yes").exit_code == 0, "the host keys", wait_s=PATIENCE_S)
        yield bench
