"""The permanent worker as a systemd unit: its command line, and what is left to do where there is no systemd."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from meshctl.device.connection import Connection
from meshctl.model import NatsHub, SiteNats
from meshctl.sites.gateway import requirements
from meshctl.sites.service import start_service, unit, unit_name

_HUB = NatsHub("tls://hub.example.org:4222", domain="head office")


def test_the_unit_starts_the_worker_of_its_site_and_lets_runs_live() -> None:
    text = unit("mines", "north", SiteNats("north", 'nats://50% "of" $it'), _HUB)
    assert (
        "ExecStart=%h/.local/share/meshctl/current/bin/meshctl worker mines/north "
        '--nats "nats://50%% \\"of\\" $$it" --hub "head office"\n'
    ) in text
    assert "KillMode=process\n" in text
    assert unit_name("mines", "north") == "meshctl-worker-mines-north.service"


class Gateway:
    """A gateway with these programs alone; its commands run here."""

    def __init__(self, home: Path, **programs: str) -> None:
        self._home, tools = home, home / "bin"
        tools.mkdir()
        for name in ("sh", "cat", "mkdir", "id"):
            (tools / name).symlink_to(shutil.which(name) or name)
        for name, body in programs.items():
            (tools / name).write_text(f"#!/bin/sh\n{body}\n")
            (tools / name).chmod(0o755)

    def run(self, script: str, *, timeout_s: float) -> SimpleNamespace:
        environment = {"HOME": str(self._home), "PATH": str(self._home / "bin")}
        done = subprocess.run(["/bin/sh", "-c", script], env=environment, capture_output=True, text=True, check=False)
        return SimpleNamespace(exit_status=done.returncode, stdout=done.stdout, stderr=done.stderr)


@pytest.mark.parametrize(
    ("programs", "left"),
    [
        ({"systemctl": "exit 0", "loginctl": "exit 0"}, ""),
        ({"systemctl": "exit 0", "loginctl": 'test "$1" = show-user && echo yes'}, ""),
        ({"systemctl": "exit 0", "loginctl": "exit 1"}, "it ends when "),
        ({"systemctl": "echo no bus >&2; exit 1", "loginctl": "exit 0"}, "start x.service there (no bus)"),
        ({}, "start x.service there (there is no systemd)"),
    ],
)
def test_the_unit_is_written_and_started(tmp_path: Path, programs: dict[str, str], left: str) -> None:
    gateway = cast("Connection", Gateway(tmp_path, **programs))
    found = start_service(gateway, "x.service", "it's a unit\n")
    assert found.startswith(left)
    assert bool(found) == bool(left)
    assert (tmp_path / ".config/systemd/user/x.service").read_text() == "it's a unit\n"


def test_a_gateway_gets_nats_py_only_for_nats() -> None:
    assert not any("nats-py" in line for line in requirements())
    assert any(line.startswith("nats-py") for line in requirements("nats"))
    # nkeys has no wheels, and the worker's leaf node is on the gateway itself
    assert not any("extra" in line or "nkeys" in line for line in requirements("nats"))
