"""Port forwarding inside the machine: the reachable ports, and connections to them.

The host listens and requests a connection (`host_proxy`); it is made over the node's own cable on the bench, else from
the computer on the base's LAN, through the mesh.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from ipaddress import IPv4Interface
from pathlib import Path

from meshlab import namespaces as ns
from meshlab.errors import LabError
from meshlab.fleet_state import FleetState, NodeControl
from meshlab.link_state import LinkState
from meshlab.port_forwarder import ForwardedPort, PortForwarder
from meshlab.qemu import hwsim_devices
from meshlab.spec import Medium

# the kernel gives up unanswered ARP after 3 s, and retransmits a lost SYN after 1, 3 and 7 s
_DIAL_S = 10.0
_FACTORY_PREFIX = 24


class QemuPortForwarder(PortForwarder):
    """`changed` is set when the reachable ports have changed, and replaced by a new event."""

    def __init__(
        self,
        fleet: FleetState,
        link_state: LinkState,
        control: NodeControl,
        hardware: dict[str, hwsim_devices.NodeHardware],
    ) -> None:
        super().__init__(fleet, link_state, control)
        self._hardware = hardware
        self._reachable: dict[str, ForwardedPort] = {}
        self.changed = asyncio.Event()
        self._computers: dict[str, int] = {}

    def open(self) -> None:
        """Nothing listens in the machine."""

    async def close(self) -> None:
        for descriptor in self._computers.values():
            os.close(descriptor)

    def refresh(self) -> None:
        """Set `changed` if the reachable ports have changed."""
        reachable = self.reachable()
        if reachable != self._reachable:
            self._reachable = reachable
            self.changed.set()
            self.changed = asyncio.Event()

    async def dial(self, host: str) -> socket.socket:
        """Connect to the SSH server that `host` is forwarded to. Raises OSError or LabError when it does not answer."""
        port = self._reachable.get(host)
        if port is None:
            raise LabError(f"{host} is not reachable")
        state = self._fleet.nodes[port.node]
        if state.hung:
            raise TimeoutError(f"{port.node} accepts connections but does not answer")
        *others, last = state.spec.ssh_ports
        for number in others:
            with contextlib.suppress(ConnectionRefusedError):
                return await self._connected(host, port, number)
        return await self._connected(host, port, last)

    async def _connected(self, host: str, port: ForwardedPort, number: int) -> socket.socket:
        made = self._socket(port)
        made.setblocking(False)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            async with asyncio.timeout(_DIAL_S):
                await self._wait_connected(made, host, port, number)
        except BaseException:
            made.close()
            raise
        return made

    async def _wait_connected(self, made: socket.socket, host: str, port: ForwardedPort, number: int) -> None:
        """Wait until the socket is connected. Raises LabError as soon as the port's target changes: a node that gave up
        an address does not reject packets to it."""
        connecting = asyncio.ensure_future(asyncio.get_running_loop().sock_connect(made, (port.address, number)))
        moving = asyncio.ensure_future(self._wait_moved(host, port))
        try:
            await asyncio.wait((connecting, moving), return_when=asyncio.FIRST_COMPLETED)
            if not connecting.done():
                raise LabError(f"{port.node} is no longer at {port.address}")
            await connecting
        finally:
            connecting.cancel()
            moving.cancel()
            # the socket must not be closed while it is being waited for
            await asyncio.gather(connecting, moving, return_exceptions=True)

    async def _wait_moved(self, host: str, port: ForwardedPort) -> None:
        while self._reachable.get(host) == port:
            await self.changed.wait()

    def is_hung(self, host: str) -> bool:
        port = self._reachable.get(host)
        return port is not None and self._fleet.nodes[port.node].hung

    def _socket(self, port: ForwardedPort) -> socket.socket:
        """A socket on the operator's side of this port: on the bench cable, or on the base's LAN."""
        state = self._fleet.nodes[port.node]
        prefix = next((a.prefix for a in state.effective.addresses if a.address == port.address), _FACTORY_PREFIX)
        address = IPv4Interface(f"{port.address}/{prefix}")
        by_wire = self._link_state.bench_shape(port.node, port.address) is not None
        hardware = self._hardware[port.node]
        if by_wire and not hwsim_devices.is_on_operator_lan(hardware, self._fleet.spec):
            _add_address(hardware.cable, hwsim_devices.operator_address(address, hardware.number))
            made = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            made.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, hardware.cable.encode())
            return made
        lan = hwsim_devices.operator_lan(self._fleet.spec)
        if lan is None:
            raise LabError("the fleet has no base: its nodes are reachable on the bench only")
        space = hwsim_devices.computer_namespace(lan)
        is_local = bool(lan.computer) and IPv4Interface(lan.computer).network == address.network
        if not is_local and self._is_on_wire_of_base(address):
            _add_address("eth0", hwsim_devices.operator_address(address, 0), namespace=space)
        return self._socket_in(space)

    def _is_on_wire_of_base(self, address: IPv4Interface) -> bool:
        """Whether a base's LAN is in the address's network; otherwise the base routes there."""
        return any(
            own.over_wire and IPv4Interface(f"{own.address}/{own.prefix}").network == address.network
            for state in self._fleet.nodes.values()
            if state.spec.medium is Medium.BASE
            for own in state.effective.addresses
        )

    def _socket_in(self, namespace: str) -> socket.socket:
        if namespace not in self._computers:
            self._computers[namespace] = os.open(Path("/run/netns") / namespace, os.O_RDONLY | os.O_CLOEXEC)
        home = os.open("/proc/self/ns/net", os.O_RDONLY | os.O_CLOEXEC)
        try:
            # synchronous, so that nothing else runs in the other namespace
            ns.setns(self._computers[namespace], ns.CLONE_NEWNET)
            try:
                return socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            finally:
                ns.setns(home, ns.CLONE_NEWNET)
        finally:
            os.close(home)


def _add_address(device: str, address: IPv4Interface, *, namespace: str = "") -> None:
    with contextlib.suppress(LabError):
        # the address may already be set
        hwsim_devices.ip([f"addr add {address} dev {device}"], namespace=namespace)
