"""The Python API of a virtual fleet: start it, access its nodes, inject faults, stop it.

`VirtualFleet(spec, directory).up()` starts the fleet's supervisor as a separate process and waits until every node has
booted; everything else is one request over the supervisor's socket. `VirtualFleet.attach(directory)` returns a fleet
that another process started.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from meshctl.device.connection import Completed, Endpoint
from meshctl.errors import InputError
from meshctl.wording import counted
from meshlab import fleet_directory, propagation_file, rootfs
from meshlab.addresses import bench_of, loopback_of
from meshlab.client import ANSWER_S, MACHINE_ANSWER_S, is_running, request
from meshlab.errors import LabError
from meshlab.qemu.qemu import find_qemu
from meshlab.spec import FleetSpec, Medium, dump, load
from meshlab.state import Power

# how often a waiting caller polls
_POLL_S = 0.05
_LOG_LINES = 15
# after this the supervisor, and all nodes with it, is killed
_DOWN_S = 30.0


class VirtualNode:
    """One node of a running fleet from outside: its power switch, console and flash."""

    def __init__(self, fleet: VirtualFleet, name: str) -> None:
        self._fleet = fleet
        self.name = name
        self.spec = fleet.spec.node(name)

    def _state(self) -> dict[str, Any]:
        return self._fleet.request("node", node=self.name)

    @property
    def address(self) -> str | None:
        """Its current LAN IPv4 address (`10.42.0.11`); None while it is off or has none."""
        address: str | None = self._state()["address"]
        return address

    @property
    def boot_id(self) -> str | None:
        """Changes with every boot; None while it is off or still booting."""
        return self._state()["boot_id"] or None

    @property
    def power(self) -> Power:
        return Power(self._state()["power"])

    @property
    def flash_path(self) -> Path:
        """The directory with its flash content, which survives a power cut: `flash_path / "etc/config/network"`.

        Valid until the node's next `sync`, which makes a new copy.
        """
        return (self._fleet.directory / "nodes" / self.name / "flash" / "current").resolve()

    def console(self, lines: int = 40) -> str:
        """The last lines of its console: each boot, each boot script and its output."""
        return str(self._fleet.request("console", node=self.name, lines=lines)["text"])

    @property
    def bench(self) -> Endpoint:
        """Its LAN port on the bench; answers while the node is plugged in and has the address 192.168.1.1."""
        return Endpoint(bench_of(self._state()["number"]), self._fleet.port, identity=self.name)

    def exec(self, command: str, *, stdin: bytes = b"", timeout_s: float | None = None) -> Completed:
        """Run a shell command on its serial console, which needs neither network nor SSH.

        Raises LabError when the node is off, the fleet has ended or `timeout_s` passes; without it, `ANSWER_S` counts.
        """
        with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            source.write(stdin)
            source.seek(0)
            descriptors = (source.fileno(), out.fileno(), err.fileno())
            limit_s = self._fleet.ANSWER_S if timeout_s is None else timeout_s
            answer = self._fleet.request_with_fds(descriptors, limit_s, "exec", node=self.name, command=command)
            if answer["reason"]:
                raise LabError(f"{self.name}: {answer['reason']}")
            out.seek(0)
            err.seek(0)
            return Completed(out.read(), err.read(), answer["status"])

    def reboot(self, *, wait_s: float = 60.0) -> None:
        """Run `reboot` on the node; returns when it is up again."""
        boots = self._state()["boots"]
        self.exec("reboot")
        self.wait_up(after_boots=boots, wait_s=wait_s)

    def power_cut(self, *, unsynced: str = "lost", back: bool = True, wait_s: float = 60.0) -> None:
        """Cut its power; unsynced data is `lost`, `kept`, or `torn` (files exist but are empty).

        `back` restores the power and waits until the node is up (or its firmware fails to start).
        """
        boots = self._state()["boots"]
        self._fleet.request("power_cut", node=self.name, unsynced=unsynced, back=back)
        if back:
            self.wait_up(after_boots=boots, wait_s=wait_s)

    def power_on(self, *, wait_s: float = 60.0) -> None:
        """Restore its power; returns when it is up (or its firmware fails to start)."""
        self._fleet.request("power_on", node=self.name)
        self.wait_up(wait_s=wait_s)

    def wait_up(self, *, after_boots: int = 0, wait_s: float = 60.0) -> None:
        """Wait until it is up (or its firmware fails to start) and has booted more than `after_boots` times.

        Raises LabError with the reason when this machine cannot start it.
        """

        def settled() -> bool:
            state = self._state()
            if state["boots"] <= after_boots:
                return False
            if Power(state["power"]) is Power.FAILED:
                raise LabError(f"this machine cannot start {self.name}: {state['reason']}")
            return Power(state["power"]) in (Power.UP, Power.DEAD)

        wait_for(settled, f"{self.name} to boot", wait_s)

    def is_up(self) -> bool:
        return self.power is Power.UP

    @property
    def is_base(self) -> bool:
        """Whether the operator's machine is on its LAN."""
        return self.spec.medium is Medium.BASE

    def plug(self, plugged: bool = True) -> None:
        """Connect its LAN port to the operator's machine, or disconnect it: then only the mesh reaches the node."""
        self._fleet.request("plug", node=self.name, plugged=plugged)

    def record_steps(self) -> None:
        """Record each external command it runs from now on, for `steps()`. `sleep` and shells are not counted."""
        self._fleet.request("record_steps", node=self.name)

    def steps(self) -> tuple[str, ...]:
        """The external commands since `record_steps()`, in order; `power-cut@n` cuts at the n-th (from 1)."""
        return tuple(
            self.exec("/rom/lab/genuine/busybox cat /tmp/lab/steps.log")
            .check(f"{self.name}: read its steps")
            .stdout.splitlines()
        )

    def awaits_fault(self) -> bool:
        """Whether it runs with a fault at a step (`power-cut@n`) that it has not reached."""
        return self.is_up() and self.exec("[ -e /tmp/lab/fatal ]").exit_status == 0


