"""Forward ports from 127/8 to the nodes' SSH servers: one listening socket per address that is reachable now.

When an address becomes unreachable its socket closes, so new connections are refused, and established ones stall, as in
the field. The socket also closes while the node's firewall rejects SSH; established connections are not affected then.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import random
import socket
from dataclasses import dataclass

from meshlab.addresses import FACTORY_ADDRESS, bench_of, loopback_of
from meshlab.fleet_state import FleetState, NodeControl
from meshlab.link_state import LinkState
from meshlab.listeners import Listeners, lock_port
from meshlab.shaped_tunnel import Shape, Tunnel, reset
from meshlab.spec import Medium

log = logging.getLogger("meshlab.port_forwarder")


@dataclass(frozen=True, slots=True)
class ForwardedPort:
    """A connection to `host` is forwarded to `address` of `node`; `bench`: over its LAN port only."""

    host: str
    node: str
    address: str
    bench: bool


class PortForwarder:
    """Keeps one listening socket open for each reachable address."""

    def __init__(self, fleet: FleetState, link_state: LinkState, control: NodeControl) -> None:
        self._fleet = fleet
        self._link_state = link_state
        self._control = control
        self._listeners: Listeners[ForwardedPort] = Listeners(lambda port: port.host, self._serve)
        self.port = fleet.spec.port
        self._port_lock: socket.socket | None = None
        # a fixed seed, so that losses are the same in every run
        self._rng = random.Random(1)

    def open(self) -> None:
        """Choose a port and hold it on 127.255.255.254 while the fleet runs. Raises LabError when it is in use."""
        self._port_lock, self.port = lock_port(self.port)

    async def close(self) -> None:
        await self._listeners.close()
        if self._port_lock is not None:
            self._port_lock.close()

    def reachable(self) -> dict[str, ForwardedPort]:
        """The ports reachable now, by loopback address. If nodes share an address, the first in order gets it."""
        ports: dict[str, ForwardedPort] = {}
        for name, state in self._fleet.nodes.items():
            if not state.is_running:
                continue
            on_bench = self._link_state.bench_shape(name, FACTORY_ADDRESS) is not None
            if on_bench and state.effective.admits(FACTORY_ADDRESS):
                port = ForwardedPort(bench_of(state.number), name, FACTORY_ADDRESS, bench=True)
                ports[port.host] = port
            for address in state.effective.addresses:
                # factory devices share this address: on the bench each is reached over its own LAN port only
                if address.address == FACTORY_ADDRESS and state.spec.medium is not Medium.BASE:
                    continue
                if not address.admitted:
                    continue
                host = loopback_of(address.address)
                if host not in ports and self._link_state.path_shape(name, address.address) is not None:
                    ports[host] = ForwardedPort(host, name, address.address, bench=False)
        return ports

    def refresh(self) -> None:
        """Open and close sockets to match `reachable`."""
        self._listeners.update(set(self.reachable().values()), self.port)

    async def _serve(self, port: ForwardedPort, client: socket.socket) -> None:
        state = self._fleet.nodes[port.node]
        boots = state.boots
        if state.hung:
            await self._hang(client)
            return
        node = await self._dial(port)
        if node is None:
            reset(client)
            client.close()
            return
        path_shape = self._link_state.bench_shape if port.bench else self._link_state.path_shape

        def shape() -> Shape | None:
            return None if state.hung else path_shape(port.node, port.address)

        await Tunnel(client, node, shape, self._link_state.condition, lambda: state.boots == boots, self._rng).run()

    async def _dial(self, port: ForwardedPort) -> socket.socket | None:
        """A connection to the node's SSH server; None if it does not accept one."""
        for number in self._fleet.nodes[port.node].spec.ssh_ports:
            answer, descriptors = await self._control.request({"do": "dial", "node": port.node})
            if not descriptors:
                log.info("dial-failed node=%s reason=%s", port.node, answer.get("error"))
                return None
            node = socket.socket(fileno=descriptors[0])
            node.setblocking(False)
            node.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                await asyncio.get_running_loop().sock_connect(node, (port.address, number))
            except OSError as error:
                log.info("refused node=%s port=%s reason=%s", port.node, number, errno.errorcode.get(error.errno or 0))
                node.close()
            else:
                return node
        return None

    async def _hang(self, client: socket.socket) -> None:
        """Keep the connection open and send nothing until the client closes it."""
        loop = asyncio.get_running_loop()
        try:
            while await loop.sock_recv(client, 4096):
                pass
        except OSError:
            pass
        finally:
            client.close()
