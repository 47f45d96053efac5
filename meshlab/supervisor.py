"""The process of a running fleet: it boots the nodes, keeps their link state and forwards the operator's connections.

It starts as `python -m meshlab.supervisor DIRECTORY`, becomes root of a user namespace if it is not root, forks the
node runner, and then serves one event loop: events of the node runner (nodes that ended), the events pipe (on which
nodes report that they are up or have changed), connections of the operator, and requests on `control.sock`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from meshlab import namespaces as ns
from meshlab import rootfs
from meshlab.container import prepare
from meshlab.control import Control, Operations
from meshlab.errors import LabError
from meshlab.fault_injection import FaultInjection
from meshlab.fleet_state import FleetState
from meshlab.link_state import LinkState
from meshlab.mesh_model import parse_effective
from meshlab.node_runner import MESSAGE_BYTES, NodeRunner
from meshlab.port_forwarder import PortForwarder
from meshlab.spec import FleetSpec, Medium, load
from meshlab.state import NodeState, Power, label_mac, write_board, write_firmware

log = logging.getLogger("meshlab")
# more parallel boots only make each of them slower
_BOOTING_AT_ONCE = 4 * (os.cpu_count() or 1)


class Supervisor:
    """Owns the state of one fleet (`NodeControl`). Not thread-safe: everything runs in one event loop."""

    def __init__(self, spec: FleetSpec, directory: Path, runner: socket.socket, *, deny_setgroups: bool) -> None:
        self.spec = spec
        self.directory = directory
        self.fleet = FleetState(spec, directory, deny_setgroups=deny_setgroups)
        self.stopping = asyncio.Event()
        self._runner = runner
        self._events = -1
        self._waiting: list[str] = []
        self._requests: dict[int, asyncio.Future[tuple[dict[str, Any], list[int]]]] = {}
        self._serial = 0
        self.link_state = self._make_link_state()
        self.port_forwarder = self._make_port_forwarder()
        self.link_state.on_change = self.port_forwarder.refresh
        self.faults = FaultInjection(self.fleet, self.link_state, self)
        self.operations = self._make_operations()

    def _make_link_state(self) -> LinkState:
        return LinkState(self.fleet)

    def _make_port_forwarder(self) -> PortForwarder:
        return PortForwarder(self.fleet, self.link_state, self)

    def _make_operations(self) -> Operations:
        return Operations(self.fleet, self.link_state, self.port_forwarder, self.faults, self)

    # -- start and power --

    async def run(self) -> None:
        """Boot every node and serve until `stop`."""
        loop = asyncio.get_running_loop()
        self._runner.setblocking(False)
        loop.add_reader(self._runner, self._on_runner_event)
        events = self._open_events()
        loop.add_reader(events, self._on_events)
        for ending in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(ending, self.stopping.set)
        self.port_forwarder.open()
        for number, node in enumerate(self.spec.nodes):
            self._make(number)
            self.power_on(node.name)
        control = Control(self.directory, self.operations.answer)
        control.open()
        try:
            await self.stopping.wait()
        finally:
            control.close()
            await self.port_forwarder.close()
            loop.remove_reader(self._runner)
            loop.remove_reader(events)
            os.close(events)

    def _open_events(self) -> int:
        self._events = os.open(self.directory / "events", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        return self._events

    def _make(self, number: int) -> None:
        node = self.spec.nodes[number]
        home = self.directory / "nodes" / node.name
        state = NodeState(node, number, home, plugged=node.medium is not Medium.NONE)
        self.fleet.nodes[node.name] = state
        for folder in ("flash", "air"):
            (home / folder).mkdir(parents=True, exist_ok=True)
        (home / "air" / "heard").write_text("", encoding="ascii")
        if not (home / "firmware" / "env").exists():
            write_firmware(home, node.release, node.packages, node.target)

    def stop(self) -> None:
        """End the fleet: `run` returns."""
        self.stopping.set()

    def power_on(self, name: str) -> None:
        """Boot a node that is off, once fewer than `_BOOTING_AT_ONCE` others are booting."""
        state = self.fleet.nodes[name]
        state.want_on = True
        if state.is_running or name in self._waiting:
            return
        self._waiting.append(name)
        self._boot_next()

    def power_off(self, name: str, *, back: bool) -> None:
        """Cut a node's power; `back` restores it immediately."""
        state = self.fleet.nodes[name]
        state.want_on = back
        if name in self._waiting:
            if not back:
                self._waiting.remove(name)
            return
        if state.is_running:
            # connections stall from here on, before the exit of its processes could close them
            self._mark_down(state, Power.OFF)
            self.send({"do": "kill", "node": name})
        elif back:
            self.power_on(name)

    def _boot_next(self) -> None:
        while self._waiting and sum(s.power is Power.BOOTING for s in self.fleet.nodes.values()) < _BOOTING_AT_ONCE:
            name = next((waiting for waiting in self._waiting if not self.fleet.nodes[waiting].pid), None)
            if name is None:
                return
            self._waiting.remove(name)
            self._boot(self.fleet.nodes[name])

    def _boot(self, state: NodeState) -> None:
        container = self.fleet.container(state)
        (state.home / "air" / "effective").unlink(missing_ok=True)
        write_board(state, label_mac(state.spec, state.number), self.spec.seed)
        prepare(container)
        state.power = Power.BOOTING
        state.reason = ""
        state.boots += 1
        # set now, so that the node is not started twice; the node runner reports the real pid
        state.pid = -1
        self.send(
            {
                "do": "boot",
                "node": state.spec.name,
                "number": state.number,
                "fleet": str(self.directory),
                "overlay_kib": container.overlay_kib,
                "memory_kib": container.memory_kib,
                "deny_setgroups": self.fleet.deny_setgroups,
            }
        )

    def _mark_down(self, state: NodeState, power: Power) -> None:
        state.power = power
        state.boot_id = ""
        state.effective = parse_effective("")
        self.link_state.changed()

    # -- the node runner --

    def send(self, request: dict[str, Any], descriptors: Sequence[int] = ()) -> None:
        """Send a request that has no reply."""
        # blocking is fine: a full buffer only means that the node runner is a few requests behind
        self._runner.setblocking(True)
        try:
            socket.send_fds(self._runner, [json.dumps(request).encode()], list(descriptors))
        finally:
            self._runner.setblocking(False)

    async def request(
        self, request: dict[str, Any], descriptors: Sequence[int] = ()
    ) -> tuple[dict[str, Any], list[int]]:
        """Send a request and wait for the event with its id."""
        self._serial += 1
        serial = self._serial
        future: asyncio.Future[tuple[dict[str, Any], list[int]]] = asyncio.get_running_loop().create_future()
        self._requests[serial] = future
        try:
            self.send({**request, "id": serial}, descriptors)
            return await future
        finally:
            self._requests.pop(serial, None)

    def _on_runner_event(self) -> None:
        message, descriptors, _, _ = socket.recv_fds(self._runner, MESSAGE_BYTES, 1)
        if not message:
            log.error("node-runner-ended")
            self.stopping.set()
            return
        event = json.loads(message)
        if "id" in event:
            future = self._requests.get(event["id"])
            if future is None or future.done():
                for descriptor in descriptors:
                    os.close(descriptor)
            else:
                future.set_result((event, descriptors))
        elif event["event"] == "started":
            self.fleet.nodes[event["node"]].pid = event["pid"]
        elif event["event"] == "exit":
            # its output before it ended is not part of its next boot
            self._on_events()
            self._exited(self.fleet.nodes[event["node"]], event["status"], event["reason"])

    def _exited(self, state: NodeState, status: int, reason: str) -> None:
        state.pid = 0
        power = state.power
        if power in (Power.BOOTING, Power.UP, Power.FLASHING):
            log.info("node-ended node=%s status=%d reason=%s", state.spec.name, status, reason)
            self._mark_down(state, Power.OFF)
        if reason:
            state.power, state.reason = Power.FAILED, reason
        elif power is Power.DEAD or status in (_DEAD, _POWER_OFF):
            state.power = Power.DEAD if status == _DEAD or power is Power.DEAD else Power.OFF
            state.want_on = state.want_on and status != _POWER_OFF
        elif state.want_on:
            self.power_on(state.spec.name)
        self._boot_next()

    # -- the events pipe --

    def _on_events(self) -> None:
        with contextlib.suppress(BlockingIOError):
            for line in os.read(self._events, 65536).decode("utf-8", "replace").splitlines():
                word, _, rest = line.partition(" ")
                name, _, detail = rest.partition(" ")
                if name not in self.fleet.nodes:
                    continue
                try:
                    self._on_message(word, self.fleet.nodes[name], detail)
                except (OSError, ValueError, LabError):
                    # the following lines may be from other nodes
                    log.exception("event-failed line=%s", line)

    def _on_message(self, word: str, state: NodeState, detail: str) -> None:
        match word:
            case "up" if state.power is Power.BOOTING:
                state.power = Power.UP
                state.boot_id = detail
                self._read_effective(state)
                self._boot_next()
            case "changed" if state.is_running:
                self._read_effective(state)
            case "forgot" if len(detail.split()) == 2:
                interface, mac = detail.split()
                self.link_state.station_deleted(state.spec.name, interface, mac)
            case "dead":
                self._mark_down(state, Power.DEAD)
            case "cut" if state.is_running:
                self.power_off(state.spec.name, back=True)
            case "sever":
                self.faults.sever(state)
            case "flashing" if state.is_running:
                state.power = Power.FLASHING
                if state.cut_at_flash:
                    state.cut_at_flash = False
                    half = state.spec.flash_s / 2
                    asyncio.get_running_loop().call_later(half, lambda: self.power_off(state.spec.name, back=True))

    def _read_effective(self, state: NodeState) -> None:
        try:
            text = (state.home / "air" / "effective").read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            text = ""
        effective = parse_effective(text)
        if effective != state.effective:
            state.effective = effective
            self.link_state.changed()


