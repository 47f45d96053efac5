"""Nodes that go down and come back: no signal, events message or descriptor may keep one from starting."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from meshlab import rootfs
from meshlab.errors import LabError
from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.spec import FleetSpec, NodeSpec
from meshlab.state import Power
from meshlab.supervisor import Supervisor
from tests.meshlab.conftest import KEYS
from tests.meshlab.fleet_report import fleets_of, report
from tests.meshlab.power_cycles import cycle
from tests.waiting import until

# the system call number of write(2), as in /proc/PID/syscall
_WRITE = {"x86_64": "1", "aarch64": "64"}[os.uname().machine]
_PIPE_BYTES = 4096


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[VirtualFleet]:
    nodes = (NodeSpec("here", host_key_types=KEYS), NodeSpec("there", host_key_types=KEYS))
    with VirtualFleet(FleetSpec("pair", nodes), tmp_path / "fleet") as running:
        yield running


def test_a_signal_just_before_init_waits_is_not_lost(tmp_path: Path) -> None:
    """The shell writes each command it runs into a pipe that holds one line: so it stands still before its read."""
    script = (rootfs.STAND_INS / "lab" / "init").read_text(encoding="utf-8")
    traps, loop = (
        re.search(r"^trap 'ACTION=reboot; .*' TERM$", script, re.M),
        re.search(r"^while .*?^done$", script, re.M | re.S),
    )
    assert traps is not None
    assert loop is not None
    fifo = tmp_path / "init"
    before = f"ACTION= died=\nshut_down() {{ exit 0; }}\nmkfifo {fifo}\nexec 3<>{fifo}\n"
    text = f"{before}{traps[0]}\nset -x\n{loop[0]}\n"
    lines, lines_end = os.pipe2(os.O_DIRECT | os.O_CLOEXEC)
    fcntl.fcntl(lines_end, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    busybox = rootfs.find_program("busybox", "busybox-static")
    with subprocess.Popen((busybox, "ash", "-c", text), stderr=lines_end, pass_fds=()) as shell:
        os.close(lines_end)
        try:
            # the pipe has the loop's first command; the next one is the read
            until(lambda: _is_writing(shell.pid), "the shell to stand before its read")
            shell.send_signal(signal.SIGTERM)
            os.set_blocking(lines, False)
            until(lambda: _has_ended(lines), "the shell to see the signal")
            assert shell.wait() == 0
        finally:
            shell.kill()
            os.close(lines)


def _is_writing(pid: int) -> bool:
    return Path(f"/proc/{pid}/syscall").read_text(encoding="ascii").split()[0] == _WRITE


def test_a_node_shell_closes_inherited_descriptors_of_other_nodes() -> None:
    program = (
        "import os, sys; from meshlab.node_runner import _close_all_except\n"
        "kept, other = os.open('/dev/null', os.O_RDONLY), os.open('/proc/self/ns/net', os.O_RDONLY)\n"
        "_close_all_except([kept])\n"
        "os.fstat(kept)\n"
        "try: os.fstat(other)\n"
        "except OSError: sys.exit(0)\n"
        "sys.exit('a descriptor of a network is still open')"
    )
    subprocess.run((sys.executable, "-c", program), check=True, timeout=60)


def test_what_a_node_says_at_the_end_of_its_boot_is_not_taken_for_its_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its power is cut just then, and a busy supervisor sees that it has ended before it reads the rest."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    os.mkfifo(tmp_path / "events")

    async def cut_at_the_end_of_a_boot() -> tuple[Power, str]:
        supervisor = Supervisor(FleetSpec("one", (NodeSpec("here"),)), tmp_path, ours, deny_setgroups=False)
        # its next boot has begun, and has not said anything
        monkeypatch.setattr(supervisor, "_boot", lambda state: setattr(state, "power", Power.BOOTING))
        supervisor._make(0)
        state = supervisor.fleet.nodes["here"]
        state.power, state.pid = Power.BOOTING, 7
        events = supervisor._open_events()
        supervisor.power_off("here", back=True)
        os.write(events, b"up here earlier-boot\n")
        theirs.send(json.dumps({"event": "exit", "node": "here", "status": -9, "reason": ""}).encode())
        supervisor._on_runner_event()
        supervisor._on_events()
        os.close(events)
        return state.power, state.boot_id

    with ours, theirs:
        assert asyncio.run(cut_at_the_end_of_a_boot()) == (Power.BOOTING, "")


def _has_ended(lines: int) -> bool:
    """Read the available data; returns whether the other end is closed."""
    try:
        while os.read(lines, _PIPE_BYTES):
            pass
    except BlockingIOError:
        return False
    return True


@pytest.mark.lab
def test_an_invalid_node_state_does_not_discard_the_next_event(pair: VirtualFleet) -> None:
    air = pair.directory / "nodes" / "here" / "air" / "effective"
    air.write_text("\t".join(("cell", "-", "mesh0", "adhoc", "no frequency", *"abcdefg")) + "\n", encoding="ascii")
    (pair.directory / "nodes" / "there" / "air" / "effective").write_text("", encoding="ascii")
    assert pair.node("there").address is not None
    with (pair.directory / "events").open("wb", buffering=0) as events:
        events.write(b"changed here\nchanged there\n")
    until(lambda: pair.node("there").address is None, "the second node's word to be heard")


@pytest.mark.lab
def test_a_node_that_cannot_be_started_is_not_waited_for(pair: VirtualFleet, monkeypatch: pytest.MonkeyPatch) -> None:
    node = pair.node("here")
    state = {**pair.request("node", node="here"), "power": "failed", "reason": "no memory"}
    monkeypatch.setattr(VirtualNode, "_state", lambda _: state)
    with pytest.raises(LabError, match="cannot start here: no memory"):
        node.wait_up()


@pytest.mark.lab
def test_a_failure_report_contains_the_console_of_a_node_that_is_down(pair: VirtualFleet) -> None:
    pair.node("here").power_cut(back=False)
    (fleet,) = fleets_of([1, pair.node("there"), pair])
    text = report(fleet, "waited 180 s for something")
    console = text.partition("--- here: console\n")[2].partition("\n--- ")[0]
    assert re.search(r"- boot [0-9a-f-]{36} -\n", console)
    assert re.search(r"^\[[0-9.]+\] S20network$", console, re.M)
    assert '"name": "here", "power": "off"' in text
    # it is up, so the report does not describe it
    assert "--- there" not in text
    assert "--- there: log and processes" in report(fleet, "waited 180 s for there to boot")


@pytest.mark.proof
@pytest.mark.lab
@pytest.mark.timeout(3600)
def test_every_node_survives_a_thousand_power_cycles(tmp_path: Path) -> None:
    names = [f"n{number}" for number in range(8)]
    spec = FleetSpec("eight", tuple(NodeSpec(name, host_key_types=KEYS) for name in names))
    with VirtualFleet(spec, tmp_path / "fleet") as fleet:
        assert list(cycle(fleet, names, 1000, random.Random(1), wait_s=180.0))
