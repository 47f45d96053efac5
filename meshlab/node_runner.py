"""The process that owns the nodes' namespaces: it starts and kills nodes, and opens sockets and shells inside them.

It is separate from the supervisor because it must be single-threaded and because an unprivileged process that entered
a node's network namespace cannot return to the host's. Messages are JSON datagrams with descriptors on a socket pair:

    {"do": "boot", "node": N, ...}          -> {"event": "exit", "node": N, "how": H} when the node's process 1 ends
    {"do": "kill", "node": N}
    {"do": "dial", "id": I, "node": N}      -> {"event": "dialled", "id": I} with a TCP socket of the node's network
    {"do": "exec", "id": I, "node": N, "command": C} with stdin, stdout, stderr
                                            -> {"event": "done", "id": I, "status": S}

All nodes end with this process, and it ends with the supervisor.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import selectors
import signal
import socket
import termios
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from meshlab import namespaces as ns
from meshlab.container import FLAGS, Container, become_node, last_pid
from meshlab.errors import LabError

# the longest request or event; the longest are commands of `lab shell NODE -- ...`
MESSAGE_BYTES = 1 << 17
_NAMESPACES = (("mnt", ns.CLONE_NEWNS), ("net", ns.CLONE_NEWNET), ("uts", ns.CLONE_NEWUTS), ("ipc", ns.CLONE_NEWIPC))
_SHELL_ENVIRONMENT = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "TERM": "vt102", "USER": "root"}


@dataclass(slots=True)
class _RunningNode:
    pid: int
    pidfd: int
    network: int
    deny_setgroups: bool


class NodeRunner:
    """Serves requests on `channel` until the supervisor closes it.

    `attach_devices` moves a node's network devices to its new namespace (by pid) before its process 1 starts;
    `detach_devices` takes them back from the namespace (a descriptor) of a node that ended.
    """

    def __init__(
        self,
        channel: socket.socket,
        attach_devices: Callable[[Container, int], None] | None = None,
        detach_devices: Callable[[str, int], None] | None = None,
    ) -> None:
        self._channel = channel
        self._attach_devices = attach_devices
        self._detach_devices = detach_devices
        self._selector = selectors.DefaultSelector()
        # where nodes' networks are made; those with devices are made in the network that has the devices
        self._network: int | None = None
        self._nodes: dict[str, _RunningNode] = {}

    def serve(self) -> None:
        if self._attach_devices is None:
            self._network = ns.enter_quick_network()
        self._selector.register(self._channel, selectors.EVENT_READ, None)
        while True:
            for key, _ in self._selector.select():
                if key.data is not None:
                    key.data()
                    continue
                message, descriptors, _, _ = socket.recv_fds(self._channel, MESSAGE_BYTES, 3)
                if not message:
                    return
                try:
                    self._handle(json.loads(message), descriptors)
                finally:
                    for descriptor in descriptors:
                        os.close(descriptor)

    def _handle(self, request: dict[str, Any], descriptors: Sequence[int]) -> None:
        match request["do"]:
            case "boot":
                self._boot(request)
            case "kill":
                running = self._nodes.get(request["node"])
                if running is not None:
                    with contextlib.suppress(ProcessLookupError):
                        signal.pidfd_send_signal(running.pidfd, signal.SIGKILL)
            case "dial":
                self._dial(request)
            case "exec":
                self._exec(request, descriptors)

    # -- boot and exit --

    def _boot(self, request: dict[str, Any]) -> None:
        container = Container(
            name=request["node"],
            fleet=Path(request["fleet"]),
            overlay_kib=request["overlay_kib"],
            memory_kib=request["memory_kib"],
            deny_setgroups=request["deny_setgroups"],
            real_devices=self._attach_devices is not None,
            last_pid=last_pid(request["number"]) if self._attach_devices is not None else 0,
        )
        console = os.open(container.home / "console.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        silence = os.open("/dev/null", os.O_RDONLY | os.O_CLOEXEC)
        report, report_end = os.pipe2(os.O_CLOEXEC)
        gate, gate_end = os.pipe2(os.O_CLOEXEC)
        if self._network is not None:
            # the last connection left this process in the network of its node
            ns.setns(self._network, ns.CLONE_NEWNET)
        pid = ns.clone(FLAGS)
        if pid == 0:
            os.dup2(silence, 0)
            os.dup2(console, 1)
            os.dup2(console, 2)
            os.close(gate_end)
            become_node(container, report_end, gate)
        # before the gate opens: a node that cannot start ends at once, and its network could not be opened any more
        pidfd = os.pidfd_open(pid)
        network = os.open(f"/proc/{pid}/ns/net", os.O_RDONLY | os.O_CLOEXEC)
        self._open_gate(container, pid, gate_end, report_end)
        for descriptor in (console, silence, report_end, gate, gate_end):
            os.close(descriptor)
        self._nodes[container.name] = _RunningNode(pid, pidfd, network, container.deny_setgroups)
        self._selector.register(pidfd, selectors.EVENT_READ, lambda: self._ended(container.name, report))
        self._send_event({"event": "started", "node": container.name, "pid": pid})

    def _open_gate(self, container: Container, pid: int, gate: int, report: int) -> None:
        try:
            if self._attach_devices is not None:
                self._attach_devices(container, pid)
            os.write(gate, b"\n")
        except LabError as error:
            # a gate that closes without a byte ends the node
            os.write(report, str(error).encode())

    def _ended(self, name: str, report: int) -> None:
        running = self._nodes.pop(name)
        self._selector.unregister(running.pidfd)
        _, status = os.waitpid(running.pid, 0)
        reason = os.read(report, 4096).decode("utf-8", "replace") if _readable(report) else ""
        if self._detach_devices is not None:
            self._detach_devices(name, running.network)
        for descriptor in (running.pidfd, running.network, report):
            os.close(descriptor)
        self._send_event({"event": "exit", "node": name, "status": os.waitstatus_to_exitcode(status), "reason": reason})

    # -- entering a node --

    def _dial(self, request: dict[str, Any]) -> None:
        running = self._nodes.get(request["node"])
        if running is None:
            self._send_event({"event": "dialled", "id": request["id"], "error": "off"})
            return
        ns.setns(running.network, ns.CLONE_NEWNET)
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as made:
            self._send_event({"event": "dialled", "id": request["id"]}, (made.fileno(),))

    def _exec(self, request: dict[str, Any], descriptors: Sequence[int]) -> None:
        running = self._nodes.get(request["node"])
        if running is None:
            self._send_event({"event": "done", "id": request["id"], "status": -1, "reason": "the node is off"})
            return
        pid = os.fork()
        if pid == 0:
            _enter_and_run(running, request["command"], descriptors)
        pidfd = os.pidfd_open(pid)

        def done() -> None:
            self._selector.unregister(pidfd)
            os.close(pidfd)
            _, status = os.waitpid(pid, 0)
            self._send_event({"event": "done", "id": request["id"], "status": os.waitstatus_to_exitcode(status)})

        self._selector.register(pidfd, selectors.EVENT_READ, done)

    def _send_event(self, event: dict[str, Any], descriptors: Sequence[int] = ()) -> None:
        socket.send_fds(self._channel, [json.dumps(event).encode()], list(descriptors))


def _readable(descriptor: int) -> bool:
    return bool(select.select([descriptor], [], [], 0)[0])


def _close_all_except(kept: Sequence[int]) -> None:
    """Close the runner's descriptors. A shell may run for hours, and a descriptor of another node's network namespace
    would keep that namespace alive."""
    for descriptor in map(int, os.listdir("/proc/self/fd")):
        if descriptor > 2 and descriptor not in kept:
            # one of them belonged to the listing
            with contextlib.suppress(OSError):
                os.close(descriptor)


def _enter_and_run(node: _RunningNode, command: str, descriptors: Sequence[int]) -> None:
    """In a forked child: enter the node, run `command` in its shell, return its exit status."""
    try:
        ns.die_with_parent()
        _close_all_except(descriptors)
        spaces = [(os.open(f"/proc/{node.pid}/ns/{kind}", os.O_RDONLY), flag) for kind, flag in _NAMESPACES]
        pid_space = os.open(f"/proc/{node.pid}/ns/pid", os.O_RDONLY)
        root = os.open(f"/proc/{node.pid}/root", os.O_RDONLY | os.O_DIRECTORY)
        with contextlib.suppress(FileNotFoundError):
            time_space = os.open(f"/proc/{node.pid}/ns/time_for_children", os.O_RDONLY)
            ns.setns(time_space, ns.CLONE_NEWTIME)
        ns.setns(pid_space, ns.CLONE_NEWPID)
        pid = os.fork()
        if pid != 0:
            _, status = os.waitpid(pid, 0)
            code = os.waitstatus_to_exitcode(status)
            os._exit(code if code >= 0 else 128 - code)
        for descriptor, flag in spaces:
            ns.setns(descriptor, flag)
        if node.deny_setgroups:
            # the command may restart the SSH server
            ns.accept_setgroups()
        # Entering a mount namespace leads to its root, which is the host's where the fleet runs in a chroot.
        os.fchdir(root)
        os.chroot(".")
        os.setsid()
        for number, descriptor in enumerate(descriptors):
            os.dup2(descriptor, number)
        if os.isatty(0):
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        arguments = ["/bin/ash", "-c", command] if command else ["-ash"]
        os.execve("/bin/ash", arguments, _SHELL_ENVIRONMENT)
    except OSError as error:
        os.write(2, f"{error}\n".encode())
    finally:
        os._exit(127)