class VirtualFleet:
    """A fleet in `directory` (created if needed). Use as a context manager, or call `up()` and `down()`."""

    # the module that runs as the fleet's process
    SUPERVISOR = "meshlab.supervisor"
    ANSWER_S = ANSWER_S

    def __init__(self, spec: FleetSpec, directory: Path) -> None:
        self.spec = spec
        self.directory = directory.resolve()
        self._port = spec.port
        self._process: subprocess.Popen[bytes] | None = None

    @classmethod
    def attach(cls, directory: Path) -> Self:
        """The fleet that runs in `directory`. Raises LabError when none does."""
        request(directory, {"op": "status"})
        return cls(load((directory / "spec.json").read_text(encoding="utf-8")), directory)

    # -- life --

    def up(self, *, wait_s: float = 120.0) -> Self:
        """Start it and wait until every node has booted. Raises LabError with the reason and the log's path."""
        self._check_programs()
        fleet_directory.claim(self.directory)
        fleet_directory.clear(self.directory)
        (self.directory / "spec.json").write_text(dump(self.spec), encoding="utf-8")
        log_path = self.directory / "log"
        with log_path.open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", self.SUPERVISOR, str(self.directory)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                cwd="/",
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            )
        try:
            self._wait_booted(process, wait_s)
        except BaseException:
            process.terminate()
            process.wait()
            raise
        self._process = process
        weakref.finalize(self, _detach, process)
        return self

    def _check_programs(self) -> None:
        for program, package in (("busybox", "busybox-static"), ("dropbear", "dropbear-bin")):
            rootfs.find_program(program, package)

    def _wait_booted(self, process: subprocess.Popen[bytes], wait_s: float) -> None:
        def booted() -> bool:
            failure = self.directory / "failure"
            if process.poll() is not None:
                lines = failure.read_text(encoding="utf-8").splitlines() if failure.exists() else []
                reason = lines[0] if lines else f"its process ended with status {process.returncode}"
                hint = lines[1] if len(lines) > 1 and lines[1] else self._log_tail()
                raise LabError(f"the virtual fleet did not start: {reason}", hint=hint)
            try:
                nodes = self.status()["nodes"]
            except LabError:
                return False
            for node in nodes:
                if node["power"] == Power.FAILED.value:
                    raise LabError(
                        f"this machine cannot start {node['name']}: {node['reason']}",
                        hint="set MESHCTL_LAB_PRIVILEGES to root (as root) or user to isolate nodes the other way; "
                        "inside a container, run it with --privileged",
                    )
            return all(node["power"] in (Power.UP.value, Power.DEAD.value) for node in nodes)

        wait_for(booted, f"{counted(len(self.spec.nodes), 'node')} to boot; see {self.directory / 'log'}", wait_s)

    def _log_tail(self) -> str:
        lines = (self.directory / "log").read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(lines[-_LOG_LINES:])

    def down(self) -> None:
        """Stop it: every process, mount and namespace is gone when this returns. `directory` stays for inspection.

        Does nothing when no fleet runs there.
        """
        if stop_fleet(self.directory) and self._process is not None:
            self._process.wait()

    # -- nodes, addresses, links --

    def node(self, name: str) -> VirtualNode:
        """The node called `name`. Raises InputError for an unknown name."""
        return VirtualNode(self, name)

    @property
    def nodes(self) -> tuple[VirtualNode, ...]:
        return tuple(VirtualNode(self, name) for name in self.spec.names)

    @property
    def port(self) -> int:
        """The TCP port of all its loopback addresses."""
        if not self._port:
            self._port = int(self.request("status")["port"])
        return self._port

    def endpoint(self, address: str, *, identity: str = "") -> Endpoint:
        """The endpoint on this machine of a node's address: 10.42.0.11 -> 127.42.0.11, port `port`.

        It refuses connections unless a node has that address and the base has a path to it.
        """
        return Endpoint(loopback_of(address), self.port, identity=identity)

    @property
    def node_names(self) -> tuple[str, ...]:
        return tuple(self.spec.names)

    @property
    def positions(self) -> dict[str, tuple[float, float]]:
        """Where its nodes are, in meters; empty without a radio environment."""
        path = self.directory / propagation_file.FLEET_FILE
        return (
            {name: position.at for name, position in propagation_file.load(path).positions.items()}
            if path.exists()
            else {}
        )

    def bench_endpoint(self, name: str) -> Endpoint:
        """`VirtualNode.bench` of the node called `name`."""
        return self.node(name).bench

    def inject_fault(self, where: str, what: str) -> None:
        """`where` is a node or a link (`b01-b02`), `what` one of `faults.FAULTS` (`power-cut@7`, `full-flash`, ...)."""
        self.request("do_break", where=where, what=what)

    def repair(self, where: str = "") -> None:
        """Repair everything (or one node or link): links up, power on, flash freed, bricked nodes recovered."""
        self.request("mend", where=where)

    def link(self, a: str, b: str, **changes: Any) -> None:
        """Change a link's fields as seen from `a` (`spec.changed_link`), or add a link; `repair` undoes it."""
        self.request("link", a=a, b=b, changes=changes)

    def status(self) -> dict[str, Any]:
        """The content of `meshctl lab status --json`: fleet, pid, port, and per node power, address, mesh, faults."""
        return self.request("status")

    def request(self, operation: str, **arguments: Any) -> dict[str, Any]:
        """One request to the supervisor (`control.Operations`)."""
        return request(self.directory, {"op": operation, **arguments}, timeout_s=self.ANSWER_S)

    def request_with_fds(
        self, descriptors: tuple[int, ...], timeout_s: float | None, operation: str, **arguments: Any
    ) -> dict[str, Any]:
        """A request that passes descriptors for a process on a node; without `timeout_s` it waits for ever."""
        return request(self.directory, {"op": operation, **arguments}, descriptors, timeout_s=timeout_s)

    def __enter__(self) -> Self:
        return self.up()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.down()


