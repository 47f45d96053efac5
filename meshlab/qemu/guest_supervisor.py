"""The fleet's process inside the machine, and its process 1: the virtual fleet's supervisor and node runner, with the
kernel's radios as links and ports that the host forwards.

It starts as `python -m meshlab.qemu.guest_supervisor DIRECTORY`; the image has the ROM, the spec and the token there.
When it ends, the kernel panics and the machine stops, which the host's process notices.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from meshlab.container import Container
from meshlab.control import Operations
from meshlab.errors import LabError
from meshlab.link_state import LinkState
from meshlab.node_runner import NodeRunner
from meshlab.port_forwarder import PortForwarder
from meshlab.qemu import hwsim_devices
from meshlab.qemu.guest_agent import GuestAgent
from meshlab.qemu.guest_protocol import ADDRESS, PORT, READY
from meshlab.qemu.link_state import QemuLinkState
from meshlab.qemu.port_forwarder import QemuPortForwarder
from meshlab.qemu.static_keys import hold_time_stamps
from meshlab.spec import FleetSpec, load
from meshlab.state import NodeState
from meshlab.supervisor import Supervisor, fork_node_runner

log = logging.getLogger("meshlab.qemu")


class QemuSupervisor(Supervisor):
    """A supervisor whose links, cables and connections are the kernel's."""

    def __init__(self, spec: FleetSpec, directory: Path, runner: socket.socket) -> None:
        self.hardware = hwsim_devices.node_hardware(spec)
        super().__init__(spec, directory, runner, deny_setgroups=False)

    def _make_link_state(self) -> LinkState:
        self.qemu_link_state = QemuLinkState(self.fleet, self.hardware)
        return self.qemu_link_state

    def _make_port_forwarder(self) -> PortForwarder:
        self.qemu_port_forwarder = QemuPortForwarder(self.fleet, self.link_state, self, self.hardware)
        return self.qemu_port_forwarder

    def _make_operations(self) -> Operations:
        return QemuOperations(self)

    async def run(self) -> None:
        token = (self.directory / "token").read_text(encoding="ascii")
        agent = GuestAgent(token, self.operations.answer, self.qemu_port_forwarder)
        await agent.open(ADDRESS, PORT)
        sys.stderr.write(f"{READY}\n")
        try:
            await super().run()
        finally:
            agent.close()

    def _read_effective(self, state: NodeState) -> None:
        super()._read_effective(state)
        self.qemu_link_state.reset_impairments(state.spec.name)
        self.link_state.changed()


class QemuOperations(Operations):
    """The additional operations of a QEMU fleet."""

    def __init__(self, supervisor: QemuSupervisor) -> None:
        super().__init__(
            supervisor.fleet, supervisor.link_state, supervisor.port_forwarder, supervisor.faults, supervisor
        )
        self._hardware = supervisor.hardware
        self._qemu_link_state = supervisor.qemu_link_state

    async def dispatch(self, request: dict[str, Any], descriptors: list[int]) -> dict[str, Any]:
        if request["op"] == "machine":
            return await self._machine(request["command"], descriptors)
        return await super().dispatch(request, descriptors)

    async def _machine(self, command: str, descriptors: list[int]) -> dict[str, Any]:
        source, out, err = descriptors
        process = await asyncio.create_subprocess_exec("/bin/sh", "-c", command, stdin=source, stdout=out, stderr=err)
        return {"status": await process.wait()}

    def radios(self) -> dict[str, Any]:
        return {"radios": {name: list(hardware.phys) for name, hardware in self._hardware.items()}}

    def set_groups(self, masks: dict[str, int]) -> None:
        for name in masks:
            self._fleet.node(name)
        self._qemu_link_state.set_groups(masks)


def main(arguments: Sequence[str]) -> int:
    """Run the supervisor of the fleet in DIRECTORY."""
    directory = Path(arguments[1])
    logging.basicConfig(level=logging.INFO, format="%(relativeCreated)d %(name)s %(message)s")
    spec = load((directory / "spec.json").read_text(encoding="utf-8"))
    held = hold_time_stamps()
    hwsim_devices.ip([f"addr add {ADDRESS}/24 dev eth0", "link set eth0 up"])
    hwsim_devices.prepare(spec)
    (directory / "mnt").mkdir(exist_ok=True)
    os.mkfifo(directory / "events", 0o622)
    (directory / "events").chmod(0o622)
    hardware = hwsim_devices.node_hardware(spec)

    def attach_devices(container: Container, pid: int) -> None:
        hwsim_devices.attach_devices(hardware[container.name], pid)

    def detach_devices(name: str, network: int) -> None:
        hwsim_devices.detach_devices(hardware[name], network)

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    fork_node_runner(lambda: NodeRunner(theirs, attach_devices, detach_devices), theirs, close=ours)
    try:
        asyncio.run(QemuSupervisor(spec, directory, ours).run())
    except LabError as error:
        log.error("failed reason=%s", error)
        return 1
    finally:
        held.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
