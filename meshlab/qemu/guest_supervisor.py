"""The process behind the fleet on the machine's side, and process 1 there: the virtual fleet's supervisor and warden,
with the kernel's radios for air and the host for a way in.

It starts as `python -m meshlab.qemu.guest_supervisor DIRECTORY`, where the image has put the ROM, the spec and the
token. When it ends, the kernel panics and the machine with it: the host's process sees that.
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
from meshlab.link_state import Ether
from meshlab.node_runner import Warden
from meshlab.port_forwarder import Doors
from meshlab.qemu import hwsim_devices
from meshlab.qemu.guest_agent import Agent
from meshlab.qemu.link_state import RealEther
from meshlab.qemu.port_forwarder import RealDoors
from meshlab.qemu.traffic_control import Fate
from meshlab.spec import FleetSpec, load
from meshlab.state import NodeState
from meshlab.supervisor import Supervisor, fork_warden

log = logging.getLogger("meshlab.qemu")
# TEST-NET-1 (RFC 5737): no fleet has it, and nothing leaves the machine
ADDRESS = "192.0.2.15"
GATEWAY = "192.0.2.2"
NETWORK = "192.0.2.0/24"
PORT = 7000
READY = "lab: ready"


class RealSupervisor(Supervisor):
    """A supervisor whose air, cables and doors are the kernel's."""

    def __init__(self, spec: FleetSpec, directory: Path, warden: socket.socket) -> None:
        self.places = hwsim_devices.places(spec)
        super().__init__(spec, directory, warden, deny_setgroups=False)

    def _make_ether(self) -> Ether:
        self.real_ether = RealEther(self, self.places)
        return self.real_ether

    def _make_doors(self) -> Doors:
        self.real_doors = RealDoors(self, self.places)
        return self.real_doors

    def _make_operations(self) -> Operations:
        return RealOperations(self)

    async def run(self) -> None:
        token = (self.directory / "token").read_text(encoding="ascii")
        agent = Agent(token, self.operations.answer, self.real_doors)
        await agent.open(ADDRESS, PORT)
        sys.stderr.write(f"{READY}\n")
        try:
            await super().run()
        finally:
            agent.close()

    def _read_effective(self, state: NodeState) -> None:
        super()._read_effective(state)
        self.real_ether.forget(state.spec.name)
        self.ether.changed()


class RealOperations(Operations):
    """What a fleet of real radios can be asked for besides."""

    def __init__(self, fleet: RealSupervisor) -> None:
        super().__init__(fleet)
        self._real = fleet

    async def carry_out(self, request: dict[str, Any], descriptors: list[int]) -> dict[str, Any]:
        if request["op"] == "machine":
            return await self._machine(request["command"], descriptors)
        return await super().carry_out(request, descriptors)

    async def _machine(self, command: str, descriptors: list[int]) -> dict[str, Any]:
        source, out, err = descriptors
        process = await asyncio.create_subprocess_exec("/bin/sh", "-c", command, stdin=source, stdout=out, stderr=err)
        return {"status": await process.wait()}

    def radios(self) -> dict[str, Any]:
        return {"radios": {name: list(place.phys) for name, place in self._real.places.items()}}

    def set_groups(self, masks: dict[str, int]) -> None:
        for name in masks:
            self._real.hurt.find(name)
        self._real.real_ether.set_groups(masks)

    def set_loss(self, losses: list[tuple[str, str, float]]) -> None:
        fates: dict[str, dict[str, Fate]] = {}
        for sender, receiver, loss in losses:
            cells = self._real.hurt.find(sender).effective.cells
            fates.setdefault(receiver, {}).update({cell.mac: Fate(loss) for cell in cells})
        for receiver, heard in fates.items():
            self._real.real_ether.lose(self._real.hurt.find(receiver), heard)


def main(arguments: Sequence[str]) -> int:
    """Become the supervisor of the fleet in DIRECTORY."""
    directory = Path(arguments[1])
    logging.basicConfig(level=logging.INFO, format="%(relativeCreated)d %(name)s %(message)s")
    spec = load((directory / "spec.json").read_text(encoding="utf-8"))
    hwsim_devices.ip([f"addr add {ADDRESS}/24 dev eth0", "link set eth0 up"])
    hwsim_devices.prepare(spec)
    (directory / "mnt").mkdir(exist_ok=True)
    os.mkfifo(directory / "bell", 0o622)
    (directory / "bell").chmod(0o622)
    places = hwsim_devices.places(spec)

    def put_devices(container: Container, pid: int) -> None:
        hwsim_devices.put_devices(places[container.name], pid)

    def take_devices(name: str, network: int) -> None:
        hwsim_devices.take_devices(places[name], network)

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    fork_warden(lambda: Warden(theirs, put_devices, take_devices), theirs, close=ours)
    try:
        asyncio.run(RealSupervisor(spec, directory, ours).run())
    except LabError as error:
        log.error("failed reason=%s", error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
