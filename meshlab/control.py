"""The supervisor's control socket: one JSON request per datagram, one JSON reply; `exec` also passes descriptors.

The methods of `Operations` are the operations, by name; `client` is the other end.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import re
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from meshctl.errors import MeshctlError
from meshlab.fault_injection import FaultInjection
from meshlab.fleet_state import FleetState, NodeControl
from meshlab.link_state import LinkState
from meshlab.node_runner import MESSAGE_BYTES
from meshlab.port_forwarder import PortForwarder
from meshlab.spec import LinkSpec
from meshlab.state import NodeState

log = logging.getLogger("meshlab.control")
_NAME = "control.sock"


def address_of(directory: Path, descriptor: int) -> str:
    """The socket's path through an open directory descriptor: a socket path is limited to 107 bytes."""
    return f"/proc/self/fd/{descriptor}/{_NAME}"


Answer = Callable[[dict[str, Any], list[int]], Awaitable[dict[str, Any]]]


class Control:
    """Listens in the fleet's directory; `answer` gets each request and its descriptors."""

    def __init__(self, directory: Path, answer: Answer) -> None:
        self._directory = directory
        self._answer = answer
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._tasks: set[asyncio.Task[None]] = set()

    def open(self) -> None:
        loop = asyncio.get_running_loop()
        folder = os.open(self._directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            self._listener.bind(address_of(self._directory, folder))
        finally:
            os.close(folder)
        (self._directory / _NAME).chmod(0o600)
        self._listener.listen(64)
        self._listener.setblocking(False)
        loop.add_reader(self._listener, self._accept)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._listener)
        self._listener.close()
        (self._directory / _NAME).unlink(missing_ok=True)
        for task in self._tasks:
            task.cancel()

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        task = asyncio.ensure_future(self._serve(connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: socket.socket) -> None:
        with connection:
            while True:
                await _readable(connection)
                try:
                    message, descriptors, _, _ = socket.recv_fds(connection, MESSAGE_BYTES, 3)
                except OSError:
                    return
                if not message:
                    return
                try:
                    answer = await self._answer(json.loads(message), descriptors)
                finally:
                    for descriptor in descriptors:
                        os.close(descriptor)
                with contextlib.suppress(OSError):
                    connection.setblocking(True)
                    connection.send(json.dumps(answer).encode())
                    connection.setblocking(False)


class Operations:
    """The requests of a client: each public method except `answer` and `dispatch` returns a JSON object or None."""

    def __init__(
        self,
        fleet: FleetState,
        link_state: LinkState,
        port_forwarder: PortForwarder,
        faults: FaultInjection,
        control: NodeControl,
    ) -> None:
        self._fleet = fleet
        self._link_state = link_state
        self._port_forwarder = port_forwarder
        self._faults = faults
        self._control = control

    async def answer(self, request: dict[str, Any], descriptors: list[int]) -> dict[str, Any]:
        """The reply to one request; a failure is a reply with `error` and `hint`."""
        asked = request.get("op")
        try:
            return await self.dispatch(request, descriptors)
        except MeshctlError as error:
            return {"error": str(error), "hint": error.hint}
        except Exception as error:
            # a bug in the lab: report it to the client, log the traceback, and keep the fleet running
            log.exception("request-failed op=%s", asked)
            return {
                "error": f"the lab failed at {asked!r}: {type(error).__name__}: {error}",
                "hint": "see `log` in the fleet's directory",
            }

    async def dispatch(self, request: dict[str, Any], descriptors: list[int]) -> dict[str, Any]:
        """Run the requested operation. Raises MeshctlError when the fleet rejects it, any exception for a bug."""
        if request["op"] == "exec":
            return await self.execute(request["node"], request["command"], descriptors)
        result = getattr(self, request.pop("op"))(**request)
        if asyncio.iscoroutine(result):
            result = await result
        return result or {}

    def status(self) -> dict[str, Any]:
        fleet = self._fleet
        in_mesh = self._link_state.reachable()
        hosts: dict[str, list[str]] = {}
        for host, port in self._port_forwarder.reachable().items():
            hosts.setdefault(port.node, []).append(host)
        nodes = [
            {
                "name": name,
                "power": state.power.value,
                "reason": state.reason,
                "pid": max(state.pid, 0),
                "boots": state.boots,
                "release": _release(state),
                "address": _address(state.effective.addresses),
                "plugged": state.plugged,
                "in_mesh": name in in_mesh,
                "reached_at": sorted(hosts.get(name, [])),
                "breaks": state.faults,
            }
            for name, state in fleet.nodes.items()
        ]
        links = [
            {"between": [link.a, link.b], "up": link.up, "tq": link.tq_to(link.b), "delay_ms": link.delay_ms,
             "loss": link.loss, "loss_back": link.loss_to(link.a), "rate_kbps": link.rate_kbps}
            for link in self._link_state.links()
        ]  # fmt: skip
        return {
            "fleet": fleet.spec.name,
            "pid": os.getpid(),
            "port": self._port_forwarder.port,
            "nodes": nodes,
            "links": links,
        }

    def node(self, node: str) -> dict[str, Any]:
        state = self._fleet.node(node)
        return {
            "power": state.power.value,
            "reason": state.reason,
            "boots": state.boots,
            "boot_id": state.boot_id,
            "address": _address(state.effective.addresses),
            "number": state.number,
        }

    def console(self, node: str, lines: int) -> dict[str, Any]:
        """The last lines its boot scripts printed, over all boots; works for a node without power, too."""
        file = self._fleet.node(node).home / "console.log"
        text = file.read_text(encoding="utf-8", errors="replace") if file.exists() else ""
        return {"text": "\n".join(text.splitlines()[-lines:])}

    async def execute(self, node: str, command: str, descriptors: list[int]) -> dict[str, Any]:
        self._fleet.node(node)
        event, _ = await self._control.request({"do": "exec", "node": node, "command": command}, descriptors)
        return {"status": event["status"], "reason": event.get("reason", "")}

    async def power_cut(self, node: str, unsynced: str, back: bool) -> None:
        await self._faults.power_cut(self._fleet.node(node), unsynced, back=back)

    def power_on(self, node: str) -> None:
        self._control.power_on(self._fleet.node(node).spec.name)

    async def do_break(self, where: str, what: str) -> None:
        await self._faults.inject(where, what)

    async def mend(self, where: str) -> None:
        await self._faults.repair(where)

    def link(self, a: str, b: str, changes: dict[str, Any]) -> None:
        self._link_state.set_link(a, b, changes)

    def links(self, part: list[dict[str, Any]], is_last: bool) -> None:
        """Replace the fleet's links, sent in parts because a request is limited (`placement.set_environment`)."""
        self._link_state.pending_links += [LinkSpec(**link) for link in part]
        if is_last:
            links, self._link_state.pending_links = self._link_state.pending_links, []
            self._link_state.set_base_links(links)

    def plug(self, node: str, plugged: bool) -> None:
        self._fleet.node(node).plugged = plugged
        self._link_state.changed()

    async def record_steps(self, node: str) -> None:
        await self._faults.count_steps(self._fleet.node(node))

    def down(self) -> None:
        self._control.stop()


def _release(state: NodeState) -> str:
    """The release in the node's flash chip."""
    text = (state.home / "firmware" / "env").read_text(encoding="utf-8", errors="replace")
    found = re.search(r"^VERSION='([^']*)'", text, re.MULTILINE)
    return found[1] if found else "-"


def _address(addresses: Any) -> str | None:
    return next((address.address for address in addresses if address.over_wire or address.over_mesh), None)


async def _readable(connection: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    ready = asyncio.Event()
    loop.add_reader(connection, ready.set)
    try:
        await ready.wait()
    finally:
        loop.remove_reader(connection)