class QemuFleet(VirtualFleet):
    """A fleet in a QEMU machine, with the kernel's own radios, mesh and bridges.

    The nodes' files are inside the machine: `VirtualNode.flash_path` does not exist on the host; use `exec` instead.
    """

    SUPERVISOR = "meshlab.qemu.host_proxy"
    ANSWER_S = MACHINE_ANSWER_S

    def _check_programs(self) -> None:
        find_qemu()


def stop_fleet(directory: Path) -> str:
    """Stop the fleet that runs in `directory`, whatever version started it; returns its name, or "" when none runs."""
    try:
        status = request(directory, {"op": "status"})
    except (LabError, InputError):
        # a machine whose kernel hangs answers nothing, and must not be left behind
        if not is_running(directory):
            return ""
        status = {"pid": (directory / "supervisor.pid").read_text(encoding="ascii"), "fleet": directory.name}
    watched = os.pidfd_open(int(status["pid"]))
    try:
        with contextlib.suppress(LabError):
            request(directory, {"op": "down"})
        deadline = time.monotonic() + _DOWN_S
        while not _has_ended(watched):
            if time.monotonic() > deadline:
                signal.pidfd_send_signal(watched, signal.SIGKILL)
            time.sleep(_POLL_S)
    finally:
        os.close(watched)
    return str(status["fleet"])


def wait_for(condition: Callable[[], bool], what: str, wait_s: float) -> None:
    """Poll until `condition()`. Raises LabError that names `what` after `wait_s`."""
    deadline = time.monotonic() + wait_s
    while not condition():
        if time.monotonic() > deadline:
            raise LabError(f"waited {wait_s:g} s for {what}")
        time.sleep(_POLL_S)


def _detach(process: subprocess.Popen[bytes]) -> None:
    """Suppress Popen's warning: the supervisor outlives the process that started it."""
    if process.returncode is None:
        process.returncode = 0


def _has_ended(pidfd: int) -> bool:
    return bool(select.select([pidfd], [], [], 0)[0])
