"""A worker process answers on its standard output, whatever it is asked, and ends with its uplink."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from meshctl import __version__
from meshctl.archive import TarMember, tar_of
from meshctl.sites.protocol import PROTOCOL
from tests.processes import killed_on_failure

_RUN = "0123456789abcdef"


class WorkerProcess:
    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process

    def say(self, line: bytes) -> dict[str, Any]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(line + b"\n")
        self.process.stdin.flush()
        while "beat" in (message := json.loads(self.process.stdout.readline())):
            pass
        assert isinstance(message, dict)
        return message

    def ask(self, **request: object) -> dict[str, Any]:
        return self.say(json.dumps(request).encode())


@contextmanager
def _worker(directory: Path) -> Iterator[WorkerProcess]:
    environment = {**os.environ, "XDG_STATE_HOME": str(directory)}
    command = [sys.executable, "-m", "meshctl", "worker", "--stdio", "mines/north"]
    with (
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process,
        killed_on_failure(process),
    ):
        yield WorkerProcess(process)
        assert process.stdin is not None
        process.stdin.write(b'{"do": "finish"}\n')
        process.stdin.close()
        assert process.wait(60) == 0


def test_a_worker_says_what_it_is(tmp_path: Path) -> None:
    with _worker(tmp_path) as worker:
        said = worker.ask(do="hello")["reply"]
    assert (said["protocol"], said["meshctl"], said["site"], said["runs"]) == (PROTOCOL, __version__, "mines/north", [])


_WRONG = (
    b"",
    b"{",
    b"[]",
    b"\xff\xfe",
    b'{"do": "reboot"}',
    b"{}",
    b'{"do": "plan"}',
    b'{"do": "plan", "run": "../../x", "part": "", "images": {}, "nodes": [], "options": []}',
    b'{"do": "plan", "run": "0123456789abcdef", "part": "?", "images": {}, "nodes": [], "options": []}',
    b'{"do": "plan", "run": "0123456789abcdef", "part": "", "images": {"a": "../x"}, "nodes": [], "options": []}',
    b'{"do": "plan", "run": "0123456789abcdef", "part": "AAAA", "images": {"a": "b"}, "nodes": [], "options": []}',
    b'{"do": "follow", "run": "0123456789abcdef", "offset": 0}',
    b'{"do": "follow", "run": "0123456789abcdef", "offset": "x"}',
    b'{"do": "start", "order": "{}", "key": "x", "signature": "x"}',
    b'{"do": "images", "sha256": 5}',
)


def test_a_wrong_request_is_an_error_and_the_worker_continues(tmp_path: Path) -> None:
    with _worker(tmp_path) as worker:
        for line in _WRONG:
            assert worker.say(line)["error"], line
            assert worker.ask(do="hello")["reply"]["protocol"] == PROTOCOL


def test_what_meshctl_says_against_the_inventory_is_the_reply(tmp_path: Path) -> None:
    part = base64.b64encode(
        tar_of([TarMember("fleet.yaml", b"meshctl: 1\nfleet: mines\ncountry: US\nnods: {}\n")])
    ).decode()
    with _worker(tmp_path) as worker:
        said = worker.ask(do="plan", run=_RUN, part=part, images={}, nodes=[], options=[])
    assert "fleet.yaml:4" in said["error"]
    assert list(tmp_path.rglob("fleet.yaml")) == []


_PART = base64.b64encode(tar_of([TarMember("fleet.yaml", b"meshctl: 1\nfleet: mines\ncountry: US\n")])).decode()
_PLAN = {"do": "plan", "run": _RUN, "part": _PART, "images": {}, "nodes": [], "options": []}


def test_a_plan_is_deleted_when_the_operator_is_finished(tmp_path: Path) -> None:
    with _worker(tmp_path) as worker:
        assert "plan" in worker.ask(**_PLAN)["reply"]
        assert len(list(tmp_path.rglob("fleet.yaml"))) == 1
    assert list(tmp_path.rglob("fleet.yaml")) == []


def test_a_plan_waits_for_its_order_when_the_uplink_is_lost(tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_STATE_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "meshctl", "worker", "--stdio", "mines/north"]
    with (
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as process,
        killed_on_failure(process),
    ):
        assert "plan" in WorkerProcess(process).ask(**_PLAN)["reply"]
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.close()
        # its reply has no reader
        process.stdin.write(b'{"do": "hello"}\n')
        process.stdin.close()
        (inventory,) = tmp_path.rglob("inventory")
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(2)
        # the next uplink brought the order: the run is not this process's anymore
        (inventory.parent / "order.json").write_text("{}")
        assert process.wait(60) == 0
        assert inventory.exists()
