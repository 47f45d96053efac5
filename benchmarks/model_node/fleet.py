"""Model nodes with an inventory for them: `ModelFleet` starts the server process and ends it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from meshctl.device import deadman
from meshctl.inventory import load_fleet
from meshctl.model import Fleet, Secret, SecretRef
from meshctl.render import DeviceFacts, render_node

INVENTORY = """\
meshctl: 1
fleet: model
country: US
operators: {{ssh_keys: ["{key}"], known_hosts: known_hosts}}
system: {{log_size_kib: {log_size}}}
apply: {{max_down: 1000, canary: false, stop_after_failures: 100000{policy}}}
hardware:
  box:
    board: compex,wpj344-16m
    profile: compex_wpj344-16m
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    confirm_window_s: 60
    radios:
      radio0: {{path: platform/ahb/18100000.wmac, band: 2g, rated_power_dbm: 30, max_drive_dbm: 27}}
meshes:
  main:
    ssid: proof
    bssid: 02:ca:fe:00:00:01
    band: 2g
    channel: 6
    distance_m: {distance}
    network: 10.42.0.0/16
    batman: {{hop_penalty: {penalty}}}
defaults: {{hardware: box, state: deployed, role: beacon}}
nodes:
"""
VARIANTS = ("a", "b")


@dataclass(frozen=True, slots=True)
class RunningNodes:
    """The server process of the nodes."""

    requests: IO[str]
    answers: IO[str]

    def counts(self) -> dict[str, float]:
        """Processes and syncs of a node so far, on average."""
        self.requests.write("counts\n")
        self.requests.flush()
        found = json.loads(self.answers.readline()).values()
        return {
            "processes": sum(processes for processes, _ in found) / len(found),
            "syncs": sum(syncs for _, syncs in found) / len(found),
        }


class ModelFleet:
    """`count` model nodes n001, n002, ... that run inventory `a`; see `running`. Without `is_chain` none hears another;
    in a chain each hears the one before and the one after it, and n001 is the base."""

    def __init__(self, directory: Path, count: int, *, parallel: int | None = None, is_chain: bool = False) -> None:
        self.directory = directory
        self.is_chain = is_chain
        self.names = tuple(f"n{number:03}" for number in range(1, count + 1))
        self.key = directory / "key"
        self.ports = dict(zip(self.names, _free_ports(count), strict=True))
        self._fleets: dict[str, Fleet] = {}
        self._write_inventories(parallel)
        (directory / "nodes").mkdir()
        self._write_nodes()

    def inventory(self, variant: str) -> Path:
        return self.directory / f"{variant}.yaml"

    def rendered(self, variant: str, name: str) -> dict[str, bytes]:
        """The files that inventory `variant` wants of a node, without the leading slash."""
        if variant not in self._fleets:
            self._fleets[variant] = load_fleet(self.inventory(variant))
        found = render_node(self._fleets[variant], name, _no_secret, device_facts=DeviceFacts("1.0"))
        return {file.path: file.content for file in found.files}

    @property
    def environ(self) -> dict[str, str]:
        return {
            **{name: text for name, text in os.environ.items() if not name.startswith("MESHCTL_")},
            "XDG_STATE_HOME": str(self.directory / "state"),
            "PYTHONPATH": str(Path(__file__).resolve().parents[2]),
            "SSH_AUTH_SOCK": "",
        }

    @contextmanager
    def running(self) -> Iterator[RunningNodes]:
        """Within this block the nodes answer."""
        command = [sys.executable, "-m", "benchmarks.model_node.server", str(self.directory / "nodes")]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=self.environ, text=True
        ) as process:
            assert process.stdout is not None
            assert process.stdin is not None
            if process.stdout.readline().strip() != "ready":
                raise RuntimeError(f"the model nodes did not start (exit status {process.wait()})")
            try:
                yield RunningNodes(process.stdin, process.stdout)
            finally:
                process.stdin.close()
                process.wait(timeout=30)

    def _write_inventories(self, parallel: int | None) -> None:
        private = Ed25519PrivateKey.generate()
        self.key.write_bytes(
            private.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.OpenSSH, serialization.NoEncryption()
            )
        )
        self.key.chmod(0o600)
        self._public = (
            private.public_key()
            .public_bytes(serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH)
            .decode()
        )
        policy = "" if parallel is None else f", parallel: {parallel}"
        for number, variant in enumerate(VARIANTS):
            text = INVENTORY.format(
                key=f"{self._public} benchmark",
                log_size=64 + number,
                policy=policy,
                distance=1000 + number,
                penalty=30 + number,
            )
            for index, (name, port) in enumerate(self.ports.items(), 1):
                address = _address(index)
                role = "role: base, " if self.is_chain and index == 1 else ""
                text += f"  {name}: {{{role}address: {address}, ssh: {{host: 127.0.0.1, port: {port}}}}}\n"
            self.inventory(variant).write_text(text, encoding="utf-8")

    def chain_of(self, number: int) -> list[int] | None:
        """The number of a node (from 1), and those of its chain's ends."""
        return [number, 1, len(self.ports)] if self.is_chain else None

    def _write_nodes(self) -> None:
        place = self.directory / "nodes"
        (place / "root" / ".ssh").mkdir(parents=True, mode=0o700)
        (place / "root").chmod(0o700)
        (place / "root" / ".ssh" / "authorized_keys").write_text(self._public + "\n")
        (place / "passwd").write_text("root:x:0:0:root:/root:/bin/sh\n")
        relay = place / "relay"
        relay.write_text(
            f'#!/bin/sh\nexec 3<>{place}/"$1".status 4<&0 5>&1\necho "$1 $$" >{place}/requests\n'
            'read -r status <&3\nexit "$status"\n'
        )
        relay.chmod(0o755)
        version = deadman.version()
        nodes, pins = {}, []
        for index, (name, port) in enumerate(self.ports.items(), 1):
            key = place / f"{name}.key"
            said = subprocess.run(
                ["dropbearkey", "-t", "ed25519", "-f", str(key)], check=True, capture_output=True, text=True
            ).stdout
            public = next(line for line in said.splitlines() if line.startswith("ssh-ed25519 "))
            pins.append(f"{name} {' '.join(public.split()[:2])}\n")
            files = {path: content.decode() for path, content in self.rendered("a", name).items()}
            nodes[name] = {
                "address": _address(index), "port": port, "files": files, "version": version,
                "chain": self.chain_of(index),
            }  # fmt: skip
        (self.directory / "known_hosts").write_text("".join(pins))
        (place / "nodes.json").write_text(json.dumps(nodes))


def _address(index: int) -> str:
    return f"10.42.{1 + index // 250}.{1 + index % 250}"


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for made in sockets:
            made.bind(("127.0.0.1", 0))
        return [made.getsockname()[1] for made in sockets]


def _no_secret(ref: SecretRef) -> Secret:
    raise AssertionError(f"no secret is in these inventories: {ref}")