# exit status of a node's process 1 (node_root/lab/init)
_POWER_OFF = 10
_DEAD = 20


def main(arguments: Sequence[str]) -> int:
    """Run the supervisor of the fleet in DIRECTORY, which has its spec.json. Errors are written to `failure`."""
    directory = Path(arguments[1]).resolve()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s")
    try:
        deny_setgroups = _acquire_privileges()
        rootfs.build(directory / "rom")
        (directory / "mnt").mkdir(exist_ok=True)
        os.mkfifo(directory / "events", 0o622)
        (directory / "events").chmod(0o622)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        fork_node_runner(lambda: NodeRunner(theirs), theirs, close=ours)
        spec = load((directory / "spec.json").read_text(encoding="utf-8"))
        supervise: Callable[[], Any] = Supervisor(spec, directory, ours, deny_setgroups=deny_setgroups).run
        (directory / "supervisor.pid").write_text(f"{os.getpid()}\n", encoding="ascii")
        asyncio.run(supervise())
        ours.close()
    except (LabError, OSError) as error:
        (directory / "failure").write_text(f"{error}\n{getattr(error, 'hint', '')}\n", encoding="utf-8")
        return 1
    return 0


def _acquire_privileges() -> bool:
    """Become root of a new user namespace if the kernel allows it, else require root. Returns whether setgroups is
    denied."""
    if not ns.machine_is_known():
        raise LabError("the virtual fleet runs on x86_64 and aarch64 only")
    privileges = os.environ.get("MESHCTL_LAB_PRIVILEGES", "")
    if privileges != "root":
        try:
            ns.enter_user_namespace()
        except OSError as error:
            if privileges == "user" or os.geteuid() != 0:
                raise LabError(
                    f"the kernel does not allow this user to create user namespaces ({error})",
                    hint="run as root, or allow them: sysctl kernel.unprivileged_userns_clone=1 (Debian), "
                    "kernel.apparmor_restrict_unprivileged_userns=0 (Ubuntu); in a container, run it with --privileged",
                ) from error
        else:
            return True
    return False


def fork_node_runner(make: Callable[[], NodeRunner], channel: socket.socket, *, close: socket.socket) -> None:
    """Fork a process that runs the node runner on `channel`; `close` is the parent's end of the socket pair."""
    if os.fork() != 0:
        channel.close()
        return
    ns.die_with_parent()
    close.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        make().serve()
    except BaseException:
        log.exception("node-runner-failed")
        os._exit(1)
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
